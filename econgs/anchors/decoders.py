"""The decoders of neural editable Gaussians: four small networks, shared by jointly trained scenes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from econgs_bench.datasets.names import unknown

OffsetColor = Literal["tanh", "sigmoid"]
OFFSET_COLORS: dict[str, Callable[[Tensor], Tensor]] = {"tanh": torch.tanh, "sigmoid": torch.sigmoid}
"""Activation of offset colors by its name."""
Storage = Literal["hybrid", "implicit", "partial", "explicit"]
NETWORKS = {"opacity": 1, "covariance": 7, "shading": 7, "normal": 3}
"""Network (F_o, F_cov, F_s and F_n of the paper) → number of outputs per Gaussian."""
_EXPLICIT = {"hybrid": 0, "implicit": 0, "partial": 3, "explicit": 10}
"""Storage → explicit values per Gaussian in the anchor's feature, instead of decoded ones."""


class Decoder(nn.Module):
    """One hidden layer with ReLU. Rows of the second layer are attribute * K + offset.

    Args:
        inputs, hidden, outputs: widths of the layers.
        generator: generator of the initial weights, uniform within ±1/√(fan-in) as in ``torch.nn.Linear``.
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

    @torch.no_grad()
    def show_half(self, outputs: Tensor) -> None:
        """Raise the last biases alike, until at least half of the outputs of an untrained network exceed 0.

        Args:
            outputs: (K,) what the network puts out as it is.
        """
        lowest_visible = len(outputs) // 2
        ascending = outputs.sort().values
        below = ascending[lowest_visible - 1] if lowest_visible else ascending[0] - 0.1
        self.second_bias.sub_(torch.clamp(0.5 * (below + ascending[lowest_visible]), max=0.0))

    @torch.no_grad()
    def start_at(self, opacity: float, outputs: Tensor) -> None:
        """Move the last biases until an untrained network gives all of its outputs one opacity.

        Args:
            opacity: tanh of the outputs, in (0, 1).
            outputs: (K,) what the network puts out as it is.
        """
        self.second_bias.add_(math.atanh(opacity) - outputs)


class Decoders(nn.Module):
    """F_o, F_cov, F_s and F_n (ECoNGS, section on neural editable Gaussians).

    Each takes anchor feature ‖ view direction (unit vector camera → anchor) ‖ TF embedding, in this order,
    and puts out, per Gaussian: opacity (1) · scale and quaternion (3 + 4) · offset color, k_a, k_d, k_s, β
    (3 + 4) · normal (3). Activations: :mod:`.econgs.anchors.decode`.

    Args:
        features: F, values of an anchor's feature.
        offsets: K, Gaussians per anchor.
        embedding: E, length of a scene's TF embedding; 0 = none.
        hidden: width of the hidden layers.
        view_direction: whether the view direction is an input.
        direction_start: factor on the initial weights of the view direction. 0 starts from networks that are
            independent of the view and learn to depend on it only where pictures need it. A factor below 1
            also makes at least half of an anchor's Gaussians visible at the start: features start at zero,
            so that the same Gaussians of all anchors would be culled, and culled Gaussians learn nothing.
        offset_color: activation of the offset color: "tanh" is signed and starts near the palette color;
            "sigmoid" is the activation of iVR-GS, starts at 0.5 and is never negative.
        storage: explicit attributes of anchors (the paper's ablation): "hybrid" is ECoNGS with explicit
            offsets and all else decoded; "implicit" decodes offsets too, by a fifth network of feature and
            embedding; "partial" has explicit normals, "explicit" normals and the outputs of F_s, behind the
            feature's F values (K normals, then K times Δc, k_a, k_d, k_s, β before activation). Only "hybrid"
            and "implicit" have kernels.
        shading_bias: addition to the initial biases of k_a, k_d (linear), k_s (before sigmoid × 5) and β
            (before sigmoid × 50). Without it the linear ones start near 0, which is black.
        start_opacity: opacity of every Gaussian at the start, in [0, 1); 0: as the initial weights have it,
            some culled.
        generator: CPU generator of the initial weights.

    Raises:
        ValueError: a width that is not positive.
        econgs_bench.datasets.errors.UnknownName: no such activation or storage.
    """

    def __init__(
        self,
        features: int = 50,
        offsets: int = 10,
        embedding: int = 50,
        *,
        hidden: int = 50,
        view_direction: bool = True,
        direction_start: float = 1.0,
        offset_color: OffsetColor = "tanh",
        storage: Storage = "hybrid",
        shading_bias: Sequence[float] = (0.5, 0.5, 0.0, 0.0),
        start_opacity: float = 0.0,
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
        if storage not in _EXPLICIT:
            raise unknown("storage", storage, _EXPLICIT)
        self.features = features
        self.offsets = offsets
        self.embedding = embedding
        self.hidden = hidden
        self.view_direction = view_direction
        self.offset_color = offset_color
        self.storage = storage
        self._bias = tuple(shading_bias)
        inputs = features + self.directions + embedding
        for name, attributes in NETWORKS.items():
            if name in self.names:
                decoder = Decoder(inputs, hidden, attributes * offsets, generator)
                with torch.no_grad():
                    decoder.first_weight[:, features : features + self.directions] *= direction_start
                self.add_module(name, decoder)
        first = self.network("opacity")
        outputs = first.second_weight @ torch.relu(first.first_bias) + first.second_bias
        if start_opacity:
            first.start_at(start_opacity, outputs)
        elif direction_start < 1.0:
            first.show_half(outputs)
        if "shading" in self.names:
            with torch.no_grad():
                bias = self.network("shading").second_bias.view(7, offsets)
                bias[3:] += torch.tensor(self._bias, dtype=bias.dtype)[:, None]
        if storage == "implicit":
            self.add_module("offset", Decoder(features + embedding, hidden, 3 * offsets, generator))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the existing networks."""
        explicit = {"partial": ("normal",), "explicit": ("shading", "normal")}.get(self.storage, ())
        more = ("offset",) if self.storage == "implicit" else ()
        return tuple(name for name in NETWORKS if name not in explicit) + more

    @property
    def width(self) -> int:
        """Values of an anchor's feature and the explicit attributes behind it."""
        return self.features + _EXPLICIT[self.storage] * self.offsets

    def initial_explicit(self, count: int, generator: torch.Generator | None) -> Tensor:
        """(count, width - F) initial explicit attributes: normals in random directions, initial biases."""
        normals = torch.randn((count, self.offsets, 3), generator=generator)
        normals = normals / torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
        if self.storage == "partial":
            return normals.flatten(1)  # type: ignore[no-any-return]
        if self.storage == "explicit":
            shading = torch.tensor((0.0, 0.0, 0.0, *self._bias)).expand(count, self.offsets, 7)
            return torch.cat([normals.flatten(1), shading.flatten(1)], 1)
        return torch.empty((count, 0))

    def implicit_offsets(self, features: Tensor, embedding: Tensor) -> Tensor:
        """(N, K, 3) offsets as "implicit" decodes them, from features (N, F) and the embedding (E,)."""
        out = self._outputs("offset", features, embedding).view(len(features), 3, self.offsets)
        offsets: Tensor = out.transpose(1, 2).contiguous()
        return offsets

    @torch.no_grad()
    def shown(self, features: Tensor, embedding: Tensor) -> Tensor:
        """(N, K) of 0 and 1: the Gaussians that are not culled, of decoders that do not see the direction.

        Args:
            features: (N, F).
            embedding: (E,).
        """
        return (self.raw_opacities(features, embedding) > 0.0).to(features.dtype)

    def raw_opacities(self, features: Tensor, embedding: Tensor) -> Tensor:
        """(N, K) opacities before tanh; arguments as those of :meth:`shown`."""
        return self._outputs("opacity", features, embedding)

    def _outputs(self, name: str, features: Tensor, embedding: Tensor) -> Tensor:
        """Outputs of a network whose inputs are the features alone, beside the embedding."""
        first, bias, second, second_bias = self.network(name).tensors()
        width = self.features
        hidden = torch.relu(torch.addmm(bias + first[:, width:] @ embedding, features, first[:, :width].T))
        return torch.addmm(second_bias, hidden, second.T)

    @property
    def directions(self) -> int:
        """Number of inputs for the view direction."""
        return 3 if self.view_direction else 0

    def network(self, name: str) -> Decoder:
        """One of :data:`NETWORKS`."""
        decoder = self.get_submodule(name)
        assert isinstance(decoder, Decoder)
        return decoder

    def tensors(self) -> list[Tensor]:
        """Weights and biases of the existing :data:`NETWORKS`, network by network."""
        return [one for name in NETWORKS if name in self.names for one in self.network(name).tensors()]


def _uniform(shape: tuple[int, ...], fan_in: int, generator: torch.Generator | None) -> nn.Parameter:
    bound = 1.0 / math.sqrt(fan_in)
    return nn.Parameter((2.0 * torch.rand(shape, generator=generator) - 1.0) * bound)
