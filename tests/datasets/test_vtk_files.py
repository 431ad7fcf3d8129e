"""Readers of VTK's files and Exodus: against VTK's writers and readers, exact fields on meshes, damage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import vtk
from hypothesis import given
from hypothesis import strategies as st
from vtk.util.numpy_support import vtk_to_numpy

from econgs_bench.datasets.cloud import initial_cloud
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.datasets.readers import list_variables, read_volume
from econgs_bench.datasets.readers import mesh as meshes
from econgs_bench.datasets.readers.fields import Choice, Variable
from econgs_bench.datasets.render_views import volume_digest
from econgs_bench.datasets.scene import BasicScene, Dataset
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.volume import Volume
from tests.datasets.damage import PROPERTY, array, check_damage, check_refused, check_volumes
from tests.datasets.test_named_variables import big_array, peak_bytes
from tests.datasets.vtk_files import (
    COMPRESSORS,
    XML_MODES,
    attach,
    image,
    mesh,
    rectilinear,
    tetrahedra,
    write_exodus,
    write_legacy,
    write_xml,
)

pytestmark = pytest.mark.usefixtures("forks")

DIMS = (6, 5, 4)
KINDS = ("uint8", "int8", "uint16", "int16", "int32", "int64", "uint64", "float32", "float64")
EVEN = [np.arange(6) * 1.0, np.arange(5) * 2.0, np.arange(4) * 0.5]


def _grid(dtype: str = "float32", even: bool = True) -> vtk.vtkDataSet:
    """Point data "a b" and "vec" (a, 2 a, a), cell data "c"."""
    a = array(dtype)
    vec = np.stack([a, a * 2, a], axis=-1).reshape(-1, 3)
    points, cells = {"a b": a.reshape(-1), "vec": vec}, {"c": a[1:, 1:, 1:].reshape(-1)}
    if even:
        return image(points, cells, DIMS, (1.0, 2.0, 0.5))
    return rectilinear(points, cells, EVEN)


def _linear(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(nz, ny, nx) values of a linear field on a grid."""
    return x + 2 * y[:, None] + 3 * z[:, None, None]


def _check_grid(path: Path, dtype: str, rtol: float = 0.0) -> None:
    a = array(dtype)
    volume = read_volume(path, "a b")
    np.testing.assert_allclose(volume.values, a, rtol=rtol)
    assert volume.values.dtype == np.dtype(dtype)
    assert volume.spacing == pytest.approx((1.0, 2.0, 0.5))
    np.testing.assert_allclose(read_volume(path, "vec.y").values, a * 2, rtol=rtol)
    magnitude = np.sqrt(6.0) * np.abs(a.astype(float))
    if not dtype.startswith(("u", "int8")):
        np.testing.assert_allclose(read_volume(path, "vec").values, magnitude, rtol=1e-5 + rtol)
    cells = read_volume(path, "c")  # cell centres are samples
    np.testing.assert_allclose(cells.values, a[1:, 1:, 1:], rtol=rtol)
    assert cells.spacing == pytest.approx((1.0, 2.0, 0.5))
    assert cells.dims == (5, 4, 3)


@pytest.mark.parametrize(
    ("suffix", "mode", "compressor"),
    [
        *((".vti", mode, "zlib") for mode in XML_MODES),
        *((".vti", "appended", compressor) for compressor in COMPRESSORS if compressor != "zlib"),
        *((".vtr", mode, "zlib") for mode in ("ascii", "raw")),
    ],
)
def test_xml_grids_of_vtks_writer(tmp_path: Path, suffix: str, mode: str, compressor: str) -> None:
    for dtype, wide in (("uint8", True), ("float64", False), ("int16", True)):
        write_xml(tmp_path / f"v{suffix}", _grid(dtype, suffix == ".vti"), mode, compressor, wide)
        _check_grid(tmp_path / f"v{suffix}", dtype)


