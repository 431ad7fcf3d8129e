"""What files of each format say beside their values: the right answer is that of the format's own library."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import vtk
import xarray
import zarr
from PIL import Image
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import list_variables, read_volume
from tests.datasets import samples

pytestmark = pytest.mark.usefixtures("forks")

A = (np.random.default_rng(1).random((6, 5, 7)) * 1000).astype("f4")
B = np.stack([A, 2 * A, 3 * A])
UM = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.5}
Case = tuple[str, Callable[[Path], Any]]
"""File name, and a writer that gives what its library reads: values, masked where missing."""


def _netcdf(name: str, attributes: dict[str, Any], kind: str, values: np.ndarray, fill: Any = None) -> Case:
    def write(path: Path) -> Any:
        form = "NETCDF3_CLASSIC" if "3" in path.name else "NETCDF4"
        with netCDF4.Dataset(path, "w", format=form) as data:
            data.set_auto_maskandscale(False)
            for axis, n in zip("zyx", values.shape, strict=True):
                data.createDimension(axis, n)
            variable = data.createVariable("q", kind, ("z", "y", "x"), fill_value=fill)
            variable.setncatts(attributes)
            variable[:] = values
        with netCDF4.Dataset(path) as data:
            return data["q"][:]

    return name, write


def _bytes(n: int) -> np.ndarray:
    return (np.arange(n) * 250 // n).reshape(6, 5, -1).astype("u1").view("i1")


def _zarr(version: int) -> Case:
    def write(path: Path) -> Any:
        data = xarray.Dataset({"q": (("z", "y", "x"), np.where(A > 900, np.nan, A))})
        encoding = {"q": {"_FillValue": -999.0}}
        data.to_zarr(path, zarr_format=version, consolidated=False, encoding=encoding)
        with xarray.open_dataset(path, engine="zarr", consolidated=False) as found:
            return np.ma.masked_invalid(found["q"].values)

    return "q.zarr", write


_UNSIGNED = {"_Unsigned": "true", "valid_range": np.array([3, -30], "i1")}
_PACKED = {"scale_factor": 0.5, "add_offset": 10.0, "valid_range": np.array([0, 900], "i2")}
VALUES: dict[str, Case] = {
    f"{what}, {name}": _netcdf(name, attributes, kind, values, fill)
    for name in ("q3.nc", "q4.nc")
    for what, attributes, kind, values, fill in (
        ("unsigned", {"_Unsigned": "true"}, "i1", _bytes(210), -7),
        ("unsigned range", _UNSIGNED, "i1", _bytes(210), -9),
        ("packed", _PACKED, "i2", A.astype("i2"), -1),
        ("missing", {"missing_value": np.float32(A[0, 0, 0])}, "f4", A, None),
        ("valid_max", {"valid_max": np.float32(800)}, "f4", A, None),
        ("default fill", {}, "i4", np.where(A > 900, np.int32(-2147483647), A.astype("i4")), None),
    )
} | {"zarr 2": _zarr(2), "zarr 3": _zarr(3)}  # fmt: skip


@pytest.mark.parametrize("case", VALUES)
def test_missing_values(tmp_path: Path, case: str) -> None:
    name, write = VALUES[case]
    path = tmp_path / name
    right = np.ma.asarray(write(path))
    volume = read_volume(path)
    mask = np.ones(A.shape, bool) if volume.mask is None else volume.mask
    np.testing.assert_array_equal(~mask, np.ma.getmaskarray(right))
    np.testing.assert_allclose(volume.values[mask], right.compressed(), rtol=1e-6)
    assert volume.value_range == pytest.approx((float(right.min()), float(right.max())))


def test_missing_value_as_text(tmp_path: Path) -> None:
    values = np.where(A > 900, -999, A)
    path = tmp_path / "q3.nc"
    _netcdf("", {}, "f4", values)[1](path)
    with netCDF4.Dataset(path, "a") as data:
        data["q"].setncattr("missing_value", "-999")
    volume = read_volume(path)
    assert volume.mask is not None
    np.testing.assert_array_equal(volume.mask, A <= 900)


def _ome_zarr(path: Path) -> None:
    group = zarr.open_group(path, mode="w", zarr_format=2)
    group.create_array("0", shape=A.shape, dtype="f4", chunks=A.shape)[:] = A
    group.create_array("1", shape=(3, 2, 3), dtype="f4", chunks=(3, 2, 3))[:] = A[::2, :4:2, :6:2]
    units = {"z": "nanometer", "y": "micrometer", "x": "micrometer"}
    axes = [{"name": n, "type": "space", "unit": unit} for n, unit in units.items()]
    scales = [{"type": "scale", "scale": [2000.0 * f, 0.5 * f, 0.5 * f]} for f in (1, 2)]
    levels = [{"path": str(n), "coordinateTransformations": [one]} for n, one in enumerate(scales)]
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": levels}]


def _tree(path: Path) -> None:
    """xarray's tree: a group sees the coordinates of those above it."""
    positions = {a: s * np.arange(n) for a, s, n in zip("zyx", (2.0, 0.5, 0.5), A.shape, strict=True)}
    groups = {"/": xarray.Dataset(coords=positions), "/a/b": xarray.Dataset({"v": (("z", "y", "x"), A)})}
    xarray.DataTree.from_dict(groups).to_zarr(str(path), consolidated=False)


