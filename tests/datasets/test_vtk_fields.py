"""What VTK's files hide, lack, or hold at some time steps only: the right answer is that of VTK itself."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import vtk
from vtk.util.numpy_support import vtk_to_numpy

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import list_variables, read_volume
from tests.datasets import samples
from tests.datasets.vtk_files import attach, image, mesh, rectilinear, tetrahedra, write_legacy, write_xml

pytestmark = pytest.mark.usefixtures("forks")

DIMS = (6, 5, 4)
POINT, CELL = 2, 32
"""VTK's flags of hidden points and hidden cells."""


def _flags(n: int, hidden: int, seed: int = 0, share: float = 0.1) -> np.ndarray:
    return np.where(np.random.default_rng(seed).random(n) < share, hidden, 0).astype(np.uint8)


def _values(n: int) -> np.ndarray:
    return np.random.default_rng(3).random(n) + 1.0


def _grid(even: bool, points: np.ndarray | None, cells: np.ndarray | None) -> Any:
    of_points, of_cells = {"v": _values(120)}, {"c": _values(60)}
    of_points |= {} if points is None else {"vtkGhostType": points}
    of_cells |= {} if cells is None else {"vtkGhostType": cells}
    if even:
        return image(of_points, of_cells, DIMS)
    return rectilinear(of_points, of_cells, [np.arange(n) * 1.0 for n in DIMS])


def _resampled() -> Any:
    """A tetrahedral mesh on an image that is larger: VTK's mask of points, and hidden points and cells."""
    positions, cells = tetrahedra()
    resample = vtk.vtkResampleToImage()
    resample.SetInputDataObject(mesh(positions, cells, {"v": 1.0 + positions.sum(axis=1)}, {}))
    resample.SetUseInputBounds(False)
    resample.SetSamplingBounds(-1, 3, -1, 2, -1, 1.5)
    resample.SetSamplingDimensions(9, 13, 11)
    resample.Update()
    return resample.GetOutput()


def _mesh() -> Any:
    positions, cells = tetrahedra()
    hidden = {"vtkGhostType": _flags(len(cells), CELL)}
    return mesh(positions, cells, {"v": _values(len(positions))}, {"c": _values(len(cells)), **hidden})


HIDING = {
    "points.vti": lambda: _grid(True, _flags(120, POINT), None),
    "cells.vtr": lambda: _grid(False, None, _flags(60, CELL)),
    "resampled.vti": _resampled,
    "mesh.vtu": _mesh,
}


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("name", HIDING)
def test_legacy_files_hide_what_xml_files_hide(tmp_path: Path, name: str, binary: bool) -> None:
    data = HIDING[name]()
    path, legacy = tmp_path / name, tmp_path / "v.vtk"
    write_xml(path, data)
    write_legacy(legacy, data, binary)
    assert list_variables(path) == list_variables(legacy)
    for variable in list_variables(path):
        resolution = 12 if variable.dims is None else None
        right, volume = (read_volume(p, variable.name, resolution=resolution) for p in (path, legacy))
        np.testing.assert_allclose(volume.values, right.values, rtol=1e-5)
        assert volume.value_range == pytest.approx(right.value_range, rel=1e-5)
        assert (volume.mask is None) == (right.mask is None)
        if right.mask is not None:
            np.testing.assert_array_equal(volume.mask, right.mask)


@pytest.mark.parametrize("hidden", ["points", "cells", "both"])
@pytest.mark.parametrize("even", [True, False])
def test_hidden_points_hide_cells_and_hidden_cells_points(tmp_path: Path, even: bool, hidden: str) -> None:
    """VTK says which cells are visible; a point is if it is not hidden and a cell of it is not."""
    cells = _flags(60, CELL, 1, 0.6) if hidden != "points" else None
    grid = _grid(even, _flags(120, POINT) if hidden != "cells" else None, cells)
    path = tmp_path / ("v.vti" if even else "v.vtr")
    write_xml(path, grid)
    visible = np.array([grid.IsCellVisible(i) for i in range(60)], bool)
    around, shown = vtk.vtkIdList(), np.zeros(120, bool)
    for point in range(120):
        grid.GetPointCells(point, around)
        ids = [around.GetId(i) for i in range(around.GetNumberOfIds())]
        shown[point] = grid.IsPointVisible(point) and (cells is None or not cells[ids].all())
    assert 0 < visible.sum() < 60
    assert 0 < shown.sum() < 120
    for name, right, shape in (("c", visible, (3, 4, 5)), ("v", shown, (4, 5, 6))):
        mask = read_volume(path, name).mask
        np.testing.assert_array_equal(mask, right.reshape(shape))


