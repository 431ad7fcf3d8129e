"""Empty-space bricks: invisible blocks of a scene, and the leaps over them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_cdt

from econgs_bench.datasets.scratch import new_array

BRICK = 2
"""Voxels along a brick's side."""


class Bricks:
    """Value ranges of the bricks of a field, found once per volume while its slices :meth:`pass <passing>`.

    Brick b along an axis covers grid indices [2 b, 2 b + 2], borders included: what lies in it is
    interpolated between samples of that range.

    Args:
        shape: nz, ny, nx of the field.
        mask: bool of that shape, True for valid values; None: all are valid.
        together: bytes of all that is held with them (:func:`.datasets.scratch.new_array`).

    Attributes:
        low, high: float32 least and greatest normalised value of each brick (z, y, x).
    """

    def __init__(
        self, shape: tuple[int, ...], mask: NDArray[np.bool_] | None = None, together: int = 0
    ) -> None:
        counts = tuple(max(1, -(-(n - 1) // BRICK)) for n in shape)
        self.low, self.high = (new_array(counts, np.float32, together) for _ in range(2))
        self.low.fill(np.inf)
        self.high.fill(-np.inf)
        self._outside = None
        if mask is not None:
            valid = np.zeros(counts, dtype=bool)
            for z, plane in enumerate(mask):
                _add(valid, z, plane, np.logical_or)
            self._outside = ~valid

    def passing(self, slices: Iterable[NDArray[np.float32]]) -> Iterator[NDArray[np.float32]]:
        """The same (ny, nx) slices of normalised values, z by z; their ranges are taken on the way."""
        for z, values in enumerate(slices):
            _add(self.low, z, values, np.minimum)
            _add(self.high, z, values, np.maximum)
            yield values

    def empty(self, extinction: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Mask of the bricks that are invisible under a transfer function.

        Args:
            extinction: (S,) table over [0, 1], linear in between.

        Returns:
            Bool array of the bricks' shape (z, y, x).
        """
        size = len(extinction)
        visible_below = np.concatenate([[0], np.cumsum(extinction > 0.0)])
        empty = np.empty(self.low.shape, dtype=bool)
        for low, high, out in zip(self.low, self.high, empty, strict=True):
            first = np.floor(low * np.float64(size - 1)).astype(np.int64)
            last = np.minimum(np.ceil(high * np.float64(size - 1)).astype(np.int64), size - 1)
            # One more entry on either side: look-ups run in float32.
            first, last = np.maximum(first - 1, 0), np.minimum(last + 1, size - 1)
            out[:] = visible_below[last + 1] == visible_below[first]
        return self._or_outside(empty)

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


def _add(bricks: NDArray[Any], z: int, plane: NDArray[Any], pick: np.ufunc) -> None:
    """Reduce a slice into the bricks that hold it: one, or the two on whose border it lies."""
    reduced = _reduced(_reduced(plane, pick, 0), pick, 1)
    for brick in bricks[max(0, (z - 1) // BRICK) : z // BRICK + 1]:
        pick(brick, reduced, out=brick)


def _reduced(values: NDArray[Any], pick: np.ufunc, axis: int) -> NDArray[Any]:
    """Reduction of (., .) over each brick along an axis, borders included."""
    n = values.shape[axis]
    starts = BRICK * np.arange(max(1, -(-(n - 1) // BRICK)))
    result: NDArray[Any] = np.take(values, starts, axis)
    for offset in range(1, BRICK + 1):
        pick(result, np.take(values, np.minimum(starts + offset, n - 1), axis), out=result)
    return result