def _sform(path: Path) -> None:
    image = nibabel.Nifti1Image(A.transpose(2, 1, 0), np.diag([0.5, 0.5, 2.0, 1]))
    image.header.set_zooms((0.5, 0.5, 2.0))
    nibabel.save(image, path)
    raw = bytearray(path.read_bytes())
    raw[80:92], raw[252:254] = np.ones(3, "<f4").tobytes(), bytes(2)  # pixdim; no qform
    path.write_bytes(raw)


def _hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["v"] = A
        file["v"].attrs["element_size_um"] = [2.0, 0.5, 0.5]


def _coordinates(path: Path) -> None:
    with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as data:
        for axis, n in zip("zyx", A.shape, strict=True):
            data.createDimension(axis, n)
            positions = data.createVariable(axis, "f8", (axis,))
            positions.units = "km" if axis == "z" else "m"
            positions[:] = np.arange(n) * (0.002 if axis == "z" else 0.5)
        data.createVariable("v", "f4", ("z", "y", "x"))[:] = A


def _itk(path: Path) -> None:
    image = sitk.GetImageFromArray(A)
    image.SetSpacing((0.5, 0.5, 2.0))
    sitk.WriteImage(image, path)


SPACINGS: dict[str, Callable[[Path], None]] = {
    "units.ome.tif": lambda p: tifffile.imwrite(
        p, A, metadata={"axes": "ZYX", **UM, "PhysicalSizeZ": 2000.0, "PhysicalSizeZUnit": "nm"}
    ),
    "imagej.tif": lambda p: tifffile.imwrite(
        p, A, imagej=True, resolution=(2, 2), metadata={"spacing": 2.0, "unit": "um"}
    ),
    "v.ome.zarr": _ome_zarr,
    "tree.zarr": _tree,
    "v.nii": _sform,
    "v.h5": _hdf5,
    "v.npz": lambda p: np.savez(p, v=A, spacing=np.array([2.0, 0.5, 0.5])),
    "v3.nc": _coordinates,
    "v.mha": _itk,
    "v.nrrd": lambda p: nrrd.write(
        str(p), A.transpose(2, 1, 0), {"spacings": [0.5, 0.5, 2000.0], "units": ["um", "um", "nm"]}
    ),
}


