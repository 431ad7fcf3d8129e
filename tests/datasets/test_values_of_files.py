"""Values as the formats' own libraries give them, and a refusal where a file says too little for that.

Expected values are computed here or read by the formats' libraries.
"""

from __future__ import annotations

import gzip
import logging
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import netCDF4
import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
import zarr

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import list_variables, read_volume
from econgs_bench.datasets.readers.finish import unpacked_type
from econgs_bench.datasets.readers.lengths import in_one_unit
from econgs_bench.datasets.scratch import converted, picked

pytestmark = pytest.mark.usefixtures("forks")

Z, Y, X = np.meshgrid(np.arange(4), np.arange(5), np.arange(6), indexing="ij")
FIELD = (X + 10 * Y + 100 * Z).astype("f4")


def _relative(spacing: tuple[float, float, float]) -> list[float]:
    return [distance / spacing[0] for distance in spacing]


# Named axes -------------------------------------------------------------------------------------------------


def _netcdf(path: Path, dims: tuple[str, ...], values: np.ndarray) -> None:
    with netCDF4.Dataset(
        path, "w", format="NETCDF3_CLASSIC" if "classic" in path.stem else "NETCDF4"
    ) as data:
        for name, count in zip(dims, values.shape, strict=True):
            data.createDimension(name, count)
        data.createVariable("v", "f4", dims)[:] = values


