"""Values and gradients of a volume at points: what the first Gaussians carry."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.ground_truth.model import index_transform
from econgs_bench.datasets.volume import Volume


def values_at(volume: Volume, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N,) normalised values at (N, 3) positions in scene space: trilinear, clamped at the border."""
    return _interpolated(volume, _grid_index(volume, points))


def gradients_at(volume: Volume, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N, 3) gradients in scene space: central differences over one voxel to either side."""
    scale, _ = index_transform(volume)
    index = _grid_index(volume, points)
    sides = [_interpolated(volume, index + one) - _interpolated(volume, index - one) for one in np.eye(3)]
    return np.stack(sides, axis=-1) * (0.5 * scale)


def _grid_index(volume: Volume, points: NDArray[np.floating]) -> NDArray[np.float64]:
    scale, offset = index_transform(volume)
    return np.asarray(points, dtype=np.float64) * scale + offset


def _interpolated(volume: Volume, index: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values at grid indices (N, 3), x y z. Eight samples a point: the volume is never copied as a whole."""
    last = np.array(volume.dims) - 1
    index = np.clip(index, 0.0, last)
    cell = np.minimum(index.astype(np.int64), np.maximum(last - 1, 0))
    share = index - cell
    total = np.zeros(len(index))
    for corner in product((0, 1), repeat=3):
        x, y, z = np.minimum(cell + corner, last).T
        weight = np.where(corner, share, 1.0 - share).prod(axis=1)
        total += weight * volume.normalise(volume.values[z, y, x])
    return total
