"""The Gaussians of one view, decoded from anchors: masks and splatting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.anchors.shading import Factors, shade
from econgs_bench.econgs.splat.low_pass import LINEAGE, LowPass
from econgs_bench.econgs.splat.rasterise import SplatImages, rasterise


@dataclass(frozen=True)
class Gaussians:
    """Gaussians with the colors of one view, ready to be splatted.

    Attributes:
        means: (M, 3).
        quats: (M, 4) unit quaternions (w, x, y, z).
        scales: (M, 3).
        opacities: (M,) in [0, 1].
        colors: (M, 3) shaded, in [0, 1].
        slots: (M,) int64, the number of each; None: 0 to M - 1.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    slots: Tensor | None = None

    def of(self, rows: Tensor) -> Gaussians:
        """Some of them, by their indices."""
        fields = (self.means, self.quats, self.scales, self.opacities, self.colors)
        return Gaussians(*(values.index_select(0, rows) for values in fields))

    @property
    def numbers(self) -> Tensor:
        """(M,) int64, the number of each in its scene, the same in every view."""
        return torch.arange(len(self.means), device=self.means.device) if self.slots is None else self.slots


@dataclass(frozen=True)
class ViewGaussians(Gaussians):
    """The Gaussians of one view that decoding anchors gives and does not cull, in the order of their slots.

    Attributes:
        slots: (M,) int64, anchor * K + offset, ascending.
        raw_opacities: (N, K) tanh outputs of all Gaussians, also culled ones, without history; for pruning.
        rows: (N,) int64, the rows of these anchors in their scene; None: they are all of it.
    """

    slots: Tensor = field()  # not None, as the base has it
    raw_opacities: Tensor
    rows: Tensor | None = None

    @property
    def numbers(self) -> Tensor:
        if self.rows is None:
            return self.slots
        offsets = self.raw_opacities.shape[1]
        anchors = self.slots.div(offsets, rounding_mode="floor")
        return self.rows.index_select(0, anchors) * offsets + self.slots.remainder(offsets)


@dataclass(frozen=True)
class UnshadedGaussians:
    """Gaussians before they are shaded, which no edit and, unless decoders see it, no direction changes.

    Attributes:
        means, quats, scales, opacities: as of :class:`Gaussians`.
        normals: (M, 3) of any length.
        offset_colors: (M, 3), added to the palette color.
        coefficients: (M, 4) k_a, k_d, k_s, β.
        slots: (M,) int64, anchor * K + offset, ascending.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    normals: Tensor
    offset_colors: Tensor
    coefficients: Tensor
    slots: Tensor

    def of(self, rows: Tensor) -> UnshadedGaussians:
        """Some of the Gaussians, by their indices."""
        return UnshadedGaussians(*(values.index_select(0, rows) for values in vars(self).values()))

    def colors(
        self,
        palette: Tensor,
        eye: Tensor,
        light: Tensor | None,
        factors: Factors,
        backend: str | None = None,
    ) -> Tensor:
        """(M, 3) colors under edits; arguments as for :func:`.econgs.anchors.shading.shade`."""
        base, coefficients = palette + self.offset_colors, factors.on(self.coefficients)
        return shade(self.means, self.normals, base, coefficients, eye, light, backend)


def apply_masks(decoded: ViewGaussians, masks: Tensor) -> ViewGaussians:
    """The Gaussians with mask 1; their opacities and scales carry the mask's gradient (HAC).

    Args:
        decoded: Gaussians of N anchors.
        masks: (N, K) of 0 and 1, or bool: without gradient.
    """
    each = masks.reshape(-1)
    visible = each if each.dtype == torch.bool else each.detach() > 0.0
    stay = visible.index_select(0, decoded.slots).nonzero()[:, 0]
    slots = decoded.slots.index_select(0, stay)
    scales, opacities = decoded.scales.index_select(0, stay), decoded.opacities.index_select(0, stay)
    if each.dtype != torch.bool:
        factor = each.index_select(0, slots)
        scales, opacities = scales * factor[:, None], opacities * factor
    return ViewGaussians(
        decoded.means.index_select(0, stay),
        decoded.quats.index_select(0, stay),
        scales,
        opacities,
        decoded.colors.index_select(0, stay),
        slots,
        decoded.raw_opacities * visible.view(decoded.raw_opacities.shape),
    )


def draw(
    decoded: Sequence[Gaussians],
    camera: Camera,
    screen_offset: Tensor | None = None,
    low_pass: LowPass = LINEAGE,
) -> SplatImages:
    """Splat the Gaussians of one or several scenes together."""

    def all_of(name: str) -> Tensor:
        parts: list[Tensor] = [getattr(one, name) for one in decoded]
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    means, quats, scales, opacities, colors = (
        all_of(name) for name in ("means", "quats", "scales", "opacities", "colors")
    )
    return rasterise(
        means, quats, scales, opacities, colors, camera, screen_offset=screen_offset, low_pass=low_pass
    )