def _ensight(folder: Path) -> Path:
    """The sample with values of cells, "c_c"; vtkEnSightWriter has no missing ones."""
    grid = samples._mesh()
    attach(grid.GetCellData(), {"c": np.arange(60.0), "BlockId": np.ones(60, np.int32)})
    writer = vtk.vtkEnSightWriter()
    writer.SetInputData(grid)
    writer.SetPath(str(folder))
    writer.SetBaseName("v")
    writer.Write()
    writer.WriteCaseFile(1)
    (folder / "v.0.case").rename(folder / "v.case")
    return folder / "v.case"


def _undefine(file: Path, kind: bytes, undefined: np.ndarray) -> None:
    """Make values missing in EnSight's way, by a number that stands for them."""
    head, values = file.read_bytes().split(kind.ljust(80, b"\0"))
    values = np.where(undefined, np.float32(-999), np.frombuffer(values, "<f4"))
    mark = (kind + b" undef").ljust(80, b"\0") + np.float32(-999).tobytes()
    file.write_bytes(head + mark + values.astype("<f4").tobytes())


def _read_ensight(path: Path) -> Any:
    reader = vtk.vtkGenericEnSightReader()
    reader.SetCaseFileName(str(path))
    reader.ReadAllVariablesOn()
    reader.Update()
    return reader.GetOutput().GetBlock(0)


def test_missing_values_of_ensight(tmp_path: Path) -> None:
    path = _ensight(tmp_path)
    points, cells = np.arange(120) < 30, np.arange(60) % 7 == 0
    points[77] = True
    _undefine(tmp_path / "v.0.00000_n.f", b"coordinates", points)
    _undefine(tmp_path / "v.0.00000_c.c", b"hexa8", cells)
    data = _read_ensight(path)
    assert np.isnan(vtk_to_numpy(data.GetPointData().GetArray("f_n"))).sum() == 31
    for name in ("f_n", "c_c"):
        volume = read_volume(path, name, resolution=14)  # no sample on a face between cells
        np.testing.assert_allclose(volume.extent / volume.extent[0], np.array([5, 8, 1.5]) / 5)  # all of it
        grid = vtk.vtkImageData()
        grid.SetDimensions(*volume.dims)
        grid.SetOrigin(data.GetBounds()[::2])
        grid.SetSpacing(*(s / (n - 1) for s, n in zip((5, 8, 1.5), volume.dims, strict=True)))
        probe = vtk.vtkProbeFilter()
        probe.SetInputData(grid)
        probe.SetSourceData(data)
        probe.Update()
        right = vtk_to_numpy(probe.GetOutput().GetPointData().GetArray(name)).reshape(volume.values.shape)
        np.testing.assert_array_equal(volume.mask, ~np.isnan(right))
        if name == "f_n":
            np.testing.assert_allclose(volume.values[volume.mask], right[volume.mask], rtol=1e-5)
        assert np.isfinite(volume.values).all()


def test_values_of_ensight_that_are_all_missing(tmp_path: Path) -> None:
    path = _ensight(tmp_path)
    _undefine(tmp_path / "v.0.00000_n.f", b"coordinates", np.ones(120, bool))
    with pytest.raises(DataError, match="all values are missing"):
        read_volume(path, "f_n")


def _foam(folder: Path) -> Path:
    """Time steps 1 to 3 of "f", and "g" at step 2 only."""
    path = samples.write(folder, "case/v.foam")
    for time in ("2", "3"):
        shutil.copytree(path.parent / "1", path.parent / time)
    text = (path.parent / "2" / "f").read_text().replace("object f;", "object g;")
    (path.parent / "2" / "g").write_text(text)
    return path


def test_variables_that_are_not_at_the_first_step(tmp_path: Path) -> None:
    path = _foam(tmp_path)
    assert [(v.name, v.steps) for v in list_variables(path)] == [("f", 3), ("g", 3)]
    np.testing.assert_array_equal(
        read_volume(path, "g", step=1, resolution=9).values,
        read_volume(path, "f", step=1, resolution=9).values,
    )
    with pytest.raises(DataError, match="no 'g' at time step 0"):
        read_volume(path, "g", step=0)


