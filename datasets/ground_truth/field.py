"""Grids of values in Dr.Jit, fetched trilinearly.

min and max are written as select throughout: LLVM 15 and 16 cannot compile Dr.Jit's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


class Field:
    """A grid of values, and where they count.

    Args:
        values: (nz, ny, nx).
        mask: the same shape, or None.
    """

    def __init__(self, values: NDArray[np.float32], mask: NDArray[np.bool_] | None = None) -> None:
        self.values = mi.Float(aligned(values))
        self.mask = None if mask is None else _bytes()(aligned(mask.view(np.uint8)))
        self.dims = [dr.opaque(mi.Int32, n) for n in reversed(values.shape)]
        self.stride = [
            dr.opaque(mi.Int32, 1),
            self.dims[0],
            dr.opaque(mi.Int32, values.shape[2] * values.shape[1]),
        ]

    def cell(self, at: Any) -> Cell:
        """The cell around a position in grid indices."""
        lower, weight = [], []
        for x, n in zip(at, self.dims, strict=True):
            low = mi.Int32(dr.floor(x))
            low = dr.select(low > n - 2, n - 2, low)
            low = dr.select(low < 0, 0, low)
            w = x - mi.Float(low)
            lower.append(low)
            weight.append(dr.select(w > 1.0, 1.0, dr.select(w > 0.0, w, 0.0)))
        return Cell(self, lower, weight)


class Cell:
    """Eight neighbouring samples and a position between them."""

    def __init__(self, field: Field, lower: list[Any], weight: list[Any]) -> None:
        self._field, self._lower, self._weight = field, lower, weight
        x, y, z = field.stride
        self._base = lower[2] * z + lower[1] * y + lower[0]
        # Corner numbers count x fastest: bit a of the number is the side along axis a.
        self._corners = [self._fetch(o + side) for o in (mi.Int32(0), y, z, y + z) for side in (0, x)]

    def _fetch(self, offset: Any) -> Any:
        return dr.gather(mi.Float, self._field.values, self._base + offset)

    def value(self) -> Any:
        """Trilinear interpolation."""
        near, far = (bilinear(self._corners[i : i + 4], *self._weight[:2]) for i in (0, 4))
        return lerp(near, far, self._weight[2])

    def mask(self) -> Any:
        """Trilinear interpolation of the field's mask."""
        x, y, z = self._field.stride
        near, far = (
            bilinear(
                [
                    mi.Float(dr.gather(_bytes(), self._field.mask, self._base + side + o))
                    for o in (mi.Int32(0), x, y, x + y)
                ],
                *self._weight[:2],
            )
            for side in (mi.Int32(0), z)
        )
        return lerp(near, far, self._weight[2])

    def gradient(self) -> Any:
        """Half of f(x + 1) - f(x - 1) along each axis, in values per grid index.

        As interpolation is linear, both terms need only the corners of this cell and of its neighbours:
        24 fetches more instead of 48.
        """
        result = []
        for axis in range(3):
            stride, first, second = self._field.stride[axis], *(a for a in range(3) if a != axis)
            u, v = self._field.stride[first], self._field.stride[second]
            below = dr.select(self._lower[axis] > 0, -stride, 0)
            above = dr.select(self._lower[axis] < self._field.dims[axis] - 2, 2 * stride, stride)
            at_low, at_high = [], []
            for offset, corner in (
                (mi.Int32(0), 0),
                (u, 1 << first),
                (v, 1 << second),
                (u + v, (1 << first) + (1 << second)),
            ):
                at_low.append(self._corners[corner + (1 << axis)] - self._fetch(offset + below))
                at_high.append(self._fetch(offset + above) - self._corners[corner])
            weights = self._weight[first], self._weight[second]
            low, high = bilinear(at_low, *weights), bilinear(at_high, *weights)
            result.append(0.5 * lerp(low, high, self._weight[axis]))
        return mi.Vector3f(*result)


def _bytes() -> Any:
    return dr.uint8_array_t(mi.Float)


def lerp(a: Any, b: Any, w: Any) -> Any:
    """From a to b."""
    return dr.fma(b - a, w, a)


def bilinear(values: Sequence[Any], first: Any, second: Any) -> Any:
    """Of four values, ``first`` being the weight along the faster axis."""
    return lerp(lerp(values[0], values[1], first), lerp(values[2], values[3], first), second)


def aligned(array: NDArray[Any]) -> NDArray[Any]:
    """The array flat, starting at a multiple of 64 bytes; copied unless it does.

    Dr.Jit maps numpy's memory where it lies, and compiles other code for memory that lies unaligned: without
    this, chance would decide whether a launch finds its kernel compiled.
    """
    if array.ctypes.data % 64 == 0 and array.flags.c_contiguous:
        return array.reshape(-1)
    room = np.empty(array.nbytes + 64, dtype=np.uint8)
    start = -room.ctypes.data % 64
    flat = room[start : start + array.nbytes].view(array.dtype)
    flat[:] = array.ravel()
    return flat