@pytest.mark.parametrize("dtype", KINDS)
@pytest.mark.parametrize("even", [True, False])
def test_legacy_grids_of_vtks_writer(tmp_path: Path, dtype: str, even: bool) -> None:
    for binary, version in ((True, 42), (True, 51), (False, 51)):
        grid = _grid(dtype, even)
        grid.GetPointData().SetActiveScalars("a b")
        grid.GetPointData().SetActiveVectors("vec")
        write_legacy(tmp_path / "v.vtk", grid, binary, version)
        _check_grid(tmp_path / "v.vtk", dtype, 0.0 if binary else 1e-5)


def test_legacy_by_hand(tmp_path: Path) -> None:
    numbers = " ".join(str(n) for n in range(12))
    (tmp_path / "v.vtk").write_text(
        "# vtk DataFile Version 3.0\nby hand\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 2 3 2\n"
        f"ORIGIN 0 0 0\nSPACING 1 1 2\n\nPOINT_DATA 12\nSCALARS s short\nLOOKUP_TABLE default\n{numbers}\n"
        f"FIELD extra 2\nu 1 12 double\n{numbers}\nother 1 2 int\n7 8\nVECTORS w float\n{' 1 2 2' * 12}\n"
    )
    assert [v.name for v in list_variables(tmp_path / "v.vtk")] == ["s", "u", "w"]
    volume = read_volume(tmp_path / "v.vtk", "s")
    np.testing.assert_array_equal(volume.values, np.arange(12).reshape(2, 3, 2))
    assert volume.values.dtype == np.int16
    assert volume.spacing == (1.0, 1.0, 2.0)
    with pytest.raises(DataError, match="all values are 3"):
        read_volume(tmp_path / "v.vtk", "w")


def test_uncompressed_values_are_memory_mapped(tmp_path: Path) -> None:
    write_legacy(tmp_path / "v.vtk", _grid("uint8"), binary=True)
    assert isinstance(read_volume(tmp_path / "v.vtk", "a b").values, np.memmap)


def test_pieces_make_one_grid(tmp_path: Path) -> None:
    whole = _grid("int16")
    texts = []
    for first, last in ((0, 2), (2, 5)):
        part = vtk.vtkExtractVOI()
        part.SetInputData(whole)
        part.SetVOI(first, last, 0, 4, 0, 3)
        part.Update()
        write_xml(tmp_path / "part.vti", part.GetOutput(), "ascii")
        text = (tmp_path / "part.vti").read_text()
        texts.append(text[text.index("<Piece") : text.index("</ImageData>")])
        start = text[: text.index("<Piece")].replace(f'WholeExtent="{first} {last}', 'WholeExtent="0 5')
    (tmp_path / "v.vti").write_text(start + "".join(texts) + "</ImageData></VTKFile>")
    _check_grid(tmp_path / "v.vti", "int16")
    (tmp_path / "v.vti").write_text(start + texts[0] + "</ImageData></VTKFile>")
    with pytest.raises(DataError, match="pieces do not fill"):
        read_volume(tmp_path / "v.vti", "a b")


@pytest.mark.parametrize("suffix", [".vtr", ".vtk"])
def test_uneven_axes_are_resampled(tmp_path: Path, suffix: str) -> None:
    axes = [np.array([0.0, 1.0, 2.0, 4.0]), np.array([0.0, 2.0, 4.0]), np.array([-1.0, -0.5, 0.5, 1.5, 3.5])]
    field = _linear(*axes).astype(np.float32)
    middles = [0.5 * (axis[1:] + axis[:-1]) for axis in axes]
    grid = rectilinear({"f": field.reshape(-1)}, {"c": np.arange(24.0)}, axes)
    write_xml(tmp_path / "v.vtr", grid) if suffix == ".vtr" else write_legacy(tmp_path / "v.vtk", grid, True)
    volume = read_volume(tmp_path / f"v{suffix}", "f")
    assert volume.dims == (5, 3, 10)
    assert volume.spacing == pytest.approx((1.0, 2.0, 0.5))
    expected = _linear(np.arange(5), np.arange(0, 5, 2), np.arange(-1, 3.6, 0.5))
    np.testing.assert_allclose(volume.values, expected, rtol=1e-5)
    cells = read_volume(tmp_path / f"v{suffix}", "c")
    length = [axis[-1] - axis[0] for axis in middles]
    np.testing.assert_allclose(np.array(cells.spacing) * (np.array(cells.dims) - 1), length)