def test_a_damaged_step_does_not_end_the_others(tmp_path: Path) -> None:
    path = _foam(tmp_path)
    last = path.parent / "3" / "f"
    for cut in (len(last.read_bytes()) // 2, 60):
        last.write_bytes(last.read_bytes()[:cut])
        assert {v.name for v in list_variables(path)} == {"f", "g"}
        read_volume(path, "f", step=0, resolution=9)
        with pytest.raises(DataError, match="3/f"):
            read_volume(path, "f", step=2, resolution=9)


def test_a_field_that_vtk_lists_and_does_not_find(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = _foam(tmp_path)
    field = path.parent / "2" / "g"
    field.write_bytes(field.read_bytes()[:300])
    assert {v.name for v in list_variables(path)} == {"f"}
    assert "no values of 'g' were found" in caplog.text
    with pytest.raises(DataError, match=r"its 'g' cannot be read: .*2/g"):
        read_volume(path, "f", step=1, resolution=9)


def _cut_header(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:60])


def _cut_stream(file: Path) -> None:
    file.with_name("f.gz").write_bytes(gzip.compress(file.read_bytes())[:-9])
    file.unlink()


@pytest.mark.parametrize("damage", [_cut_header, _cut_stream, lambda file: file.write_bytes(b"")])
def test_a_field_of_openfoam_that_is_cut_is_named(tmp_path: Path, damage: Any) -> None:
    """VTK passes over it without a word."""
    path = samples.write(tmp_path, "case/v.foam")
    shutil.copy(path.parent / "1" / "f", path.parent / "1" / "whole")
    damage(path.parent / "1" / "f")
    with pytest.raises(DataError, match=r"its file 1/f(\.gz)? is truncated"):
        list_variables(path)


STEP = np.arange(24.0).reshape(2, 3, 4)


def _xdmf(path: Path, *grids: str) -> Path:
    """Temporal grids of 4 x 3 x 2 points, each with these attributes."""
    places = '<DataItem Dimensions="3">0 0 0</DataItem><DataItem Dimensions="3">3 2 1</DataItem>'
    text = "".join(
        f'<Grid Name="g{k}"><Time Value="{k}.5"/><Topology TopologyType="3DCoRectMesh" Dimensions="2 3 4"/>'
        f'<Geometry GeometryType="ORIGIN_DXDYDZ">{places}</Geometry>{grid}</Grid>'
        for k, grid in enumerate(grids)
    )
    collection = f'<Grid GridType="Collection" CollectionType="Temporal">{text}</Grid>'
    path.write_text(f'<?xml version="1.0"?><Xdmf Version="2.0"><Domain>{collection}</Domain></Xdmf>')
    return path


def _attribute(name: str, text: str, kind: str = "HDF") -> str:
    item = f'<DataItem Format="{kind}" NumberType="Float" Precision="8" Dimensions="2 3 4">{text}</DataItem>'
    return f'<Attribute Name="{name}" AttributeType="Scalar" Center="Node">{item}</Attribute>'


def test_steps_of_xdmf(tmp_path: Path) -> None:
    """A variable of the last step, and a step whose file is not there."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["q"], file["late"] = STEP, 2 * STEP
    q = _attribute("q", "a.h5:/q")
    path = _xdmf(tmp_path / "v.xdmf", q, _attribute("q", "b.h5:/q"), q + _attribute("late", "a.h5:/late"))
    assert [v.name for v in list_variables(path)] == ["q", "late"]
    np.testing.assert_array_equal(read_volume(path, "late", step=2).values, 2 * STEP)
    np.testing.assert_array_equal(read_volume(path, "q").values, STEP)
    with pytest.raises(DataError, match=r"its data file b\.h5 does not exist"):
        read_volume(path, "q", step=1)


def test_files_of_xdmf_that_lack_or_are_cut_are_named(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["q"], file["short"] = STEP, STEP[:1]
    data = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: len(data) // 2])
    (tmp_path / "a.bin").write_bytes(STEP.tobytes()[:-8])
    for text, kind, reason in (
        ("none.h5:/q", "HDF", "none.h5 does not exist"),
        ("a.h5:/r", "HDF", "a.h5 has no '/r'"),
        ("a.h5:/short", "HDF", "a.h5 has 12 values of 24 in '/short'"),
        ("cut.h5:/q", "HDF", "cut.h5 is damaged"),
        ("none.bin", "Binary", "none.bin does not exist"),
        ("a.bin", "Binary", "a.bin is truncated: 184 bytes of 192"),
    ):
        path = _xdmf(tmp_path / "v.xdmf", _attribute("q", text, kind))
        with pytest.raises(DataError) as caught:
            read_volume(path)
        assert f"its data file {reason}" in caught.value.reason
        assert caught.value.remedy == "Copy all its files together"


def test_files_of_ensight_that_lack_or_are_cut_are_named(tmp_path: Path) -> None:
    path = _ensight(tmp_path)
    field, geometry = tmp_path / "v.0.00000_n.f", tmp_path / "v.0.00000.geo"
    whole = field.read_bytes()
    field.write_bytes(whole[:-20])
    with pytest.raises(DataError, match=r"its 'f_n' cannot be read: .*Read failed"):
        read_volume(path, "c_c")
    field.write_bytes(whole)
    geometry.unlink()
    with pytest.raises(DataError, match=r"its geometry file v\.0\.\S*geo does not exist"):
        list_variables(path)
