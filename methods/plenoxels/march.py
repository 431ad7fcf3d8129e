"""Emission and absorption along rays through voxel grids, and its gradients.

Samples lie at (k + ½) · step from the eye, for whole k, wherever the grids are: empty space that is skipped
changes nothing. A sample of density σ has the opacity 1 − exp(−σ · step / unit) and the color max(0, ½ + SH);
density and coefficients are interpolated from eight vertices. Where several grids overlap, densities add and
colors mix by density.

The compiled kernels (``native/kernels/voxels.h``) take float32 tensors on the CPU; PyTorch does the rest, and
is the reference of the tests in float64.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from econgs_bench.econgs.codec.hash_grid import compiled, native
from econgs_bench.econgs.rays import Rays
from econgs_bench.econgs.splat.sh import harmonics
from econgs_bench.methods.plenoxels.grid import SH, VoxelGrid, Voxels

LEAST_DENSITY = 1e-8
"""Samples of less are empty (published)."""
LEAST_THROUGH = 1e-7
"""A ray ends when its transmittance falls under it (published)."""
STEP = 0.5
"""Between samples, of the spacing of vertices (published)."""
_AT_ONCE = 4096  # rays drawn at once by torch


@torch.no_grad()
def drawn(
    grids: Sequence[VoxelGrid], rays: Rays, factors: Sequence[float] | None = None
) -> tuple[Tensor, Tensor]:
    """Premultiplied colors (B, 3) and alpha (B,) of rays through grids that are drawn together.

    Args:
        grids: at least one.
        rays: on their device.
        factors: on the density of each grid; default: 1.
    """
    factors = [1.0] * len(grids) if factors is None else factors
    step = STEP * min(grid.spacing for grid in grids)
    if not compiled(grids[0].voxels.densities):
        parts = [
            _torch_march(grids, rays[begin : begin + _AT_ONCE], factors, step)
            for begin in range(0, len(rays), _AT_ONCE)
        ]
        colors, alphas = zip(*parts, strict=True)
        return torch.cat(colors), torch.cat(alphas)
    color, alpha = _outputs(rays)
    placements = np.array([grid.placement(step, f) for grid, f in zip(grids, factors, strict=True)])
    columns = zip(*(_grid_arrays(grid) for grid in grids), strict=True)
    native().march(*map(list, columns), placements, step, *_arrays(rays), color.numpy(), alpha.numpy(), False)
    return color, alpha


@dataclass(frozen=True, eq=False)
class Trace:
    """What a batch of rays sees, and the way back.

    Attributes:
        colors: (B, 3) premultiplied.
        alpha: (B,).
        backward: adds to a third argument the gradients of the grid's voxels, from those of colors and of
            alpha; once.
    """

    colors: Tensor
    alpha: Tensor
    backward: Callable[[Tensor, Tensor, Voxels], None]


def trace(grid: VoxelGrid, rays: Rays) -> Trace:
    """Rays through one grid, for training."""
    step = STEP * grid.spacing
    if not compiled(grid.voxels.densities):
        return _torch_trace(grid, rays, step)
    color, alpha = _outputs(rays)
    placement = np.array(grid.placement(step))
    of_grid = _grid_arrays(grid)
    lists = ([one] for one in of_grid)
    frame = native().march(*lists, placement[None], step, *_arrays(rays), color.numpy(), alpha.numpy(), True)

    def backward(grad_colors: Tensor, grad_alpha: Tensor, to: Voxels) -> None:
        grads = (_of(grad_colors), _of(grad_alpha))
        native().march_backward(frame, *of_grid, placement, *grads, to.densities.numpy(), to.colors.numpy())

    return Trace(color, alpha, backward)


@torch.no_grad()
def voxel_weights(grid: VoxelGrid, rays: Rays, most: Tensor) -> None:
    """Raise ``most`` (N,) to the largest weight that a sample of any ray beside a voxel has in its pixel."""
    step = STEP * grid.spacing
    if not compiled(grid.voxels.densities):
        for begin in range(0, len(rays), _AT_ONCE):
            part = _samples([grid], rays[begin : begin + _AT_ONCE], [1.0], step)
            weights = part.weights[part.shown]
            corners = part.corners[0][part.shown]
            there = corners >= 0
            spread = weights[:, None].expand(corners.shape)[there]
            most.scatter_reduce_(0, corners[there], spread, "amax")
        return
    placement = np.array(grid.placement(step))
    native().voxel_weights(*_grid_arrays(grid), placement, step, *_arrays(rays), most.numpy())


def _of(tensor: Tensor) -> np.ndarray:
    array: np.ndarray = tensor.detach().contiguous().numpy()
    return array


def _grid_arrays(grid: VoxelGrid) -> tuple[np.ndarray, ...]:
    return _of(grid.links), _of(grid.voxels.densities), _of(grid.voxels.colors), _of(grid.bricks)


def _arrays(rays: Rays) -> tuple[np.ndarray, ...]:
    return _of(rays.origins), _of(rays.directions), _of(rays.near)


def _outputs(rays: Rays) -> tuple[Tensor, Tensor]:
    return torch.empty((len(rays), 3)), torch.empty(len(rays))


# --------------------------------------------------------------------------- PyTorch


@dataclass(frozen=True, eq=False)
class _Samples:
    """All samples of rays: (B, K), and (B, K, 8) corners by grid."""

    corners: list[Tensor]  # voxels, or -1
    shares: list[Tensor]  # trilinear weights
    depths: list[Tensor]  # optical depths
    shown: Tensor  # neither empty nor hidden
    weights: Tensor


def _samples(grids: Sequence[VoxelGrid], rays: Rays, factors: Sequence[float], step: float) -> _Samples:
    like = grids[0].voxels.densities
    spans = [_span(grid, rays, step) for grid in grids]
    first = min(int(low.min()) for low, _ in spans) if len(rays) else 0
    last = max(int(high.max()) for _, high in spans) if len(rays) else -1
    counts = torch.arange(first, max(first, last + 1), device=like.device)
    corners, shares, depths = [], [], []
    for grid, factor, (low, high) in zip(grids, factors, spans, strict=True):
        inside = (counts >= low[:, None]) & (counts <= high[:, None])
        at = (rays.origins[:, None] + ((counts + 0.5) * step)[:, None] * rays.directions[:, None]).to(like)
        at = (at - like.new_tensor(grid.origin)) / grid.spacing
        size = torch.tensor(grid.size, device=like.device)
        inside = inside & (at >= 0).all(-1) & (at < size - 1).all(-1)
        at = torch.where(inside[..., None], at, 0.0)
        cell = at.floor().long()
        share = at - cell
        links, weights = [], []
        for corner in range(8):
            bits = [corner >> axis & 1 for axis in range(3)]
            x, y, z = (cell[..., axis] + bits[axis] for axis in range(3))
            links.append(torch.where(inside, grid.links[z, y, x].long(), -1))
            one = [share[..., axis] if bits[axis] else 1.0 - share[..., axis] for axis in range(3)]
            weights.append(one[0] * one[1] * one[2])
        corners.append(torch.stack(links, -1))
        shares.append(torch.stack(weights, -1) * (corners[-1] >= 0))
        if len(grid):
            density = (shares[-1] * grid.voxels.densities[corners[-1].clamp(min=0)]).sum(-1)
        else:
            density = shares[-1].sum(-1)
        density = torch.where(density > LEAST_DENSITY, density, 0.0)
        depths.append(density * (factor * step / grid.unit))
    depth = torch.stack(depths).sum(0)
    before = torch.exp(depth - depth.cumsum(1))
    shown = (depth > 0) & (before.detach() >= LEAST_THROUGH)
    weights_ = torch.where(shown, before * -torch.expm1(-depth), 0.0)
    return _Samples(corners, shares, depths, shown, weights_)


def _span(grid: VoxelGrid, rays: Rays, step: float) -> tuple[Tensor, Tensor]:
    """Numbers (B,) of the first and last sample of each ray within a grid's box."""
    origins, directions = rays.origins.double(), rays.directions.double()
    low = origins.new_tensor(grid.origin)
    high = low + (torch.tensor(grid.size, device=origins.device) - 1) * grid.spacing
    safe = torch.where(directions == 0, torch.full_like(directions, 1e-30), directions)
    one, other = (low - origins) / safe, (high - origins) / safe
    enter = torch.minimum(one, other).amax(1).clamp(min=0.0).maximum(rays.near.double())
    leave = torch.maximum(one, other).amin(1)
    first, last = (enter / step - 0.5).ceil(), (leave / step - 0.5).floor()
    missed = last < first
    return torch.where(missed, 0, first).long(), torch.where(missed, -1, last).long()