def test_extremely_uneven_axes_have_a_cap(tmp_path: Path) -> None:
    axes = [np.array([0.0, 1e-6, 1.0]), np.arange(3.0), np.arange(3.0)]
    write_xml(tmp_path / "v.vtr", rectilinear({"f": np.arange(27.0)}, {}, axes))
    assert read_volume(tmp_path / "v.vtr").dims == (512, 3, 3)


def test_blanked_points_are_masked(tmp_path: Path) -> None:
    grid = _grid()
    blank = np.zeros(120, np.uint8)
    blank[[7, 50]] = 2  # hidden points
    attach(grid.GetPointData(), {"vtkGhostType": blank})
    write_xml(tmp_path / "v.vti", grid)
    volume = read_volume(tmp_path / "v.vti", "a b")
    assert volume.mask is not None
    np.testing.assert_array_equal(np.flatnonzero(~volume.mask), [7, 50])
    assert "vtkGhostType" not in [v.name for v in list_variables(tmp_path / "v.vti")]
    assert volume_digest(volume) != volume_digest(replace(volume, mask=None))


POSITIONS, CELLS = tetrahedra()
LINEAR = POSITIONS @ np.array([1.0, 2.0, 3.0])
OF_CELLS = np.arange(len(CELLS)) * 1.0


def _mesh() -> vtk.vtkUnstructuredGrid:
    vectors = np.stack([LINEAR, -LINEAR, 0 * LINEAR], axis=-1)
    return mesh(POSITIONS, CELLS, {"f": LINEAR, "u": vectors}, {"q": OF_CELLS})


def _write_mesh(path: Path) -> Path:
    if path.suffix == ".vtu":
        write_xml(path, _mesh(), *{"raw": ("raw", "none"), "text": ("ascii",)}.get(path.stem, ()))
    elif path.suffix == ".vtk":
        write_legacy(path, _mesh(), "text" not in path.stem, 42 if "old" in path.stem else 51)
    else:
        connectivity = np.array([ids for _, ids in CELLS])
        blocks = [("TETRA", connectivity[:50]), ("tet4", connectivity[50:])]
        nodal = {"f": np.stack([LINEAR, 2 * LINEAR]), "g": np.stack([LINEAR**2, LINEAR])}
        cells = {"q": [np.stack([part, part]) for part in (OF_CELLS[:50], OF_CELLS[50:])]}
        write_exodus(
            path, POSITIONS, blocks, nodal, cells, "NETCDF4" if "4" in path.stem else "NETCDF3_CLASSIC"
        )
    return path


MESHES = [
    "zlib.vtu",
    "raw.vtu",
    "text.vtu",
    "old.vtk",
    "new.vtk",
    "old_text.vtk",
    "new_text.vtk",
    "a.ex2",
    "netcdf4.e",
]


@pytest.mark.parametrize("name", MESHES)
def test_linear_fields_on_meshes_are_exact(tmp_path: Path, name: str) -> None:
    path = _write_mesh(tmp_path / name)
    volume = read_volume(path, "f", resolution=33)
    assert volume.dims == (33, 17, 9)
    assert volume.mask is None  # the mesh is a box: every sample, also on its faces, lies inside
    np.testing.assert_allclose(volume.extent, [1.0, 0.5, 0.25])
    expected = _linear(np.linspace(0, 2, 33), np.linspace(0, 1, 17), np.linspace(0, 0.5, 9))
    np.testing.assert_allclose(volume.values, expected, atol=1e-9)
    assert volume.value_range == pytest.approx((LINEAR.min(), LINEAR.max()))
    assert volume.vertices is not None
    assert volume.vertex_values is not None
    np.testing.assert_allclose(volume.vertices, (POSITIONS - [1.0, 0.5, 0.25]) / 2.0, atol=1e-7)
    np.testing.assert_allclose(volume.vertex_values, LINEAR, rtol=1e-10)
    assert all(v.dims is None for v in list_variables(path))


