"""Unstructured meshes: checked, and resampled to a grid by VTK."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.axes import fill_outside
from econgs_bench.datasets.readers.fields import Choice, Field
from econgs_bench.datasets.readers.limits import shown

DEFAULT_RESOLUTION = 128
"""Samples along the longest side of a mesh's box."""

CELL_NODES = {
    10: 4, 11: 8, 12: 8, 13: 6, 14: 5, 15: 10, 16: 12,  # linear
    24: 10, 25: 20, 26: 15, 27: 13, 29: 27, 32: 18, 33: 24, 37: 19,  # quadratic
}  # fmt: skip
"""Nodes per cell of VTK's supported three-dimensional cell types."""

_FLAT = frozenset({0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 21, 22, 23, 28, 30, 34, 35, 36})
"""Cell types without a volume; readers drop them."""
_MAX_RESOLUTION = 2048
_OVERLAP = 64.0
_REMEDY = "Copy it again, or write it again with VTK or ParaView"


@dataclass(frozen=True, eq=False)
class Mesh:
    """Unstructured cells.

    Attributes:
        points: (n, 3) positions.
        connectivity: (m,) int64 point indices of all cells, cell by cell.
        ends: (cells,) int64 end of each cell in ``connectivity``.
        types: (cells,) uint8, VTK's cell types.
    """

    points: NDArray[np.generic]
    connectivity: NDArray[np.int64]
    ends: NDArray[np.int64]
    types: NDArray[np.uint8]

    @staticmethod
    def joined(pieces: list[Mesh], path: Path) -> Mesh:
        """Several meshes as one, checked.

        Raises:
            DataError: a cell refers to points that do not exist, or positions are not finite.
        """
        for mesh in pieces:
            mesh._check(path)
        if len(pieces) == 1:
            return pieces[0]
        shifts = np.cumsum([0, *(len(p.points) for p in pieces)])
        ends = np.cumsum([0, *(len(p.connectivity) for p in pieces)])
        return Mesh(
            np.concatenate([p.points for p in pieces]),
            np.concatenate([p.connectivity + s for p, s in zip(pieces, shifts, strict=False)]),
            np.concatenate([p.ends + e for p, e in zip(pieces, ends, strict=False)]),
            np.concatenate([p.types for p in pieces]),
        )

    def _check(self, path: Path) -> None:
        counts = np.diff(self.ends, prepend=0)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.points.dtype.kind not in "iuf":
            raise DataError(path, "its points are not positions x, y, z", _REMEDY)
        if not np.isfinite(self.points).all() or (np.abs(self.points) > 1e30).any():
            raise DataError(path, "a point is not finite", _REMEDY)
        if len(self.types) != len(self.ends) or not len(self.ends) or counts.min() < 0:
            raise DataError(path, "its cells are damaged", _REMEDY)
        if self.ends[-1] != len(self.connectivity):
            raise DataError(path, "its cells are damaged: they end elsewhere than their points", _REMEDY)
        if len(self.connectivity) and not (
            self.connectivity.min() >= 0 and self.connectivity.max() < len(self.points)
        ):
            raise DataError(path, "a cell refers to a point that does not exist", _REMEDY)
        for kind in np.unique(self.types):
            nodes = CELL_NODES.get(int(kind))
            if nodes is not None and (counts[self.types == kind] != nodes).any():
                raise DataError(path, f"a cell of type {kind} has not {nodes} points", _REMEDY)
            if nodes is None and int(kind) not in _FLAT:
                remedy = "Tetrahedralize it in ParaView; linear and quadratic cells are read"
                raise DataError(path, f"has cells of VTK's type {kind} (polyhedra, say)", remedy)


