"""The context model of a checkpoint, as a stream codes it (HAC, ECoNGS)."""

from __future__ import annotations

import torch

from econgs.context.model import ContextConfig, ContextModel
from econgs.context.stream import CodedContext
from methods.shared.training import TrainingState


@torch.no_grad()
def coded_context(state: TrainingState, config: ContextConfig) -> CodedContext:
    """The trained context model of a state."""
    model = ContextModel(config, torch.Generator())
    state.fill("grid", [model.grid.table])
    state.fill("head", model.head)
    model.unit.copy_(state.arrays["coding/unit"])
    return CodedContext.of(model)
