"""Grids of values in Dr.Jit with trilinear interpolation.

select stands for min and max throughout: LLVM 15 and 16 fail to compile Dr.Jit's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scratch import new_array

MOST_VALUES = 2**31 - 1
"""Values of a grid that Dr.Jit's 32-bit indices reach in pairs."""


class Field:
    """A grid of values with an optional mask.

    Memory holds each value with its neighbour along x, which doubles it: interpolation needs both, and Dr.Jit
    fetches two adjacent floats faster than one, without a branch for each ray.

    Args:
        slices: (ny, nx) values for each z.
        shape: nz, ny, nx.
        mask: bool array of that shape, or None.
        together: bytes of all fields of a scene, by :meth:`bytes_of`.

    Raises:
        DataError: it has more than :data:`MOST_VALUES` values, or lies in a file for which there is no room.

    Attributes:
        values: (nz, ny, nx) view of the values.
    """

    def __init__(
        self,
        slices: Iterable[NDArray[np.float32]],
        shape: tuple[int, ...],
        mask: NDArray[np.bool_] | None = None,
        together: int = 0,
    ) -> None:
        if (count := math.prod(shape)) > MOST_VALUES:
            size = " x ".join(str(n) for n in reversed(shape))
            raise DataError(
                f"a grid of {size}", f"{count} values are more than {MOST_VALUES}", "Subsample the volume"
            )
        pairs = new_array((*shape, 2), np.float32, together)
        for values, out in zip(slices, pairs, strict=True):
            out[..., 0] = values
            out[:, :-1, 1] = values[:, 1:]
            out[:, -1, 1] = values[:, -1]
        self.values = pairs[..., 0]
        self.pairs = mi.Float(aligned(pairs))  # Dr.Jit reads it in place
        self.mask = None if mask is None else _bytes()(aligned(mask.view(np.uint8)))
        self.dims = [dr.opaque(mi.Int32, n) for n in reversed(shape)]
        self.stride = [
            dr.opaque(mi.Int32, 1),
            self.dims[0],
            dr.opaque(mi.Int32, shape[2] * shape[1]),
        ]

    @staticmethod
    def bytes_of(shape: tuple[int, ...]) -> int:
        """Size of a field of (nz, ny, nx) values."""
        return math.prod(shape) * 8

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
        _, y, z = field.stride
        self._base = lower[2] * z + lower[1] * y + lower[0]
        # Corner numbers count x fastest: bit a of the number is the side along axis a.
        self._corners = [value for row in (mi.Int32(0), y, z, y + z) for value in self._fetch(row)]

    def _fetch(self, offset: Any) -> Any:
        """The value at an offset and its neighbour along x."""
        return dr.gather(mi.Vector2f, self._field.pairs, mi.UInt32(self._base + offset))

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

        Interpolation is linear, so both terms need only the corners of this cell and of its neighbours:
        16 more fetches instead of 24.
        """
        _, y, z = self._field.stride
        result = []
        for axis in range(3):
            stride, first, second = self._field.stride[axis], *(a for a in range(3) if a != axis)
            inside = self._lower[axis] < self._field.dims[axis] - 2
            below = dr.select(self._lower[axis] > 0, -stride, 0)
            if axis == 0:
                outer_low = [self._fetch(row + below)[0] for row in (mi.Int32(0), y, z, y + z)]
                right = dr.select(inside, 1, 0)
                outer_high = [self._fetch(row + right)[1] for row in (mi.Int32(0), y, z, y + z)]
            else:
                rows = (mi.Int32(0), z if axis == 1 else y)
                above = dr.select(inside, 2 * stride, stride)
                outer_low = [value for row in rows for value in self._fetch(row + below)]
                outer_high = [value for row in rows for value in self._fetch(row + above)]
            near = [corner for corner in range(8) if not corner & (1 << axis)]
            at_low = [self._corners[c + (1 << axis)] - o for c, o in zip(near, outer_low, strict=True)]
            at_high = [o - self._corners[c] for c, o in zip(near, outer_high, strict=True)]
            weights = self._weight[first], self._weight[second]
            low, high = bilinear(at_low, *weights), bilinear(at_high, *weights)
            result.append(0.5 * lerp(low, high, self._weight[axis]))
        return mi.Vector3f(*result)


def _bytes() -> Any:
    return dr.uint8_array_t(mi.Float)


def lerp(a: Any, b: Any, w: Any) -> Any:
    """Linear interpolation from a to b."""
    return dr.fma(b - a, w, a)


def bilinear(values: Sequence[Any], first: Any, second: Any) -> Any:
    """Bilinear interpolation of four values; ``first`` is the weight along the faster axis."""
    return lerp(lerp(values[0], values[1], first), lerp(values[2], values[3], first), second)


def aligned(array: NDArray[Any]) -> NDArray[Any]:
    """The flat array at an address that is a multiple of 64 bytes; a copy where necessary.

    Dr.Jit maps numpy's memory in place and compiles other code for unaligned memory: without alignment,
    chance would decide whether a launch finds its compiled kernel.
    """
    if array.ctypes.data % 64 == 0 and array.flags.c_contiguous:
        return array.reshape(-1)
    flat = new_array((array.size,), array.dtype)
    flat[:] = array.ravel()
    return flat