def resampled(
    mesh: Mesh,
    values: NDArray[np.generic],
    of_cells: bool,
    choice: Choice,
    path: Path,
    valid: NDArray[np.bool_] | None = None,
) -> Field:
    """A mesh's field on a grid over its bounding box.

    VTK interpolates in the cell around each sample. Outside the mesh, and in cells that have a missing value,
    the mask is False and values continue those inside.

    Args:
        mesh: result of :meth:`Mesh.joined`.
        values: (points,), or (cells,), averaged to the points.
        of_cells: whether ``values`` belong to cells.
        choice: its resolution and limits.
        path: the file, for messages.
        valid: of the shape of ``values``, False for missing ones.

    Raises:
        DataError: values are no finite numbers, no cell has a volume, the mesh is flat, or no sample lies
            inside.
    """
    n = DEFAULT_RESOLUTION if choice.resolution is None else choice.resolution
    if not 2 <= n <= _MAX_RESOLUTION:
        raise DataError(
            path, f"resolution {n}", f"Choose 2 to {_MAX_RESOLUTION} samples along the longest side"
        )
    if values.dtype.kind not in "biuf":
        raise DataError(path, f"values of type {values.dtype} are no scalar field", _REMEDY)
    if len(values) != (len(mesh.ends) if of_cells else len(mesh.points)):
        raise DataError(path, f"has {len(values)} values for its points or cells", _REMEDY)
    solid = np.isin(mesh.types, list(CELL_NODES))
    if not solid.any():
        raise DataError(path, "has no cells with a volume", "Surfaces cannot be shown as volumes")
    counts = np.diff(mesh.ends, prepend=0)
    corners = np.zeros(len(mesh.points), dtype=bool)
    corners[mesh.connectivity[np.repeat(solid, counts)]] = True
    box = mesh.points[corners].astype(np.float64)
    low, high = box.min(axis=0), box.max(axis=0)
    some = solid if of_cells else corners
    found = shown(values[some], None if valid is None else valid[some], choice.limits, path)
    if found.valid is not None:
        usable = np.ones(len(values), dtype=bool)
        usable[some] = found.valid
        solid = solid & (usable if of_cells else _all_of(usable[mesh.connectivity], mesh.ends))
    if not solid.any():
        raise DataError(path, "has no cell whose values are all valid", "Choose another variable")
    connectivity = mesh.connectivity[np.repeat(solid, counts)]
    counts, types = counts[solid], mesh.types[solid]
    used, connectivity = np.unique(connectivity, return_inverse=True)
    points = np.ascontiguousarray(mesh.points[used], dtype=np.float64)
    kind = np.float64 if values.dtype.itemsize > 4 else np.float32
    if of_cells:
        each = np.repeat(values[solid].astype(np.float64), counts)
        total = np.bincount(connectivity, each, len(used))
        at_points = (total / np.bincount(connectivity, minlength=len(used))).astype(kind)
    else:
        at_points = values[used].astype(kind)
    sides = high - low
    longest = float(sides.max())
    if sides.min() <= 1e-6 * longest:
        raise DataError(path, "is flat: its points lie in a plane", "Surfaces cannot be shown as volumes")
    dims = np.maximum(np.rint(sides / longest * (n - 1)).astype(int) + 1, 2)
    spacing = sides / (dims - 1)
    local = (points - low) / longest  # conditions VTK's tolerances
    offsets = np.concatenate([[0], np.cumsum(counts)])
    _check_overlap(local, connectivity, offsets, spacing / longest, dims, path)
    grid, mask = _probe(local, connectivity, offsets, types, at_points, dims, spacing / longest)
    if not mask.any():
        raise DataError(path, "no sample lies inside the mesh", "Ask for a higher resolution")
    np.clip(grid, at_points.min(), at_points.max(), out=grid)  # quadratic cells overshoot
    value_range = (float(at_points.min()), float(at_points.max()))  # cells' values after averaging
    if choice.limits.value_range not in (None, "all") or value_range[0] == value_range[1]:
        value_range = found.value_range
    outside = not mask.all()
    if outside:
        fill_outside(grid, mask, value_range[0])
    size = (float(spacing[0]), float(spacing[1]), float(spacing[2]))
    vertices = (local - 0.5 * sides / longest).astype(np.float32)
    shape = mask if outside else None
    return Field(grid, size, shape, value_range, found.whole, vertices, at_points)


def _all_of(flags: NDArray[np.bool_], ends: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Per cell, whether all of its flags are set."""
    unset = np.concatenate([[0], np.cumsum(~flags)])
    starts = np.concatenate([[0], ends[:-1]])
    return np.asarray(unset[ends] == unset[starts])


def _check_overlap(
    points: NDArray[np.float64],
    connectivity: NDArray[np.int64],
    offsets: NDArray[np.int64],
    spacing: NDArray[np.float64],
    dims: NDArray[np.int_],
    path: Path,
) -> None:
    """Refuse meshes whose cells overlap many times: probing them would take hours."""
    nodes = points[connectivity]
    low = np.minimum.reduceat(nodes, offsets[:-1])
    high = np.maximum.reduceat(nodes, offsets[:-1])
    work = float(np.prod((high - low) / spacing + 1.0, axis=1).sum())
    if work > _OVERLAP * (float(np.prod(dims.astype(float))) + len(offsets)):
        raise DataError(path, "its cells overlap many times (damaged connectivity?)", _REMEDY)


def _probe(
    points: NDArray[np.float64],
    connectivity: NDArray[np.int64],
    offsets: NDArray[np.int64],
    types: NDArray[np.uint8],
    values: NDArray[Any],
    dims: NDArray[np.int_],
    spacing: NDArray[np.float64],
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Values (nz, ny, nx) and whether each sample lies inside, by vtkProbeFilter."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkImageData, vtkUnstructuredGrid
    from vtkmodules.vtkFiltersCore import vtkProbeFilter

    cells = vtkCellArray()
    ids = [numpy_to_vtk(np.ascontiguousarray(a, np.int64), deep=1) for a in (offsets, connectivity)]
    cells.SetData(*ids)
    nodes = vtkPoints()
    nodes.SetData(numpy_to_vtk(points, deep=1))
    grid = vtkUnstructuredGrid()
    grid.SetPoints(nodes)
    grid.SetCells(numpy_to_vtk(np.ascontiguousarray(types), deep=1), cells)
    field = numpy_to_vtk(np.ascontiguousarray(values), deep=1)
    field.SetName("field")
    grid.GetPointData().AddArray(field)
    image = vtkImageData()
    image.SetDimensions(*(int(n) for n in dims))
    image.SetSpacing(*(float(s) for s in spacing))
    probe = vtkProbeFilter()
    probe.SetInputData(image)
    probe.SetSourceData(grid)
    probe.Update()
    output = probe.GetOutput().GetPointData()
    shape = tuple(int(n) for n in reversed(dims))
    sampled = vtk_to_numpy(output.GetArray("field")).reshape(shape).copy()
    valid = vtk_to_numpy(output.GetArray(probe.GetValidPointMaskArrayName())).reshape(shape) != 0
    return sampled, valid
