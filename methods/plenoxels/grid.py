"""A sparse grid: which vertices of a lattice hold a voxel, and what the voxels hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

ROW = 32
"""Numbers in a row of colors: nine SH coefficients of red, of green and of blue, and five unused zeros."""
SH = 27
"""Floats of a row that hold SH coefficients."""
BRICK = 4
"""Cells along a side of a brick, which rays skip where it is empty."""
_AT_ONCE = 1 << 16  # vertices resampled at once

Triple = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Voxels:
    """What voxels hold, or the gradients or moments of that.

    Attributes:
        densities: (N,).
        colors: (N, 32), see :data:`ROW`.
    """

    densities: Tensor
    colors: Tensor

    @classmethod
    def zeros(cls, count: int, like: Tensor) -> Voxels:
        """Zeros of the type and on the device of a tensor."""
        return cls(like.new_zeros(count), like.new_zeros((count, ROW)))

    def __len__(self) -> int:
        return len(self.densities)


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Voxels on a lattice; between its vertices what they hold is interpolated, absent ones as zeros.

    Attributes:
        links: (nz, ny, nx) int32, number of the voxel at a vertex or -1.
        voxels: what they hold.
        bricks: uint8, by :func:`bricks_of`.
        origin: place of vertex (0, 0, 0).
        spacing: distance of neighbouring vertices.
        unit: length along which a density of 1 has an optical depth of 1.
    """

    links: Tensor
    voxels: Voxels
    bricks: Tensor
    origin: Triple
    spacing: float
    unit: float

    def __len__(self) -> int:
        return len(self.voxels)

    @property
    def size(self) -> tuple[int, int, int]:
        """Vertices along x, y, z."""
        nz, ny, nx = self.links.shape
        return nx, ny, nz

    def placement(self, step: float, factor: float = 1.0) -> list[float]:
        """Origin, vertices per unit of length, optical depth of a step at density 1."""
        return [*self.origin, 1.0 / self.spacing, factor * step / self.unit]

    def finer(self, longest: int, keep: Tensor) -> VoxelGrid:
        """The grid on a lattice of the same box with other vertices.

        A new vertex gets a voxel where a corner of the old cell around it is kept. Density is interpolated.
        So is color, among the old voxels that are there: absent ones have none.

        Args:
            longest: new number of vertices along the longest side.
            keep: (N,) bool, of the old voxels.
        """
        old, device = self.size, self.links.device
        spacing = self.spacing * (max(old) - 1) / (longest - 1)
        size = lattice([(n - 1) * self.spacing for n in old], spacing)
        inside = torch.zeros(self.links.shape, dtype=torch.bool, device=device)
        inside.view(-1)[occupied(self.links)[keep]] = True
        for axis, (many, most) in enumerate(zip(reversed(size), reversed(old), strict=True)):
            low, high, _ = _neighbours(torch.arange(many, device=device) * (spacing / self.spacing), most)
            inside = inside.index_select(axis, low) | inside.index_select(axis, high)
        links = links_of(inside)
        vertices = occupied(links)
        voxels = Voxels.zeros(len(vertices), self.voxels.densities)
        for begin in range(0, len(vertices), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            new = self._resampled(vertices[part], size, spacing / self.spacing)
            voxels.densities[part], voxels.colors[part] = new.densities, new.colors
        return VoxelGrid(links, voxels, bricks_of(links), self.origin, spacing, self.unit)

    def _resampled(self, vertices: Tensor, size: tuple[int, int, int], scale: float) -> Voxels:
        nx, ny, _ = size
        axes = (vertices % nx, vertices // nx % ny, vertices // (nx * ny))
        sides = [_neighbours(one * scale, most) for one, most in zip(axes, self.size, strict=True)]
        result = Voxels.zeros(len(vertices), self.voxels.densities)
        there = torch.zeros_like(result.densities)
        for corner in range(8):
            bits = [corner >> axis & 1 for axis in range(3)]
            x, y, z = (side[bit] for side, bit in zip(sides, bits, strict=True))
            weights = [side[2] if bit else 1.0 - side[2] for side, bit in zip(sides, bits, strict=True)]
            link = self.links[z, y, x].long()
            share = ((weights[0] * weights[1] * weights[2]) * (link >= 0)).to(there)
            link = link.clamp(min=0)
            result.densities.add_(share * self.voxels.densities[link])
            result.colors.add_(share[:, None] * self.voxels.colors[link])
            there += share
        return Voxels(result.densities, result.colors / there[:, None].clamp(min=1e-6))


def _neighbours(places: Tensor, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices below and above places along an axis, and the share of the one above."""
    low = places.floor().long().clamp(0, most - 1)
    high = (low + 1).clamp(max=most - 1)
    return low, high, (places - low).clamp(0.0, 1.0)


def lattice(sides: Sequence[float], spacing: float) -> tuple[int, int, int]:
    """Vertices along x, y, z that cover a box."""
    x, y, z = (max(2, -int(-(side / spacing - 1e-6) // 1) + 1) for side in sides)
    return x, y, z


def occupied(links: Tensor) -> Tensor:
    """Indices of the vertices that hold a voxel, into the flattened lattice, in the order of voxels."""
    flat = links.reshape(-1)
    vertices = (flat >= 0).nonzero()[:, 0]
    result = torch.empty_like(vertices)
    result[flat[vertices].long()] = vertices
    return result


def links_of(inside: Tensor) -> Tensor:
    """Links of the vertices (nz, ny, nx) that hold a voxel, brick after brick: a ray meets few pages."""
    places = inside.nonzero()
    bricks, rest = places // BRICK, places % BRICK
    across = [-(-side // BRICK) for side in inside.shape]
    key = _flat(bricks, across) * BRICK**3 + _flat(rest, [BRICK] * 3)
    links = torch.full(inside.shape, -1, dtype=torch.int32, device=inside.device)
    z, y, x = places[key.argsort()].unbind(1)
    links[z, y, x] = torch.arange(len(places), dtype=torch.int32, device=inside.device)
    return links


def _flat(places: Tensor, shape: Sequence[int]) -> Tensor:
    return (places[:, 0] * shape[1] + places[:, 1]) * shape[2] + places[:, 2]


def bricks_of(links: Tensor, shown: Tensor | None = None) -> Tensor:
    """Whether any cell of each brick of 4 x 4 x 4 cells has a voxel at a corner; uint8.

    Args:
        links: of a grid.
        shown: (N,) bool, the voxels that count; default: all.
    """
    there = links >= 0
    if shown is not None and len(shown):
        there &= shown[links.clamp(min=0).long()]
    pad: list[int] = []
    for side in reversed(links.shape):
        across = -(-(side - 1) // BRICK)
        pad += [0, across * BRICK + 1 - side]
    padded = functional.pad(there.float(), pad)
    pooled = functional.max_pool3d(padded[None, None], BRICK + 1, BRICK)
    return pooled[0, 0].to(torch.uint8)
