"""A scalar field on a regular grid, placed in scene space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.scratch import new_array


@dataclass(frozen=True, eq=False)
class Volume:
    """One variable on a regular grid.

    Scene space: the grid's physical box (point data: (n - 1) * spacing along each axis) is
    scaled uniformly so that its longest side is 1, and centred at the origin.

    Attributes:
        name: the variable's name.
        values: (nz, ny, nx) array, x fastest, finite; integer or floating type as stored.
        spacing: physical distance between samples along x, y, z; positive.
        value_range: (low, high) data values mapped to 0 and 1 before the transfer function.
        source: file or generator of the values, for error messages and records.
        mask: (nz, ny, nx) bool, False for samples without data (outside a mesh), which are never visible;
            None: all samples are valid. ``values`` just outside continue those inside, so that
            interpolation and gradients at the border see no jump.
        vertices: (n, 3) float32 scene-space positions of a mesh's own vertices (for initial clouds); None
            for grids.
        vertex_values: (n,) data values of ``vertices``, in the units of ``values``.
        whole: minimum and maximum with the outliers that ``value_range`` leaves out
            (:mod:`.datasets.readers.limits`); None: there are none, or the range is given.
    """

    name: str
    values: NDArray[np.generic]
    spacing: tuple[float, float, float]
    value_range: tuple[float, float]
    source: str
    mask: NDArray[np.bool_] | None = None
    vertices: NDArray[np.float32] | None = None
    vertex_values: NDArray[np.generic] | None = None
    whole: tuple[float, float] | None = None

    @property
    def dims(self) -> tuple[int, int, int]:
        """Samples along x, y, z."""
        nz, ny, nx = self.values.shape
        return nx, ny, nz

    @property
    def extent(self) -> NDArray[np.float64]:
        """(3,) side lengths x, y, z of the box in scene space; the longest is 1."""
        sides = (np.array(self.dims) - 1) * np.array(self.spacing)
        return np.asarray(sides / sides.max(), dtype=np.float64)

    @property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner (3,), (3,) of the box in scene space, centred at the origin."""
        half = 0.5 * self.extent
        return -half, half

    @property
    def voxel(self) -> float:
        """Smallest sample distance in scene space: the unit of the ray step."""
        return float((self.extent / (np.array(self.dims) - 1)).min())

    def normalised(self) -> NDArray[np.float32]:
        """(nz, ny, nx) float32 values with ``value_range`` mapped to [0, 1] and clipped.

        Works slice by slice, without a second copy, into a :func:`.datasets.scratch.new_array`.
        """
        result = new_array(self.values.shape, np.float32)
        for values, out in zip(self.values, result, strict=True):
            out[:] = self.normalise(values)
        return result

    def normalise(self, values: NDArray[np.generic]) -> NDArray[np.float32]:
        """Data values of any shape with ``value_range`` mapped to [0, 1] and clipped, float32."""
        low, high = self.value_range
        # Integers and doubles beyond 24 bits would lose their differences in single precision.
        dtype = values.dtype
        if dtype.itemsize > 4 or (dtype.kind != "f" and dtype.itemsize == 4):
            wide = (values.astype(np.float64) - low) / (high - low)
            return np.clip(wide, 0.0, 1.0).astype(np.float32)
        scaled = (values.astype(np.float32) - np.float32(low)) / np.float32(high - low)
        return np.clip(scaled, 0.0, 1.0, out=scaled)
