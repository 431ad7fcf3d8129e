"""Total variation of voxel grids, and RMSProp on their voxels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from econgs_bench.econgs.codec.hash_grid import compiled, native
from econgs_bench.methods.plenoxels.grid import SH, VoxelGrid, Voxels

EPS = 1e-8


@torch.no_grad()
def variation(
    grid: VoxelGrid, begin: int, count: int, factors: tuple[float, float], spread: float, to: Voxels
) -> float:
    """Total variation of a range of vertices, whose gradient is added to ``to``.

    Of each voxel, and its density and each of its SH coefficients: factor · √(1e-9 + dx² + dy² + dz²), with
    the differences to the next vertices times ``spread``. The difference to a vertex without a voxel is zero.

    Args:
        grid: the grid.
        begin: first vertex of the flattened lattice.
        count: number of vertices; behind the last one follows the first.
        factors: of densities and of coefficients.
        spread: see above.
        to: gradients.

    Returns:
        The sum.
    """
    values = grid.voxels
    if compiled(values.densities):
        pair = np.array(factors, np.float32)
        arrays = (grid.links.numpy(), *_arrays(values))
        total: float = native().voxel_variation(*arrays, begin, count, pair, spread, *_arrays(to))
        return total
    nx, ny, nz = grid.size
    links = grid.links.reshape(-1)
    at = (begin + torch.arange(count, device=links.device)) % len(links)
    at = at[links[at] >= 0]
    own = links[at].long()
    neighbours = []
    places = (at % nx, at // nx % ny, at // (nx * ny))
    for place, most, stride in zip(places, (nx, ny, nz), (1, nx, nx * ny), strict=True):
        link = links[(at + stride).clamp(max=len(links) - 1)].long()
        neighbours.append(torch.where(place + 1 < most, link, -1))
    pairs = (
        (values.densities[:, None], to.densities[:, None]),
        (values.colors[:, :SH], to.colors[:, :SH]),
    )
    return sum(
        _variation(numbers, own, neighbours, factor, spread, slopes)
        for (numbers, slopes), factor in zip(pairs, factors, strict=True)
    )


def _variation(
    values: Tensor, own: Tensor, neighbours: list[Tensor], factor: float, spread: float, to: Tensor
) -> float:
    differences = [
        torch.where((link >= 0)[:, None], (values[link.clamp(min=0)] - values[own]) * spread, 0.0)
        for link in neighbours
    ]
    root = (1e-9 + torch.stack(differences).square().sum(0)).sqrt()
    slope = factor * spread / root
    for link, apart in zip(neighbours, differences, strict=True):
        there = link >= 0
        change = (slope * apart)[there]
        to.index_add_(0, link[there], change)
        to.index_add_(0, own[there], change, alpha=-1.0)
    return factor * float(root.sum())


@torch.no_grad()
def rms_step(values: Voxels, grads: Voxels, moments: Voxels, rates: tuple[float, float], beta: float) -> None:
    """One step of RMSProp, in place, on the rows that have a gradient, which is then cleared.

    The first gradient of a number is its first mean square.

    Args:
        values: the voxels.
        grads: their gradients.
        moments: running means of squared gradients; 0 before the first.
        rates: learning rates of densities and of coefficients.
        beta: decay of the means.
    """
    if compiled(values.densities):
        arrays = (*_arrays(values), *_arrays(grads), *_arrays(moments))
        native().voxel_step(*arrays, np.array(rates, np.float32), beta, EPS)
        return
    for name, rate in zip(("densities", "colors"), rates, strict=True):
        value, grad, moment = (getattr(one, name) for one in (values, grads, moments))
        some = (grad.reshape(len(grad), -1) != 0).any(1).nonzero()[:, 0]
        own, before = grad[some], moment[some]
        square = own.square()
        after = torch.where(before == 0, square, torch.lerp(square, before, beta))
        moment[some] = after
        value[some] -= rate * own / (after.sqrt() + EPS)
        grad.zero_()


def _arrays(voxels: Voxels) -> tuple[np.ndarray, np.ndarray]:
    return voxels.densities.numpy(), voxels.colors.numpy()