@pytest.mark.parametrize("name", SPACINGS)
def test_spacing(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    SPACINGS[name](path)
    variables = list_variables(path)
    assert len(variables) <= 1
    volume = read_volume(path)
    np.testing.assert_allclose(np.array(volume.spacing) / volume.spacing[0], (1.0, 1.0, 4.0), rtol=1e-6)
    np.testing.assert_array_equal(volume.values, A)


def test_a_line_where_distances_are_assumed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    np.save(tmp_path / "v.npy", A)
    assert read_volume(tmp_path / "v.npy").spacing == (1.0, 1.0, 1.0)
    assert "1:1:1 is assumed" in caplog.text
    caplog.clear()
    read_volume(tmp_path / "v.npy", spacing=(1.0, 1.0, 2.0))
    assert not caplog.text


def _mha_steps(path: Path) -> None:
    sitk.WriteImage(sitk.GetImageFromArray(B, isVector=False), path)


STEPS: dict[str, Callable[[Path], None]] = {
    "v.npy": lambda p: np.save(p, B),
    "v.nii.gz": lambda p: nibabel.save(nibabel.Nifti1Image(B.transpose(3, 2, 1, 0), np.eye(4)), p),
    "v.nrrd": lambda p: nrrd.write(str(p), B.transpose(3, 2, 1, 0), {"kinds": ["domain"] * 3 + ["time"]}),
    "v.mha": _mha_steps,
    "v_7x5x6x3_float32.raw": lambda p: p.write_bytes(B.tobytes()),
}


@pytest.mark.parametrize("name", STEPS)
def test_time_steps(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    STEPS[name](path)
    assert [v.steps for v in list_variables(path)] == [3]
    for step in range(3):
        np.testing.assert_array_equal(read_volume(path, step=step).values, B[step])
    with pytest.raises(DataError, match="time steps 0 to 2"):
        read_volume(path, step=3)


BYTES = (np.random.default_rng(2).random((*A.shape, 3)) * 255).astype("u1")


def _vti(path: Path) -> None:
    data = vtk.vtkImageData()
    data.SetDimensions(*A.shape[::-1])
    array = numpy_to_vtk(np.concatenate([BYTES, BYTES[..., :1]], -1).reshape(-1, 4), deep=1)
    array.SetName("value")
    data.GetPointData().AddArray(array)
    writer = vtk.vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.Write()


def _rgb_nifti(path: Path) -> None:
    values = np.ascontiguousarray(BYTES).view([("R", "u1"), ("G", "u1"), ("B", "u1")])[..., 0]
    nibabel.save(nibabel.Nifti1Image(values.transpose(2, 1, 0), np.eye(4)), path)


def _slices(path: Path) -> None:
    path.mkdir()
    for k, plane in enumerate(BYTES):
        Image.fromarray(plane).save(path / f"s{k}.png")


COLORS: dict[str, Callable[[Path], None]] = {
    "v.nii": _rgb_nifti,
    "v.mha": lambda p: sitk.WriteImage(sitk.GetImageFromArray(BYTES, isVector=True), p),
    "v.vti": _vti,
    "png": _slices,
    "v.tif": lambda p: tifffile.imwrite(p, BYTES, photometric="rgb"),
    "v.npy": lambda p: np.save(p, BYTES),
}


@pytest.mark.parametrize("name", ["v.npy", "v.npz", "v.h5", "v.zarr"])
def test_a_last_axis_of_one_counts_for_nothing(tmp_path: Path, name: str) -> None:
    steps = np.stack([A, A[::-1]])[..., None]
    path = tmp_path / name
    if name == "v.npy":
        np.save(path, steps)
    elif name == "v.npz":
        np.savez(path, v=steps)
    elif name == "v.h5":
        with h5py.File(path, "w") as file:
            file.create_dataset("v", data=steps)
    else:
        zarr.open_group(str(path), mode="w").create_array("v", data=steps, chunks=(1, 2, 3, 3, 1))
    np.testing.assert_array_equal(read_volume(path, step=1).values, A[::-1])


@pytest.mark.parametrize("name", COLORS)
def test_colors_are_no_values(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    COLORS[name](path)
    with pytest.raises(DataError, match="no single values") as caught:
        read_volume(path)
    first = "value.0" if name == "v.vti" else "value.x"
    assert f"{path}:variable={first}" in caught.value.remedy
    np.testing.assert_array_equal(read_volume(path, array=first).values, BYTES[..., 0])


def test_channels_of_a_microscope(tmp_path: Path) -> None:
    path = tmp_path / "c.ome.tif"
    both = np.stack([A, 2 * A], axis=1)
    tifffile.imwrite(path, both, photometric="minisblack", metadata={"axes": "ZCYX", **UM})
    with pytest.raises(DataError, match="no single values"):
        read_volume(path)
    np.testing.assert_array_equal(read_volume(path, array="value.1").values, 2 * A)


def test_the_content_picks_the_reader(tmp_path: Path) -> None:
    nibabel.save(nibabel.Nifti1Image(A.transpose(2, 1, 0), np.eye(4)), tmp_path / "v.nii")
    plain = (tmp_path / "v.nii").read_bytes()
    np.save(tmp_path / "v.npy", A)
    files = {
        "plain.nii.gz": plain,
        "packed.nii": gzip.compress(plain),
        "no_suffix": plain,
        "array.nrrd": (tmp_path / "v.npy").read_bytes(),
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
        np.testing.assert_array_equal(read_volume(tmp_path / name).values, A)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Pair, nibabel.AnalyzeImage])
@pytest.mark.parametrize("first", [(2,), (8, 5), (8, 0, 8, 0, 8, 8)])
def test_numbers_that_begin_as_dicom_does(tmp_path: Path, kind: type, first: tuple[int, ...]) -> None:
    """Without a preamble, a tag alone makes no DICOM file."""
    values = A.astype("i4" if len(first) == 1 else "i2")
    values[0, 0, : len(first)] = first
    nibabel.save(kind(values.transpose(2, 1, 0), np.eye(4)), tmp_path / "v.img")
    np.testing.assert_array_equal(read_volume(tmp_path / "v.img").values, values)


def test_plot3d_of_two_grids_is_no_dicom(tmp_path: Path) -> None:
    path = samples.write(tmp_path, "v.xyz")
    for file in (path, path.with_suffix(".q")):
        head, data = file.read_bytes()[:12], file.read_bytes()[12:]
        file.write_bytes(struct.pack("<i", 2) + 2 * head + 2 * data)
    assert "Density" in [v.name for v in list_variables(path)]


@pytest.mark.parametrize("name", ["v1.mnc", "v2.mnc"])
def test_minc_as_nibabel_reads_it(tmp_path: Path, name: str) -> None:
    path = samples.write(tmp_path, name)
    other = tmp_path / "other"
    other.write_bytes(path.read_bytes())
    volume = read_volume(path)
    np.testing.assert_array_equal(read_volume(other).values, volume.values)
    image = nibabel.load(path)
    np.testing.assert_array_equal(volume.values, np.asarray(image.dataobj))
    assert volume.spacing == image.header.get_zooms()[::-1]


def test_plot3d_by_either_name(tmp_path: Path) -> None:
    path = samples.write(tmp_path, "v.xyz")
    path.rename(tmp_path / "combxyz.bin")
    path.with_suffix(".q").rename(tmp_path / "combq.bin")
    for name in ("combxyz.bin", "combq.bin"):
        assert "Density" in [v.name for v in list_variables(tmp_path / name)]


def test_legacy_files_that_vtk_reads(tmp_path: Path) -> None:
    data = vtk.vtkImageData()
    data.SetDimensions(*A.shape[::-1])
    array = numpy_to_vtk(A.reshape(-1), deep=1)
    array.SetName("s")
    data.GetPointData().AddArray(array)
    texts = vtk.vtkStringArray()
    texts.SetName("names")
    texts.InsertNextValue("two words")
    data.GetFieldData().AddArray(texts)
    path = tmp_path / "v.vtk"
    writer = vtk.vtkDataSetWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.SetFileTypeToBinary()
    writer.Write()
    np.testing.assert_array_equal(read_volume(path, "s").values, A)
    old = b"# vtk DataFile Version 1.0\nold\n\nBINARY\nDATASET STRUCTURED_POINTS\nDIMENSIONS 7 5 6\n"
    old += b"ASPECT_RATIO 1 1 1\nORIGIN 0 0 0\nPOINT_DATA 210\nSCALARS s float\nLOOKUP_TABLE default\n"
    path.write_bytes(old + A.astype(">f4").tobytes() + b"\n")
    reader = vtk.vtkDataSetReader()
    reader.SetFileName(str(path))
    reader.Update()
    right = vtk_to_numpy(reader.GetOutput().GetPointData().GetArray("s")).reshape(A.shape)
    np.testing.assert_array_equal(read_volume(path).values, right)