def _torch_march(
    grids: Sequence[VoxelGrid], rays: Rays, factors: Sequence[float], step: float
) -> tuple[Tensor, Tensor]:
    samples = _samples(grids, rays, factors, step)
    like = grids[0].voxels.densities
    basis = harmonics(2, rays.directions.to(like))
    shown = samples.shown
    at, _ = shown.nonzero(as_tuple=True)
    colors = like.new_zeros((len(at), 3))
    total = torch.stack(samples.depths).sum(0)[shown]
    for grid, corners, shares, depths in zip(
        grids, samples.corners, samples.shares, samples.depths, strict=True
    ):
        if not len(grid):
            continue
        own = depths[shown]
        rows = grid.voxels.colors[:, :SH][corners[shown].clamp(min=0)]  # M x 8 x 27
        mixed = (shares[shown][..., None] * rows).sum(1).reshape(-1, 3, 9)
        color = ((mixed * basis[at][:, None]).sum(-1) + 0.5).clamp(min=0.0)
        colors = colors + color * (own / total)[:, None]
    weights = samples.weights[shown]
    picture = like.new_zeros((len(rays), 3)).index_add(0, at, weights[:, None] * colors)
    return picture, samples.weights.sum(1)


def _torch_trace(grid: VoxelGrid, rays: Rays, step: float) -> Trace:
    leaves = Voxels(*(one.detach().requires_grad_(True) for one in vars(grid.voxels).values()))
    with torch.enable_grad():
        colors, alpha = _torch_march([replace(grid, voxels=leaves)], rays, [1.0], step)

    def backward(grad_colors: Tensor, grad_alpha: Tensor, to: Voxels) -> None:
        if not alpha.requires_grad:  # no voxel at all
            return
        both = [leaves.densities, leaves.colors]
        outer = [grad_colors, grad_alpha]
        grads = torch.autograd.grad([colors, alpha], both, outer, allow_unused=True)
        for target, grad in zip((to.densities, to.colors), grads, strict=True):
            if grad is not None:
                target += grad

    return Trace(colors.detach(), alpha.detach(), backward)