@pytest.mark.parametrize("name", ["zlib.vtu", "new.vtk", "a.ex2"])
def test_cell_data_of_meshes_are_averaged_as_vtk_does(tmp_path: Path, name: str) -> None:
    average = vtk.vtkCellDataToPointData()
    average.SetInputData(_mesh())
    average.Update()
    expected = vtk_to_numpy(average.GetOutput().GetPointData().GetArray("q"))
    volume = read_volume(_write_mesh(tmp_path / name), "q", resolution=9)
    np.testing.assert_allclose(volume.vertex_values, expected)


def test_exodus_steps_and_our_writer_against_vtks_reader(tmp_path: Path) -> None:
    path = _write_mesh(tmp_path / "a.ex2")
    assert {(v.name, v.steps) for v in list_variables(path)} == {("f", 2), ("g", 2), ("q", 2)}
    np.testing.assert_allclose(read_volume(path, "f", step=1, resolution=5).vertex_values, 2 * LINEAR)
    np.testing.assert_allclose(read_volume(path, "g", resolution=5).vertex_values, LINEAR**2)
    reader = vtk.vtkExodusIIReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    assert [reader.GetPointResultArrayName(i) for i in range(2)] == ["f", "g"]
    assert reader.GetNumberOfElementsInFile() == len(CELLS)


def test_quadratic_cells_of_exodus_in_vtks_order(tmp_path: Path) -> None:
    """One HEX20: with mid-edge nodes in another order a linear field would not be exact."""
    corners = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]]
    )
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 5), (2, 6), (3, 7), (4, 5), (5, 6), (6, 7), (7, 4)]
    positions = np.concatenate([corners, [0.5 * (corners[a] + corners[b]) for a, b in edges]])
    field = positions @ [1.0, 2.0, 3.0]
    write_exodus(tmp_path / "a.exo", positions, [("HEX20", np.arange(20)[None])], {"f": field[None]}, {})
    volume = read_volume(tmp_path / "a.exo", resolution=9)
    expected = _linear(*[np.linspace(0, 1, 9)] * 3)
    np.testing.assert_allclose(volume.values, expected, atol=1e-3)  # VTK solves for the place
    assert volume.mask is None


def test_outside_of_a_mesh_is_masked_and_continued(tmp_path: Path) -> None:
    """An L-shaped mesh: the box less its corner x > 1, y > 1/2."""
    centres = np.array([POSITIONS[ids].mean(axis=0) for _, ids in CELLS])
    keep = ~((centres[:, 0] > 4 / 3) & (centres[:, 1] > 2 / 3))
    cells = [cell for cell, kept in zip(CELLS, keep, strict=True) if kept]
    write_xml(tmp_path / "v.vtu", mesh(POSITIONS, cells, {"f": 5.0 + LINEAR}, {}))
    volume = read_volume(tmp_path / "v.vtu", resolution=49)
    assert volume.mask is not None
    z, y, x = np.meshgrid(
        *[np.linspace(0, s, n) for s, n in zip((0.5, 1, 2), volume.values.shape, strict=True)], indexing="ij"
    )
    np.testing.assert_array_equal(volume.mask[(x > 1.45) & (y > 0.75)], False)
    np.testing.assert_array_equal(volume.mask[(x < 1.2) | (y < 0.6)], True)
    np.testing.assert_allclose(volume.values[volume.mask], (5 + x + 2 * y + 3 * z)[volume.mask], atol=1e-9)
    low, high = volume.value_range
    assert low <= volume.values.min() <= volume.values.max() <= high
    beside = ~volume.mask
    beside[:, :, 1:] &= volume.mask[:, :, :-1]
    step = np.abs(np.diff(volume.values, axis=2))[beside[:, :, 1:]]
    assert beside.sum() > 20
    assert step.max() < 0.5  # of 5.5: continued, not dropped to a constant


