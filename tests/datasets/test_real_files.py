"""Readers of variables by name on the real files of the data folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import vtk
from vtk.util.numpy_support import vtk_to_numpy

from econgs_bench.bench.plan.inputs import absolute
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.cloud import initial_cloud
from econgs_bench.datasets.readers import list_variables, read_volume

pytestmark = pytest.mark.data

CTH = "cth_impact/cth.vtr"


def _output(reader: Any, path: Path) -> Any:
    """What VTK's reader makes of a file."""
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def test_impact_as_vtk_reads_it(data_folder: Path) -> None:
    grid = _output(vtk.vtkXMLRectilinearGridReader(), data_folder / CTH)
    variables = list_variables(data_folder / CTH)
    assert len(variables) == 9
    assert {v.dims for v in variables} == {(128, 64, 64)}
    volume = read_volume(data_folder / CTH, "Pressure")
    assert volume.dims == (164, 64, 95)  # its cells are uneven along x and z
    centres = []
    for axis in (grid.GetXCoordinates(), grid.GetYCoordinates(), grid.GetZCoordinates()):
        edges = vtk_to_numpy(axis)
        centres.append(0.5 * (edges[1:] + edges[:-1]))
    stored = vtk_to_numpy(grid.GetCellData().GetArray("Pressure")).reshape(64, 64, 128)
    low, high = (np.array([c[i] for c in centres]) for i in (0, -1))
    np.testing.assert_allclose(np.array(volume.spacing) * (np.array(volume.dims) - 1), high - low)
    at = np.round((centres[0] - low[0]) / volume.spacing[0], 9)
    shared = at == np.rint(at)  # cell centres that are samples of the even grid
    assert shared.sum() >= 2
    here = volume.values[:, :, at[shared].astype(int)]
    np.testing.assert_allclose(here[0], stored[0][:, shared], rtol=1e-4, atol=1e4)  # of 1e11
    np.testing.assert_allclose(here[-1], stored[-1][:, shared], rtol=1e-4, atol=1e4)


@pytest.mark.parametrize("step", ["02", "05"])
def test_hurricane_as_vtk_reads_it(data_folder: Path, step: str) -> None:
    path = data_folder / "isabel_wind" / f"isabel_wind_{step}.vti"
    grid = _output(vtk.vtkXMLImageDataReader(), path)
    expected = vtk_to_numpy(grid.GetPointData().GetScalars()).reshape(25, 125, 125)
    volume = read_volume(path)
    assert volume.name == "velocityMag"
    np.testing.assert_array_equal(volume.values, expected)
    assert volume.spacing == pytest.approx(grid.GetSpacing())


def test_fire_mesh_as_vtk_reads_it(data_folder: Path) -> None:
    path = data_folder / "mesh_fire_ug" / "fire_ug.vtu"
    grid = _output(vtk.vtkXMLUnstructuredGridReader(), path)
    expected = vtk_to_numpy(grid.GetPointData().GetArray("t"))
    volume = read_volume(path, "t", resolution=64)
    np.testing.assert_array_equal(np.sort(volume.vertex_values), np.sort(expected))
    bounds = np.array(grid.GetBounds()).reshape(3, 2)
    sides = np.ptp(bounds, axis=1)
    np.testing.assert_allclose(volume.extent, sides / sides.max(), rtol=1e-6)
    assert volume.mask is not None
    assert 0.95 < volume.mask.mean() < 1.0  # it has a hole


def test_reactor_mesh_as_vtk_reads_it(data_folder: Path) -> None:
    path = data_folder / "mesh_disk_out_ref" / "disk_out_ref.ex2"
    reader = vtk.vtkExodusIIReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.SetAllArrayStatus(vtk.vtkExodusIIReader.NODAL, 1)
    reader.Update()
    grid = reader.GetOutput().GetBlock(0).GetBlock(0)
    volume = read_volume(path, "Temp", resolution=64)
    expected = vtk_to_numpy(grid.GetPointData().GetArray("Temp"))
    np.testing.assert_allclose(np.sort(volume.vertex_values), np.sort(expected))
    assert volume.mask is not None
    assert 0.5 < volume.mask.mean() < 0.7


def test_named_on_a_command_line(data_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(data_folder / "mesh_fire_ug")
    name = absolute("fire_ug.vtu:variable=mfrac,resolution=32")
    assert name == f"{data_folder.resolve()}/mesh_fire_ug/fire_ug.vtu:variable=mfrac,resolution=32"
    monkeypatch.chdir("/")
    dataset = open_dataset(name)
    assert dataset.name == "fire_ug-mfrac-r32"
    scene = dataset.scenes[0]
    vertices = dataset.volume(scene.variable).vertices
    assert vertices is not None
    points = initial_cloud(dataset, scene).points
    assert {tuple(p) for p in points.tolist()} <= {tuple(p) for p in vertices.tolist()}


def test_all_variables_of_a_mesh(data_folder: Path) -> None:
    dataset = open_dataset(data_folder / "mesh_fire_ug" / "fire_ug.vtu")
    assert list(dataset.volumes) == ["t", "uvw", "u", "v", "w", "mfrac"]
    assert len(dataset.scenes) == 11  # a second one of mfrac would show much the same
    assert dataset.compositions["t"] == ("t_tf1", "t_tf2")
