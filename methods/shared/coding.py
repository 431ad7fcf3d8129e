"""Between the streams of anchors and torch (HAC, ECoNGS): context model, networks, attributes."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from econgs_bench.econgs.codec.group import CodedContext, GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.model import Attributes, ContextConfig, ContextModel
from econgs_bench.methods.shared.training import TrainingState

N = TypeVar("N", bound=nn.Module)
LARGEST = 1e6
"""Of weights and attributes: no training comes near, and products of two layers stay finite when squared."""


@torch.no_grad()
def coded_context(state: TrainingState, config: ContextConfig) -> CodedContext:
    """The trained context model of a state."""
    model = ContextModel(config, torch.Generator())
    state.fill("grid", [model.grid.table])
    state.fill("head", model.head)
    if model.intra is not None:
        state.fill("intra", model.intra.parameters())
    model.unit.copy_(state.arrays["coding/unit"])
    return CodedContext.of(model)


def placed(values: ArrayLike, device: str) -> Tensor:
    """An array of a stream as a tensor on a device."""
    return torch.from_numpy(np.ascontiguousarray(values)).to(device)


def placed_anchors(scene: SceneAttributes, device: str) -> tuple[Tensor, Attributes]:
    """Positions and attributes of a decoded scene.

    Raises:
        ValueError: they are none that could be drawn.
    """
    if (scene.scalings < 0.0).any():
        raise ValueError("a scaling that is negative")
    if any(np.abs(one).max(initial=0.0) > LARGEST for one in (scene.features, scene.scalings, scene.offsets)):
        raise ValueError(f"an attribute of more than {LARGEST:g}")
    values = (placed(one, device) for one in (scene.features, scene.scalings, scene.offsets))
    return placed(scene.positions, device), Attributes(*values)


def stored_networks(networks: N, group: GroupAttributes, device: str) -> N:
    """Networks with the weights of a decoded group, on a device, which learn no more.

    Raises:
        RuntimeError: the weights have other names or shapes.
        ValueError: a weight is so large that what is decoded may overflow.
    """
    if any(np.abs(one).max(initial=0.0) > LARGEST for one in group.decoders.values()):
        raise ValueError(f"a weight of more than {LARGEST:g}")
    networks.load_state_dict({name: torch.from_numpy(np.array(one)) for name, one in group.decoders.items()})
    return networks.requires_grad_(False).to(device)