def _cloud_dataset(path: Path, bump: tuple[float, float, float, float]) -> Dataset:
    transfer = TransferFunction("t", (Bump("b", *bump, (0.2, 0.4, 0.9), 0.5),))
    volumes = {"f": lambda: read_volume(path, "f", resolution=17)}
    return Dataset("d", "", "volume", (BasicScene("t", "f", transfer),), volumes=volumes)


def test_clouds_of_meshes_are_their_vertices(tmp_path: Path) -> None:
    path = _write_mesh(tmp_path / "v.vtu")
    cloud = initial_cloud(_cloud_dataset(path, (0.4, 0.5, 0.6, 0.7)), "t")
    share = (LINEAR - LINEAR.min()) / np.ptp(LINEAR)
    expected = (POSITIONS[(share > 0.4) & (share < 0.7)] - [1.0, 0.5, 0.25]) / 2.0
    key = [2, 1, 0]
    np.testing.assert_allclose(
        cloud.points[np.lexsort(cloud.points.T[key])],
        expected[np.lexsort(expected.astype("f4").T[key])],
        atol=1e-6,
    )
    assert len(initial_cloud(_cloud_dataset(path, (0.4, 0.5, 0.6, 0.7)), "t", max_points=5)) == 5
    between = initial_cloud(_cloud_dataset(path, (0.005, 0.01, 0.05, 0.07)), "t", max_points=50)
    assert len(between)  # no vertex has such a value: voxels


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"types": 42}, "polyhedra"),
        ({"types": 5}, "not 3|no cells with a volume"),
        ({"types": 14}, "has not 5 points"),
        ({"point": 99999}, "refers to a point that does not exist"),
        ({"point": -1}, "refers to a point that does not exist"),
        ({"nan": True}, "not finite"),
        ({"flat": True}, "flat"),
        ({"tangled": True}, "overlap many times"),
        ({"values": "S1"}, "no scalar field"),
    ],
)
def test_meshes_that_vtk_must_not_see(change: dict, reason: str) -> None:
    positions, connectivity = POSITIONS.copy(), np.concatenate([ids for _, ids in CELLS])
    types = np.full(len(CELLS), change.get("types", 10), np.uint8)
    ends = 4 * np.arange(1, len(CELLS) + 1)
    if "point" in change:
        connectivity[5] = change["point"]
    if "nan" in change:
        positions[3, 1] = np.nan
    if "flat" in change:
        positions[:, 2] = 0.0
    if "tangled" in change:
        # Each cell spans the whole box, and there are many.
        connectivity = np.tile(np.array([0, 3, 12, 63]), 20_000)
        ends, types = 4 * np.arange(1, 20_001), np.full(20_000, 10, np.uint8)
    grid = meshes.Mesh(positions, connectivity, ends, types)
    values = LINEAR.astype(change.get("values", LINEAR.dtype))
    choice = Choice(Variable("v", None), resolution=33)
    with pytest.raises(DataError, match=reason):
        meshes.resampled(meshes.Mesh.joined([grid], Path("m")), values, False, choice, Path("m"))


def test_resolutions(tmp_path: Path) -> None:
    path = _write_mesh(tmp_path / "v.vtu")
    assert read_volume(path, "f").dims == (128, 65, 33)
    for n in (0, 1, 10**6):
        with pytest.raises(DataError, match="Choose 2 to"):
            read_volume(path, "f", resolution=n)
    with pytest.raises(UnknownName, match=r"Did you mean u"):
        read_volume(path, "u.w")


