"""The decoders of neural editable Gaussians: four small networks that scenes learned jointly share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from datasets.names import unknown

OffsetColor = Literal["tanh", "sigmoid"]
NETWORKS = {"opacity": 1, "covariance": 7, "shading": 7, "normal": 3}
"""Network (F_o, F_cov, F_s and F_n of the paper) → what it puts out per Gaussian."""


class Decoder(nn.Module):
    """One hidden layer with ReLU. Rows of the second layer are attribute * K + offset.

    Args:
        inputs, hidden, outputs: widths.
        generator: of the first weights, uniform within ±1/√(fan-in) as in ``torch.nn.Linear``.
    """

    def __init__(self, inputs: int, hidden: int, outputs: int, generator: torch.Generator | None) -> None:
        super().__init__()
        self.first_weight = _uniform((hidden, inputs), inputs, generator)
        self.first_bias = _uniform((hidden,), inputs, generator)
        self.second_weight = _uniform((outputs, hidden), hidden, generator)
        self.second_bias = _uniform((outputs,), hidden, generator)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """First weight and bias, second weight and bias."""
        return self.first_weight, self.first_bias, self.second_weight, self.second_bias


class Decoders(nn.Module):
    """F_o, F_cov, F_s and F_n (ECoNGS, section on neural editable Gaussians).

    Each takes anchor feature ‖ view direction (unit vector camera → anchor) ‖ TF embedding, in this order,
    and puts out, per Gaussian: opacity (1) · scale and quaternion (3 + 4) · offset color, k_a, k_d, k_s, β
    (3 + 4) · normal (3). The activations stand in :mod:`econgs.anchors.decode`.

    Args:
        features: F, of an anchor.
        offsets: K, Gaussians per anchor.
        embedding: E, length of a scene's TF embedding; 0 = none.
        hidden: width of the hidden layers.
        view_direction: whether the view direction is an input.
        offset_color: activation of the offset color: "tanh" is signed and starts near the palette color;
            "sigmoid" is that of iVR-GS, starts at 0.5 and is never negative.
        shading_bias: what is added to the first biases of k_a, k_d (linear), k_s (before sigmoid × 5) and β
            (before sigmoid × 50). Without it the linear ones start near 0, which is black.
        generator: of the first weights, on the CPU.

    Raises:
        ValueError: a width that is not positive.
        datasets.errors.UnknownName: no such activation.
    """

    def __init__(
        self,
        features: int = 50,
        offsets: int = 10,
        embedding: int = 50,
        *,
        hidden: int = 50,
        view_direction: bool = True,
        offset_color: OffsetColor = "tanh",
        shading_bias: Sequence[float] = (0.5, 0.5, 0.0, 0.0),
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if min(features, offsets, hidden) < 1 or embedding < 0:
            raise ValueError(
                f"decoders: {features} features, {offsets} offsets and {hidden} hidden units must be at "
                f"least 1, and the embedding ({embedding}) at least 0"
            )
        if offset_color not in get_args(OffsetColor):
            raise unknown("activation", offset_color, get_args(OffsetColor), of="the offset color")
        self.features = features
        self.offsets = offsets
        self.embedding = embedding
        self.hidden = hidden
        self.view_direction = view_direction
        self.offset_color = offset_color
        inputs = features + self.directions + embedding
        for name, attributes in NETWORKS.items():
            self.add_module(name, Decoder(inputs, hidden, attributes * offsets, generator))
        with torch.no_grad():
            bias = self.network("shading").second_bias.view(7, offsets)
            bias[3:] += torch.tensor(list(shading_bias), dtype=bias.dtype)[:, None]

    @property
    def directions(self) -> int:
        """Inputs that hold the view direction."""
        return 3 if self.view_direction else 0

    def network(self, name: str) -> Decoder:
        """One of :data:`NETWORKS`."""
        found = self.get_submodule(name)
        assert isinstance(found, Decoder)
        return found

    def tensors(self) -> list[Tensor]:
        """The 16 weights and biases, network by network in the order of :data:`NETWORKS`."""
        return [tensor for name in NETWORKS for tensor in self.network(name).tensors()]


def _uniform(shape: tuple[int, ...], fan_in: int, generator: torch.Generator | None) -> nn.Parameter:
    bound = 1.0 / math.sqrt(fan_in)
    return nn.Parameter((2.0 * torch.rand(shape, generator=generator) - 1.0) * bound)
