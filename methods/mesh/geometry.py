"""Triangle meshes of isosurfaces: extraction, decimation, normals, distance from the level set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkSMPTools
from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPolyData
from vtkmodules.vtkFiltersCore import vtkClipPolyData, vtkFlyingEdges3D, vtkTriangleFilter

from econgs_bench.datasets.ground_truth.model import LEVEL_MARGIN, index_transform
from econgs_bench.datasets.scene import Isosurface
from econgs_bench.datasets.volume import Volume
from econgs_bench.methods.interface import Refused

INSTALL = "install it by: pip install 'econgs-bench[rivals]'"
_LEAST_SLOPE = 1e-6  # normalised values per voxel; flatter places have no distance


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        points: (n, 3) float32 positions in scene space.
        faces: (m, 3) int32 indices of points.
    """

    points: NDArray[np.float32]
    faces: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.faces)

    @classmethod
    def of(cls, points: NDArray[np.generic], faces: NDArray[np.generic]) -> Mesh:
        """The mesh of arrays of any numbers."""
        return cls(
            np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 3),
            np.ascontiguousarray(faces, dtype=np.int32).reshape(-1, 3),
        )

    def normals(self) -> NDArray[np.float32]:
        """(n, 3) unit normals of points: the mean of their triangles', weighted by area."""
        points = self.points.astype(np.float64)
        a, b, c = (points[self.faces[:, corner]] for corner in range(3))
        areas = np.cross(b - a, c - a)
        corners = self.faces.ravel(order="F")
        sums = [np.bincount(corners, np.tile(areas[:, axis], 3), len(points)) for axis in range(3)]
        normals = np.stack(sums, axis=-1)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        unit: NDArray[np.float64] = normals / np.maximum(lengths, np.finfo(np.float64).tiny)
        return unit.astype(np.float32)


def level_of(surface: Isosurface) -> float:
    """The level of the ground truth, which is lowered by a margin."""
    return float(np.float32(surface.value - LEVEL_MARGIN))


def extracted(volume: Volume, surfaces: Sequence[Isosurface]) -> Iterator[Mesh]:
    """The isosurfaces of a volume by flying edges; where the volume has a mask, they end with it."""
    vtkSMPTools.Initialize(torch.get_num_threads())
    values = volume.normalised()
    image = vtkImageData()
    image.SetDimensions(*volume.dims)
    image.SetSpacing(*(1.0 / index_transform(volume)[0]))
    image.SetOrigin(*volume.box[0])
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel()))
    for surface in surfaces:
        edges = vtkFlyingEdges3D()
        edges.SetInputData(image)
        edges.ComputeNormalsOff()
        edges.ComputeGradientsOff()
        edges.ComputeScalarsOff()
        edges.SetValue(0, level_of(surface))
        edges.Update()
        found = edges.GetOutput()
        if volume.mask is not None:
            inside = _sampled(volume, volume.mask.astype(np.float32), _mesh(found).points)
            found.GetPointData().SetScalars(numpy_to_vtk(inside, deep=True))
            clip = vtkClipPolyData()
            clip.SetInputData(found)
            clip.SetValue(0.5)
            triangles = vtkTriangleFilter()
            triangles.SetInputConnection(clip.GetOutputPort())
            triangles.Update()
            found = triangles.GetOutput()
        yield _mesh(found)


def decimated(mesh: Mesh, share: float) -> Mesh:
    """The mesh with a share of its triangles, by collapses of edges in the order of their quadric errors.

    Raises:
        Refused: the package is missing.
    """
    if share >= 1.0 or len(mesh) == 0:
        return mesh
    try:
        import fast_simplification
    except ImportError as error:
        raise Refused(f"fast-simplification cannot be imported ({error}); {INSTALL}") from error
    points, faces = fast_simplification.simplify(mesh.points, mesh.faces, target_reduction=1.0 - share)
    return Mesh.of(points, faces)


def distance(volume: Volume, level: float, mesh: Mesh) -> float:
    """Mean distance of the centres of triangles from the level set, in voxels; 0 without triangles.

    To first order: the difference from the level over the slope of the field.
    """
    if len(mesh) == 0:
        return 0.0
    values = volume.normalised()
    centres = mesh.points[mesh.faces].mean(axis=1)
    off = np.abs(_sampled(volume, values, centres) - level)
    slopes = []
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 0.5 * volume.voxel
        slopes.append(_sampled(volume, values, centres + step) - _sampled(volume, values, centres - step))
    slope = np.linalg.norm(slopes, axis=0)
    steep = slope > _LEAST_SLOPE
    return float((off[steep] / slope[steep]).mean()) if steep.any() else 0.0


def _mesh(found: vtkPolyData) -> Mesh:
    """The mesh of VTK's triangles."""
    if found.GetNumberOfPolys() == 0:
        return Mesh.of(np.empty((0, 3)), np.empty((0, 3)))
    points = vtk_to_numpy(found.GetPoints().GetData())
    return Mesh.of(points.copy(), vtk_to_numpy(found.GetPolys().GetConnectivityArray()).copy())


def _sampled(
    volume: Volume, values: NDArray[np.float32], places: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Trilinear interpolation of values of the volume's samples at (n, 3) positions in scene space."""
    scale, offset = index_transform(volume)
    index = (places.astype(np.float64) * scale + offset).T[::-1]
    sampled: NDArray[np.float64] = map_coordinates(values, index, output=np.float64, order=1, mode="nearest")
    return sampled
