"""Rays through a box of cells: samples in the occupied ones, weights along rays, sums by ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.econgs.codec.hash_grid import compiled, native
from econgs_bench.econgs.rays import Rays

Corner = tuple[float, float, float]
_AT_ONCE = 1024  # rays of a batch in plain PyTorch


@dataclass(frozen=True, eq=False)
class Region:
    """An axis-aligned box that is divided evenly into cells.

    Attributes:
        low, high: its corners.
        cells: (z, y, x) uint8 on the CPU; 0 where a cell is empty.
    """

    low: Corner
    high: Corner
    cells: Tensor

    @property
    def corners(self) -> NDArray[np.float64]:
        """(2, 3) both corners."""
        return np.array([self.low, self.high], dtype=np.float64)


class Samples(NamedTuple):
    """Samples of rays in occupied cells, ray by ray and from front to back.

    Attributes:
        places: (N, 3) float32 in [0, 1]: where in the box.
        rays: (N,) int32, ascending.
        numbers: (N,) int32: sample k of a ray lies at the distance (k + shift) · step.
        first: (B + 1,) int64: first sample of each ray, and N.
    """

    places: Tensor
    rays: Tensor
    numbers: Tensor
    first: Tensor

    def to(self, device: str) -> Samples:
        """The same samples on a device."""
        return Samples(*(one.to(device) for one in self))


def march(region: Region, step: float, rays: Rays, shift: Tensor) -> Samples:
    """Samples of rays, from their origins on.

    Args:
        region: the box.
        step: distance between samples, > 0.
        rays: B rays, float64, on the CPU.
        shift: (B,) float64 in [0, 1], of the samples of each ray, in steps.
    """
    counts = _counts(region, step, rays, shift, 1 << 30)
    first = torch.zeros(len(counts) + 1, dtype=torch.int64)
    torch.cumsum(counts, 0, out=first[1:])
    total = int(first[-1])
    places = torch.empty((total, 3))
    owners, numbers = (torch.empty(total, dtype=torch.int32) for _ in range(2))
    if compiled(places):
        arrays = (
            one.numpy() for one in (rays.origins, rays.directions, shift, first, places, owners, numbers)
        )
        native().place_samples(region.corners, region.cells.numpy(), step, *arrays)
    else:
        for begin in range(0, len(shift), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            where, inside, k = _torch_march(region, step, rays[part], shift[part])
            ray, column = inside.nonzero(as_tuple=True)
            own = slice(int(first[begin]), int(first[begin]) + len(ray))
            places[own], owners[own], numbers[own] = where[inside].float(), ray.int() + begin, k[column].int()
    return Samples(places, owners, numbers, first)


def hits(region: Region, step: float, rays: Rays) -> Tensor:
    """(B,) whether a ray has any sample, at shift ½."""
    shift = torch.full((len(rays),), 0.5, dtype=torch.float64)
    return _counts(region, step, rays, shift, 1) > 0


def _counts(region: Region, step: float, rays: Rays, shift: Tensor, most: int) -> Tensor:
    counts = torch.zeros(len(shift), dtype=torch.int32)
    if compiled(torch.empty(0)):
        arrays = [one.numpy() for one in (rays.origins, rays.directions, shift)]
        native().count_samples(region.corners, region.cells.numpy(), step, *arrays, most, counts.numpy())
        return counts
    for begin in range(0, len(shift), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        _, inside, _ = _torch_march(region, step, rays[part], shift[part])
        counts[part] = inside.sum(1).clamp(max=most).int()
    return counts


def _torch_march(region: Region, step: float, rays: Rays, shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Places (B, K, 3) in the box, whether they are in occupied cells (B, K), and their numbers (K,)."""
    low, high = torch.from_numpy(region.corners)
    by = step * rays.directions / (high - low)
    start = (rays.origins - low) / (high - low) + shift[:, None] * by
    safe = torch.where(by == 0, torch.full_like(by, 1e-30), by)
    one, other = -start / safe, (1.0 - start) / safe
    enter = torch.minimum(one, other).amax(1).clamp(min=0.0)
    leave = torch.maximum(one, other).amin(1)
    met = leave >= enter
    begin = int(enter[met].min().floor()) if bool(met.any()) else 0
    end = int(leave[met].max().ceil()) + 1 if bool(met.any()) else 0
    k = torch.arange(begin, end)
    where = start[:, None] + k[:, None] * by[:, None]
    inside = (k >= enter.ceil()[:, None]) & (k <= leave.floor()[:, None])
    where = where.clamp(0.0, 1.0)
    across = torch.tensor(region.cells.shape[::-1])
    x, y, z = torch.minimum((where * across).long(), across - 1).unbind(-1)
    return where, inside & (region.cells[z, y, x] > 0), k


# --------------------------------------------------------------------------- along rays


class _RayWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, depths: Tensor, first: Tensor) -> Tensor:  # type: ignore[override]
        depths = depths.detach().contiguous()
        weights = torch.empty_like(depths)
        native().ray_weights(depths.numpy(), first.numpy(), weights.numpy())
        ctx.save_for_backward(depths, first)
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        depths, first = ctx.saved_tensors
        to = torch.empty_like(depths)
        native().ray_weights_backward(depths.numpy(), first.numpy(), grad.contiguous().numpy(), to.numpy())
        return to, None


def ray_weights(depths: Tensor, samples: Samples) -> Tensor:
    """Weights (N,) of samples in their pixels: T (1 − exp(−depth)), T of all optical depth before."""
    if compiled(depths):
        weights: Tensor = _RayWeights.apply(depths, samples.first)
        return weights
    until = torch.cat([depths.new_zeros(1, dtype=torch.float64), depths.double().cumsum(0)])
    before = until[:-1] - until[samples.first[:-1]][samples.rays.long()]
    return (torch.exp(-before) * -torch.expm1(-depths.double())).to(depths)


class _RaySums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, rays: Tensor, count: int) -> Tensor:  # type: ignore[override]
        rows = rows.detach().contiguous()
        sums = rows.new_zeros((count, rows.shape[1]))
        native().ray_sums(rows.numpy(), rays.numpy(), sums.numpy())
        ctx.save_for_backward(rays)
        return sums

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (rays,) = ctx.saved_tensors
        return grad[rays.long()], None, None


def ray_sums(rows: Tensor, rays: Tensor, count: int) -> Tensor:
    """Sums (count, W) of the rows (N, W) of each ray.

    Args:
        rows: values of samples.
        rays: (N,) int32, the ray of each.
        count: number of rays.
    """
    if compiled(rows):
        sums: Tensor = _RaySums.apply(rows, rays, count)
        return sums
    return rows.new_zeros((count, rows.shape[1])).index_add(0, rays.long(), rows)
