"""Empty-space bricks: invisible blocks of a scene, and the leaps over them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

BRICK = 4
"""Voxels along a brick's side."""


class Bricks:
    """Value ranges of the bricks of a field, computed once per volume.

    Brick b along an axis covers grid indices [4 b, 4 b + 4]; its range includes one more voxel on either
    side, so that rounding at a border never hides a visible sample.

    Args:
        values: (nz, ny, nx) normalised to [0, 1].
        mask: (nz, ny, nx) bool, True for valid values; None: all are valid.
    """

    def __init__(self, values: NDArray[np.float32], mask: NDArray[np.bool_] | None = None) -> None:
        self.low = _blockwise(values, np.minimum)
        self.high = _blockwise(values, np.maximum)
        self._outside = None if mask is None else ~_blockwise(mask, np.logical_or)

    def empty(self, extinction: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Mask of the bricks that are invisible under a transfer function.

        Args:
            extinction: (S,) table over [0, 1], linear in between.

        Returns:
            Bool array of the bricks' shape (z, y, x).
        """
        size = len(extinction)
        visible_below = np.concatenate([[0], np.cumsum(extinction > 0.0)])
        first = np.floor(self.low * np.float64(size - 1)).astype(np.int64)
        last = np.minimum(np.ceil(self.high * np.float64(size - 1)).astype(np.int64), size - 1)
        # One more entry on either side: look-ups run in float32.
        first, last = np.maximum(first - 1, 0), np.minimum(last + 1, size - 1)
        return self._or_outside(visible_below[last + 1] == visible_below[first])

    def uncrossed(self, levels: Iterable[float]) -> NDArray[np.bool_]:
        """Mask of the bricks that hold none of these levels."""
        margin = 1e-6  # interpolation in float32
        crossed = np.zeros(self.low.shape, dtype=bool)
        for level in levels:
            crossed |= (self.low - margin <= level) & (level <= self.high + margin)
        return self._or_outside(~crossed)

    def _or_outside(self, empty: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return empty if self._outside is None else empty | self._outside


def leaps(empty: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Chebyshev distance in bricks to the nearest visible brick (0: this one).

    A ray in a brick with distance d > 0 meets nothing within d - 1 bricks on any side.
    """
    if empty.all():
        return np.full(empty.shape, max(empty.shape) + 1, dtype=np.int32)
    return np.asarray(distance_transform_cdt(empty, metric="chessboard"), dtype=np.int32)


def _blockwise(values: NDArray[Any], pick: np.ufunc) -> NDArray[Any]:
    """Reduction over each brick and one more voxel on either side."""
    for axis in range(3):
        n = values.shape[axis]
        bricks = max(1, -(-(n - 1) // BRICK))
        shape = values.shape[:axis] + (bricks,) + values.shape[axis + 1 :]
        reduced = np.empty(shape, values.dtype)
        source, target = np.moveaxis(values, axis, 0), np.moveaxis(reduced, axis, 0)
        for b in range(bricks):
            # Pairs of slices keep the walk along memory; a reduction over a strided axis does not.
            first, *rest = range(max(b * BRICK - 1, 0), min((b + 1) * BRICK + 2, n))
            target[b] = source[first]
            for i in rest:
                pick(target[b], source[i], out=target[b])
        values = reduced
    return values