BAD = {
    "text.vti": (b"hello, I am no grid", "Error parsing XML"),
    "html.vti": (b"<html></html>", "holds no grid"),
    "bomb.vti": (
        b'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "b">]><VTKFile>&a;</VTKFile>',
        "holds no grid",
    ),
    "poly.vtu": (b'<VTKFile type="PolyData"><PolyData/></VTKFile>', "holds no grid"),
    "empty.vtu": (b'<VTKFile type="UnstructuredGrid"><UnstructuredGrid/></VTKFile>', "holds no grid"),
    "text.vtk": (b"hello\nI am\nno grid\n", "not a legacy VTK file"),
    "poly.vtk": (b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\n", "holds POLYDATA"),
    "huge.vtk": (
        b"# vtk DataFile Version 3.0\nx\nBINARY\nDATASET STRUCTURED_POINTS\nDIMENSIONS 9999999 9999999 "
        b"9999999\nPOINT_DATA 999999800000010000\nSCALARS s float\nLOOKUP_TABLE default\n",
        "damaged",
    ),
    "huge.vti": (
        b'<VTKFile type="ImageData"><ImageData WholeExtent="0 99999999 0 99999999 0 9999"><Piece Extent='
        b'"0 99999999 0 99999999 0 9999"><PointData><DataArray type="Float32" Name="a" format="ascii">'
        b"1 2</DataArray></PointData></Piece></ImageData></VTKFile>",
        "Unable to allocate",
    ),
    "text.ex2": (b"hello, I am no mesh", "file signature not found"),
    "text.nc": (b"CDF\1 hello, I am no file", "header is damaged"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files(tmp_path: Path, name: str) -> None:
    check_refused(tmp_path / name, *BAD[name])


def _write(path: Path) -> Path:
    if path.stem in ("grid", "grid_text"):
        write_legacy(path, _grid("float32", False), path.stem == "grid")
    else:
        _write_mesh(path)
    return path


def _read(path: Path, variable: Variable) -> Volume:
    return read_volume(path, array=variable.name, resolution=9 if variable.dims is None else None)


FILES = ["grid.vtk", "grid_text.vtk", "old.vtk", "new.vtk", "old_text.vtk", "a.ex2"]
"""Formats that are parsed in this process: test_formats damages the others."""


@pytest.mark.parametrize("many", [40, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FILES)
def test_damaged_files(tmp_path: Path, name: str, many: int) -> None:
    def check(path: Path) -> None:
        check_volumes(path, lambda: (_read(path, one) for one in list_variables(path)[:2]))

    check_damage(tmp_path / name, _write, check, "cut", "flip", "number", many=many)


@PROPERTY
@given(
    shape=st.tuples(*[st.integers(2, 6)] * 3), dtype=st.sampled_from(KINDS), seed=st.integers(0, 99),
    mode=st.sampled_from(list(XML_MODES)), compressor=st.sampled_from(COMPRESSORS), wide=st.booleans(),
)  # fmt: skip
def test_any_image_round_trip(
    tmp_path: Path, shape: tuple, dtype: str, seed: int, mode: str, compressor: str, wide: bool
) -> None:
    values = np.random.default_rng(seed).integers(0, 100, shape).astype(dtype)
    values[0, 0, :2] = 5, 6
    grid = image({"v": values.reshape(-1)}, {}, (shape[2], shape[1], shape[0]))
    write_xml(tmp_path / "v.vti", grid, mode, compressor, wide)
    np.testing.assert_array_equal(read_volume(tmp_path / "v.vti").values, values)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["raw.vti", "none.vti", "zlib.vti", "old.vtk"])
def test_never_more_than_two_copies_in_memory(tmp_path: Path, name: str) -> None:
    big = big_array()
    grid = image({"v": big.reshape(-1)}, {}, (256, 256, 256))
    path = tmp_path / name
    if path.suffix == ".vtk":
        write_legacy(path, grid, binary=True)
    else:
        write_xml(path, grid, "raw" if "raw" in name else "appended", "zlib" if "zlib" in name else "none")
    text = 4 / 3 if "none" in name else 1.0  # a copy in base64 is that much larger
    assert peak_bytes(path, "v") < (1.05 + text) * big.nbytes