def _hdf5(path: Path, dims: tuple[str, ...], values: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        file["v"] = values
        for axis, name in enumerate(dims):
            file[name] = np.arange(values.shape[axis])
            file[name].make_scale()
            file["v"].dims[axis].attach_scale(file[name])


def _labels(path: Path, dims: tuple[str, ...], values: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        file["v"] = values
        for axis, name in enumerate(dims):
            file["v"].dims[axis].label = name


def _zarr(path: Path, dims: tuple[str, ...], values: np.ndarray) -> None:
    array = zarr.create_array(path, name="v", shape=values.shape, dtype="f4", dimension_names=dims)
    array[:] = values


NAMED: dict[str, Callable[[Path, tuple[str, ...], np.ndarray], None]] = {
    "v.nc": _netcdf,
    "classic.nc": _netcdf,
    "v.h5": _hdf5,
    "labels.h5": _labels,
    "v.zarr": _zarr,
}


@pytest.mark.parametrize("name", NAMED)
@pytest.mark.parametrize(
    "dims", [("z", "y", "x", "time"), ("lat", "time", "lon", "lev"), ("z", "y", "x", "q")]
)
def test_time_is_found_among_all_named_axes(tmp_path: Path, name: str, dims: tuple[str, ...]) -> None:
    at = dims.index("time") if "time" in dims else 3
    NAMED[name](tmp_path / name, dims, np.stack([FIELD, FIELD + 1000], at))
    [variable] = [v for v in list_variables(tmp_path / name) if v.name == "v"]
    assert (variable.dims, variable.steps) == ((6, 5, 4), 2)
    for step in range(2):
        volume = read_volume(tmp_path / name, "v", step=step)
        np.testing.assert_array_equal(volume.values, FIELD + 1000 * step)


@pytest.mark.parametrize("name", NAMED)
def test_channels_are_found_among_all_named_axes(tmp_path: Path, name: str) -> None:
    NAMED[name](tmp_path / name, ("z", "y", "x", "c"), np.stack([FIELD, 2 * FIELD, 0 * FIELD], -1))
    with pytest.raises(DataError, match="no single values"):
        read_volume(tmp_path / name, array="v")
    np.testing.assert_array_equal(read_volume(tmp_path / name, array="v.y").values, 2 * FIELD)


@pytest.mark.parametrize("dims", [("lat", "lon", "time"), ("y", "x", "c"), ("time", "y", "x", "channel")])
def test_pictures_are_no_volume(tmp_path: Path, dims: tuple[str, ...]) -> None:
    _netcdf(tmp_path / "v.nc", dims, np.ones((3, 4, 5, 3)[-len(dims) :]))
    with pytest.raises(DataError, match="no three-dimensional numeric array"):
        read_volume(tmp_path / "v.nc")


def test_an_axis_named_c_of_space_stays(tmp_path: Path) -> None:
    _netcdf(tmp_path / "v.nc", ("a", "b", "c"), FIELD)
    np.testing.assert_array_equal(read_volume(tmp_path / "v.nc").values, FIELD)


def test_an_axis_without_positions_has_the_mean_distance(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file["v"] = FIELD
        for axis, (name, step) in enumerate({"z": None, "y": 3.0, "x": 1.0}.items()):
            file["v"].dims[axis].label = name
            if step is not None:
                file[name] = step * np.arange(FIELD.shape[axis])
    micrometers = {"axes": "ZYX", "PhysicalSizeX": 1.0, "PhysicalSizeY": 3.0}
    tifffile.imwrite(tmp_path / "v.ome.tif", FIELD, photometric="minisblack", metadata=micrometers)
    for name in ("v.h5", "v.ome.tif"):
        assert read_volume(tmp_path / name).spacing == pytest.approx((1.0, 3.0, 2.0))
        assert f"{name}: no sample distance along z: the mean of the others is taken" in caplog.text


def test_a_filter_that_hdf5_lacks_is_named(tmp_path: Path) -> None:
    path = tmp_path / "v.h5"
    with h5py.File(path, "w") as file:
        options = {"chunks": FIELD.shape, "compression": 511, "allow_unknown_filter": True}
        data = file.create_dataset("v", FIELD.shape, "f4", **options)
        data.id.write_direct_chunk((0, 0, 0), bytes(999))
    with pytest.raises(DataError, match=r"'v' is packed by filter 511 .*, which HDF5 lacks here") as caught:
        read_volume(path)
    assert "h5repack" in caught.value.remedy


def test_what_hdf5_says_of_a_damaged_chunk_is_passed_on(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        data = file.create_dataset("v", FIELD.shape, "f4", chunks=FIELD.shape, compression="gzip")
        data.id.write_direct_chunk((0, 0, 0), bytes(99))
    with pytest.raises(DataError, match=r"its values cannot be read \(OSError: .*filter returned failure"):
        read_volume(tmp_path / "v.h5")


@pytest.mark.parametrize("name", ["v.h5", "v.zarr"])
def test_arrays_that_are_no_real_numbers_are_named(tmp_path: Path, name: str) -> None:
    arrays = {"a": FIELD.astype("c8"), "b": FIELD.astype([("re", "f4")]), "text": np.array(["a", "bc"], "S2")}
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file.update(arrays)
    group = zarr.open_group(tmp_path / "v.zarr", mode="w", zarr_format=2)
    for key, values in arrays.items():
        group.create_array(key, data=values)
    group.create_array("names", shape=(2,), dtype=str, attributes={"_ARRAY_DIMENSIONS": ["n"]})
    with pytest.raises(DataError, match="no three-dimensional numeric array") as caught:
        read_volume(tmp_path / name)
    for described in ("a [4, 5, 6] (complex64)", "b [4, 5, 6] (compound)", "text [2] (text)"):
        assert described in caught.value.remedy


# Scale and offset -------------------------------------------------------------------------------------------


def test_packed_positions(tmp_path: Path) -> None:
    with netCDF4.Dataset(tmp_path / "v.nc", "w") as data:
        for name, count, scale in zip("zyx", FIELD.shape, (2.0, 1.0, 0.5), strict=True):
            data.createDimension(name, count)
            axis = data.createVariable(name, "i2", (name,))
            axis.scale_factor, axis.units = scale, "m"
            axis[:] = scale * np.arange(count)
        data.createVariable("v", "f4", ("z", "y", "x"))[:] = FIELD
    assert read_volume(tmp_path / "v.nc").spacing == (0.5, 1.0, 2.0)


def test_copies_of_arrays_of_one_axis() -> None:
    np.testing.assert_array_equal(converted(np.arange(5, dtype="i2"), np.float32), np.arange(5.0))
    np.testing.assert_array_equal(picked(np.arange(5), [4, 1]), [4, 1])


@pytest.mark.parametrize("name", ["v.nc", "v.nii"])
def test_small_steps_on_a_large_offset_stay_apart(tmp_path: Path, name: str) -> None:
    path, packed = tmp_path / name, FIELD.astype("i2")
    if name == "v.nc":
        with netCDF4.Dataset(path, "w") as data:
            for axis, count in zip("zyx", FIELD.shape, strict=True):
                data.createDimension(axis, count)
            variable = data.createVariable("v", "i2", ("z", "y", "x"))
            variable.scale_factor, variable.add_offset = 1e-4, 1e5
            variable.set_auto_maskandscale(False)
            variable[:] = packed
        with netCDF4.Dataset(path) as data:
            expected = np.asarray(data["v"][:])
    else:
        nibabel.save(nibabel.Nifti1Image(packed.transpose(2, 1, 0), np.eye(4)), path)
        header = bytearray(path.read_bytes())
        header[112:120] = struct.pack("<ff", 1e-4, 1e5)
        path.write_bytes(header)
        expected = nibabel.load(path).get_fdata().transpose(2, 1, 0)
    values = read_volume(path).values
    np.testing.assert_allclose(values, expected, rtol=1e-15)
    assert len(np.unique(values)) == FIELD.size


def test_customary_packing_is_single_precision() -> None:
    """Tomography, and temperatures of a reanalysis: rounding is far smaller than a step."""
    assert unpacked_type(np.dtype("i2"), 1.0, -1024.0) == np.float32
    assert unpacked_type(np.dtype("i2"), 0.0018, 273.0) == np.float32
    assert unpacked_type(np.dtype("i2"), 1e-4, 1e5) == np.float64
    assert unpacked_type(np.dtype("i4"), 1.0, 0.0) == np.float64


# HDF5 -------------------------------------------------------------------------------------------------------


def test_chunks_that_were_never_written(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with h5py.File(tmp_path / "v.h5", "w") as file:
        data = file.create_dataset("v", (64, 64, 64), "u1", chunks=(16, 16, 16), compression="gzip")
        data[3, 4, 5], data[60, 4, 5] = 9, 2
        expected = data[:]
    np.testing.assert_array_equal(read_volume(tmp_path / "v.h5").values, expected)
    assert "62 of 64 chunks of 'v' are absent: they have its fill value 0" in caplog.text
    with h5py.File(tmp_path / "large.h5", "w") as file:
        file.create_dataset("v", (1 << 14,) * 3, "u1", chunks=(16, 16, 16))[3, 4, 5] = 9
    with pytest.raises(DataError, match="cannot hold"):
        read_volume(tmp_path / "large.h5")


def _virtual(path: Path, sources: list[tuple[slice, h5py.VirtualSource]]) -> None:
    with h5py.File(path, "w") as file:
        layout = h5py.VirtualLayout((4, 30, 40), "f4")
        for at, source in sources:
            layout[at] = source
        file.create_virtual_dataset("v", layout)


def test_sources_of_a_virtual_dataset(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    values = np.random.default_rng(0).random((4, 30, 40), np.float32)
    with h5py.File(tmp_path / "a.h5", "w") as a, h5py.File(tmp_path / "b.h5", "w") as b:
        a["v"], b["v"] = values[:2], values[2:]
    parts = [h5py.VirtualSource(f"{name}.h5", "v", (2, 30, 40)) for name in "ab"]
    path = tmp_path / "v.h5"
    _virtual(path, [(np.s_[:2], parts[0]), (np.s_[2:], parts[1])])
    np.testing.assert_array_equal(read_volume(path).values, values)
    _virtual(tmp_path / "half.h5", [(np.s_[:2], parts[0])])
    read_volume(tmp_path / "half.h5")
    assert "2400 of 4800 values of 'v' have no source" in caplog.text
    _virtual(tmp_path / "nested.h5", [(np.s_[:], h5py.VirtualSource("v.h5", "v", (4, 30, 40)))])
    (tmp_path / "b.h5").unlink()
    for name in ("v.h5", "nested.h5"):
        with pytest.raises(DataError, match=r"takes values from b\.h5, which is not there"):
            read_volume(tmp_path / name)
    for name, shape in (("w", (2, 30, 40)), ("v", (2, 30, 50))):
        with h5py.File(tmp_path / "b.h5", "w") as b:
            b[name] = np.zeros(shape)[..., :7]
        with pytest.raises(DataError, match=r"takes values from 'v' of .*b\.h5, which lacks them"):
            read_volume(path)


def test_values_in_an_external_file_that_is_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    FIELD.tofile("v.bin")
    with h5py.File("v.h5", "w") as file:
        file.create_dataset("v", FIELD.shape, "f4", external=[("v.bin", 0, FIELD.nbytes)])
    np.testing.assert_array_equal(read_volume("v.h5").values, FIELD)
    FIELD[:2].tofile("v.bin")
    with pytest.raises(DataError, match=r"v\.bin is truncated"):
        read_volume("v.h5")


def test_integers_that_lie_otherwise_in_the_file(tmp_path: Path) -> None:
    kind = h5py.h5t.STD_U16LE.copy()
    kind.set_precision(12)
    kind.set_offset(4)
    with h5py.File(tmp_path / "v.h5", "w") as file:
        data = h5py.h5d.create(file.id, b"v", kind, h5py.h5s.create_simple(FIELD.shape))
        data.write(h5py.h5s.ALL, h5py.h5s.ALL, np.ascontiguousarray(FIELD.astype("u2")))
    volume = read_volume(tmp_path / "v.h5")
    np.testing.assert_array_equal(volume.values, FIELD)
    for dtype in ("f2", "<f4", ">f8", ">u2", "i8", bool):
        with h5py.File(tmp_path / "plain.h5", "w") as file:
            file["v"] = (FIELD > 100) if dtype is bool else FIELD.astype(dtype)
        values = read_volume(tmp_path / "plain.h5").values
        np.testing.assert_array_equal(values, FIELD > 100 if dtype is bool else FIELD)


# NRRD -------------------------------------------------------------------------------------------------------

HEAD = "NRRD0005\ndimension: 3\nencoding: raw\n"


def _nrrd(path: Path, fields: str, data: bytes) -> Path:
    path.write_bytes(f"{HEAD}{fields}\n\n".encode() + data)
    return path


def test_nrrd_without_byte_order(tmp_path: Path) -> None:
    path = _nrrd(tmp_path / "v.nrrd", "sizes: 6 5 4\ntype: short", FIELD.astype(">i2").tobytes())
    with pytest.raises(DataError, match="does not say its byte order"):
        read_volume(path)
    values = FIELD.astype("u1")
    _nrrd(path, "sizes: 6 5 4\ntype: uchar", values.tobytes())
    np.testing.assert_array_equal(read_volume(path).values, values)


@pytest.mark.parametrize(
    ("fields", "relative"),
    [
        ("axis mins: 0 0 0\naxis maxs: 3 5 8\ncenters: cell cell cell", (1, 2, 4)),
        ("axis mins: 0 0 0\naxis maxs: 5 8 12\ncenterings: node node node", (1, 2, 4)),
        ("axismins: 0 0 0\naxismaxs: 3 5 8", (1, 2, 4)),
        ("axis mins: 0 0 0\naxis maxs: 3 5 8\nspacings: 1 1 3", (1, 1, 3)),
    ],
)
def test_nrrd_spacing_by_the_ends_of_axes(tmp_path: Path, fields: str, relative: tuple[int, ...]) -> None:
    fields = f"sizes: 6 5 4\ntype: short\nendian: little\n{fields}"
    volume = read_volume(_nrrd(tmp_path / "v.nrrd", fields, FIELD.astype("<i2").tobytes()))
    np.testing.assert_allclose(_relative(volume.spacing), relative)


@pytest.mark.parametrize(
    "fields",
    [
        "sizes: 3 6 5\nkinds: RGB-color domain domain",
        "sizes: 2 6 5\nkinds: vector space space\nspace dimension: 2\nspace directions: none (1,0) (0,2)",
        "sizes: 2 6 5\nspace dimension: 2\nspace directions: none (1,0) (0,2)",
        "sizes: 6 5 3\nkinds: domain domain time",
    ],
)
def test_nrrd_pictures_are_no_volume(tmp_path: Path, fields: str) -> None:
    path = _nrrd(tmp_path / "v.nrrd", f"type: uchar\n{fields}", np.arange(90, dtype="u1").tobytes())
    with pytest.raises(DataError, match="is 2-D data"):
        read_volume(path)


@pytest.mark.parametrize("kind", ["RGB-color", "HSV-color", "XYZ-color", "3-color"])
def test_nrrd_colors(tmp_path: Path, kind: str) -> None:
    colors = np.stack([FIELD, 2 * FIELD, FIELD], -1).transpose(3, 2, 1, 0)
    nrrd.write(str(tmp_path / "v.nrrd"), colors, {"kinds": [kind, *["domain"] * 3]})
    with pytest.raises(DataError, match="no single values"):
        read_volume(tmp_path / "v.nrrd")
    np.testing.assert_array_equal(read_volume(tmp_path / "v.nrrd", array="value.y").values, 2 * FIELD)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ("sizes: 6 5 4", "it lacks type"),
        ("sizes: 6 5 4\ntype: uchar\ndata file: LIST\na.raw\nb.raw", "its data lie in several files"),
        ("sizes: 6 5 4\ntype: uchar\ndata file: v%02d.raw 0 3 1", "its data lie in several files"),
    ],
)
def test_nrrd_headers_that_are_refused(tmp_path: Path, fields: str, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        read_volume(_nrrd(tmp_path / "v.nhdr", fields, b""))


@pytest.mark.parametrize("kinds", ["??? ??? ???", "domain domain domain", "space space space"])
def test_nrrd_axes_of_space(tmp_path: Path, kinds: str) -> None:
    values = FIELD.astype("u1")
    _nrrd(tmp_path / "v.nrrd", f"type: uchar\nsizes: 6 5 4\nkinds: {kinds}", values.tobytes())
    np.testing.assert_array_equal(read_volume(tmp_path / "v.nrrd").values, values)


# NIfTI ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [nibabel.AnalyzeImage, nibabel.Nifti1Pair])
def test_a_pair_by_either_name(tmp_path: Path, kind: type) -> None:
    nibabel.save(kind(FIELD.transpose(2, 1, 0), np.diag([0.5, 1, 2, 1])), tmp_path / "v.img")
    data = (tmp_path / "v.img").read_bytes()
    for suffix in (".img", ".hdr"):
        volume = read_volume(tmp_path / f"v{suffix}")
        np.testing.assert_array_equal(volume.values, FIELD)
        assert volume.spacing == (0.5, 1.0, 2.0)
    (tmp_path / "v.img").write_bytes(data[:400])
    with pytest.raises(DataError, match=r"v\.img: holds 400 bytes"):
        read_volume(tmp_path / "v.hdr")
    (tmp_path / "v.img").unlink()
    with pytest.raises(DataError, match=r"data file .*v\.img does not exist"):
        read_volume(tmp_path / "v.hdr")
    (tmp_path / "v.img.gz").write_bytes(gzip.compress(data))
    np.testing.assert_array_equal(read_volume(tmp_path / "v.hdr").values, FIELD)
    (tmp_path / "v.hdr.gz").write_bytes(gzip.compress((tmp_path / "v.hdr").read_bytes()))
    for suffix in (".img.gz", ".hdr.gz"):
        np.testing.assert_array_equal(read_volume(tmp_path / f"v{suffix}").values, FIELD)


def test_nifti_of_no_time_steps(tmp_path: Path) -> None:
    nibabel.save(nibabel.Nifti1Image(FIELD.transpose(2, 1, 0), np.eye(4)), tmp_path / "v.nii")
    header = bytearray((tmp_path / "v.nii").read_bytes())
    header[40:50] = struct.pack("<5h", 4, 6, 5, 4, 0)
    (tmp_path / "v.nii").write_bytes(header)
    with pytest.raises(DataError, match="has no samples \\(size 6 x 5 x 4 x 0\\)"):
        read_volume(tmp_path / "v.nii")


@pytest.mark.parametrize("shape", [(6, 5), (6,)])
def test_nifti_of_less_than_three_axes(tmp_path: Path, shape: tuple[int, ...]) -> None:
    nibabel.save(nibabel.Nifti1Image(np.ones(shape, "f4"), np.eye(4)), tmp_path / "v.nii")
    with pytest.raises(DataError, match=f"is {len(shape)}-D data"):
        read_volume(tmp_path / "v.nii")


def test_remarks_of_nibabel_name_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "v.nii"
    nibabel.save(nibabel.Nifti1Image(FIELD.transpose(2, 1, 0), None), path)
    header = bytearray(path.read_bytes())
    header[80:92] = bytes(12)
    path.write_bytes(header)
    np.testing.assert_array_equal(read_volume(path).values, FIELD)
    assert f"{path}: pixdim" in caplog.text
    assert "pixdim" not in capfd.readouterr().err


@pytest.mark.parametrize("name", ["v.npy", "v.nii", "v.mha", "v.nrrd"])
def test_bytes_after_the_values_are_told(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / name
    if name == "v.npy":
        np.save(path, FIELD)
    elif name == "v.nii":
        nibabel.save(nibabel.Nifti1Image(FIELD.transpose(2, 1, 0), np.eye(4)), path)
    elif name == "v.mha":
        sitk.WriteImage(sitk.GetImageFromArray(FIELD), path)
    else:
        nrrd.write(str(path), FIELD.transpose(2, 1, 0), {"encoding": "raw"})
    with path.open("ab") as file:
        file.write(b"\n\n\n")
    np.testing.assert_array_equal(read_volume(path).values, FIELD)
    assert f"{path}: bytes after its values are left out: 3" in caplog.text


def test_megametres_are_no_millimetres() -> None:
    assert in_one_unit([1.0, 1.0], ["mm", "Mm"]) == pytest.approx([1.0, 1e9])
    assert in_one_unit([1.0, 1.0], ["mm", "MM"]) == pytest.approx([1.0, 1.0])


# Pictures ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", ["ZYX", "TYX", None])
def test_a_folder_of_stacks(tmp_path: Path, axes: str | None) -> None:
    for k in range(3):
        metadata = {} if axes is None else {"axes": axes}
        tifffile.imwrite(tmp_path / f"t{k}.tif", FIELD, photometric="minisblack", metadata=metadata)
    with pytest.raises(DataError, match=r"t0\.tif is no slice: it has the axes 4 \(.\) x 5 \(Y\) x 6 \(X\)"):
        read_volume(tmp_path)


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_a_folder_of_colors(tmp_path: Path, planar: str) -> None:
    colors = np.stack([FIELD, 2 * FIELD, FIELD], -1).astype("u2")
    for k, plane in enumerate(colors):
        data = np.moveaxis(plane, -1, 0) if planar == "separate" else plane
        tifffile.imwrite(tmp_path / f"t{k}.tif", data, photometric="rgb", planarconfig=planar)
    np.testing.assert_array_equal(read_volume(tmp_path, array="value.y").values, 2 * FIELD)


def _png(path: Path, pixels: np.ndarray, color: int) -> None:
    """A PNG file of 16 bits by its specification."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", width, height, 16, color, 0, 0, 0)
    packed = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + packed)


@pytest.mark.parametrize(("color", "samples"), [(0, 1), (4, 2), (2, 3), (6, 4)])
def test_png_of_16_bits(tmp_path: Path, color: int, samples: int) -> None:
    gray = (100 * FIELD + Y).astype("u2")
    for k, plane in enumerate(gray):
        pixels = np.stack([plane] * samples, -1)
        if samples in (2, 4):
            pixels[..., -1] = 65535
        _png(tmp_path / f"s{k}.png", pixels, color)
    volume = read_volume(tmp_path)
    assert volume.values.dtype == np.uint16
    np.testing.assert_array_equal(volume.values, gray)


def test_png_of_16_bits_that_claims_too_much(tmp_path: Path) -> None:
    for k in range(2):
        path = tmp_path / f"s{k}.png"
        _png(path, np.ones((4, 4, 4)), 6)
        data = bytearray(path.read_bytes())
        data[16:24] = struct.pack(">II", 9000, 9000)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
        path.write_bytes(data)
    with pytest.raises(DataError, match="need 648000000 bytes"):
        read_volume(tmp_path)


def _calibrated(path: Path, values: np.ndarray, **about: float) -> None:
    tifffile.imwrite(path, values, imagej=True, metadata={"axes": "ZYX"[-values.ndim :], **about})


def test_imagej_calibration(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    signed = FIELD - 1000
    stored = (signed + 32768).astype("u2")
    _calibrated(tmp_path / "v.tif", stored, cf=0, c0=-32768.0, c1=1.0)
    np.testing.assert_array_equal(read_volume(tmp_path / "v.tif").values, signed)
    (tmp_path / "slices").mkdir()
    for k, plane in enumerate(stored):
        _calibrated(tmp_path / "slices" / f"s{k}.tif", plane, cf=0, c0=-32768.0, c1=1.0)
    np.testing.assert_array_equal(read_volume(tmp_path / "slices").values, signed)
    for name, function, told in (("none", 20, False), ("exponential", 4, True)):
        caplog.clear()
        _calibrated(tmp_path / f"{name}.tif", stored, cf=function, c0=1.0, c1=2.0)
        with caplog.at_level(logging.WARNING):
            np.testing.assert_array_equal(read_volume(tmp_path / f"{name}.tif").values, stored)
        assert ("calibration function 4 is not applied" in caplog.text) == told


# VTK --------------------------------------------------------------------------------------------------------


def _pieces(path: Path, *pieces: tuple[int, int, str]) -> Path:
    """An image of pieces along x: first and last sample, and the name of its array."""
    text = '<VTKFile type="ImageData" version="0.1" byte_order="LittleEndian"><ImageData '
    text += 'WholeExtent="0 5 0 4 0 3" Origin="0 0 0" Spacing="1 1 1">'
    for first, last, name in pieces:
        values = " ".join(map(str, FIELD[:, :, first : last + 1].ravel()))
        text += f'<Piece Extent="{first} {last} 0 4 0 3"><PointData><DataArray type="Float32" '
        text += f'Name="{name}" format="ascii">{values}</DataArray></PointData></Piece>'
    path.write_text(f'<?xml version="1.0"?>{text}</ImageData></VTKFile>')
    return path


@pytest.mark.parametrize(
    "pieces", [((0, 3, "v"), (3, 5, "v")), ((0, 4, "v"), (1, 5, "v")), ((0, 5, "v"),) * 2]
)
def test_pieces_that_fill_an_image(tmp_path: Path, pieces: tuple[tuple[int, int, str], ...]) -> None:
    np.testing.assert_array_equal(read_volume(_pieces(tmp_path / "v.vti", *pieces)).values, FIELD)


@pytest.mark.parametrize(
    ("pieces", "reason"),
    [
        (((0, 3, "v"), (0, 3, "v")), "its pieces do not fill its extent"),
        (((0, 2, "v"), (3, 5, "v"), (0, 2, "v")), "its pieces do not fill its extent"),
        (((0, 3, "v"), (3, 5, "w")), "a piece of it lacks 'v'"),
    ],
)
def test_pieces_that_leave_memory_as_it_was(
    tmp_path: Path, pieces: tuple[tuple[int, int, str], ...], reason: str
) -> None:
    with pytest.raises(DataError, match=reason):
        read_volume(_pieces(tmp_path / "v.vti", *pieces))
