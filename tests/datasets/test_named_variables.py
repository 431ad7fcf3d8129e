"""Readers of ``.npz``, HDF5 and NetCDF: round trips through their own libraries, conventions, damage."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.catalogue.opening import _reader
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.datasets.readers import list_variables, read_volume, sandbox
from tests.datasets.damage import PROPERTY, check_damage, check_volumes
from tests.datasets.damage import array as _array

CLASSIC = ("NETCDF3_CLASSIC", "NETCDF3_64BIT_OFFSET", "NETCDF3_64BIT_DATA")
FORMATS = (*CLASSIC, "NETCDF4", "NETCDF4_CLASSIC")
AXES = {"z": np.arange(4) * 0.5, "y": np.arange(5) * 2.0, "x": np.arange(6) * 3.0}


def _netcdf(
    path: Path, variables: dict[str, np.ndarray], file_format: str = "NETCDF4",
    axes: dict[str, np.ndarray] = AXES, units: dict[str, str] | None = None, attributes: dict | None = None,
) -> Path:  # fmt: skip
    """Variables of 3 axes (z, y, x) or 4 (time, z, y, x)."""
    shape = next(iter(variables.values())).shape[-3:]
    with netCDF4.Dataset(path, "w", format=file_format) as file:
        file.createDimension("time", None)
        for name, size in zip("zyx", shape, strict=True):
            file.createDimension(name, size)
            if name in axes:
                stored = file.createVariable(name, "f8", (name,))
                stored[:] = axes[name]
                if units:
                    stored.units = units[name]
        for name, values in variables.items():
            dims = ("time", "z", "y", "x")[-values.ndim :]
            entries = dict(attributes or {})
            fill = entries.pop("_FillValue", None)
            stored = file.createVariable(name, values.dtype, dims, fill_value=fill)
            stored.set_auto_maskandscale(False)
            stored.setncatts(entries)
            stored[:] = values
    return path


@pytest.mark.parametrize("file_format", FORMATS)
def test_netcdf_round_trip(tmp_path: Path, file_format: str) -> None:
    series, other = _array("float32", (3, 4, 5, 6)), _array("int16", seed=1)
    path = _netcdf(tmp_path / "v.nc", {"T": series, "rho": other, "P": series + 1}, file_format)
    assert {(v.name, v.dims, v.steps) for v in list_variables(path)} == {
        ("T", (6, 5, 4), 3), ("rho", (6, 5, 4), 1), ("P", (6, 5, 4), 3)
    }  # fmt: skip
    for step in (0, 2):
        volume = read_volume(path, "T", step=step)
        np.testing.assert_array_equal(volume.values, series[step])
    np.testing.assert_array_equal(read_volume(path, array="P", step=1).values, series[1] + 1)
    assert volume.spacing == pytest.approx((3.0, 2.0, 0.5))
    assert volume.values.dtype.isnative
    named = read_volume(path, "density", array="rho")
    np.testing.assert_array_equal(named.values, other)
    assert named.name == "density"


def test_classic_record_variable_whose_axis_is_z(tmp_path: Path) -> None:
    a, b = _array("float64"), _array("int16", seed=2)
    with netCDF4.Dataset(tmp_path / "v.nc", "w", format="NETCDF3_CLASSIC") as file:
        for name, size in (("z", None), ("y", 5), ("x", 6)):
            file.createDimension(name, size)
        file.createVariable("a", "f8", ("z", "y", "x"))[:] = a
        file.createVariable("b", "i2", ("z", "y", "x"))[:] = b
    np.testing.assert_array_equal(read_volume(tmp_path / "v.nc", "a").values, a)
    np.testing.assert_array_equal(read_volume(tmp_path / "v.nc", "b").values, b)


def test_classic_files_are_memory_mapped(tmp_path: Path) -> None:
    path = _netcdf(tmp_path / "v.nc", {"v": _array("int8")}, "NETCDF3_CLASSIC")
    assert isinstance(read_volume(path).values, np.memmap)


@pytest.mark.parametrize("file_format", ["NETCDF3_CLASSIC", "NETCDF4"])
def test_missing_values_become_a_mask(tmp_path: Path, file_format: str) -> None:
    values = _array("float32")
    values[1, 2, 3], values[0, 0, 0], values[3, 4, 5] = -999.0, np.nan, 1e6
    path = _netcdf(
        tmp_path / "v.nc", {"v": values}, file_format,
        attributes={"_FillValue": np.float32(-999.0), "valid_max": np.float32(1000.0)},
    )  # fmt: skip
    volume = read_volume(path)
    assert volume.mask is not None
    assert {tuple(at) for at in np.argwhere(~volume.mask)} == {(1, 2, 3), (0, 0, 0), (3, 4, 5)}
    assert volume.value_range == (values[volume.mask].min(), values[volume.mask].max())
    np.testing.assert_array_equal(volume.values[volume.mask], values[volume.mask])
    neighbours = (values[0, 2, 3], values[2, 2, 3])  # along z first
    assert volume.values[1, 2, 3] in neighbours
    assert np.isfinite(volume.normalised()).all()


@pytest.mark.parametrize("kind", ["f4", "f8", "i2", "i4"])
def test_default_fill_of_what_was_never_written(tmp_path: Path, kind: str) -> None:
    with netCDF4.Dataset(tmp_path / "v.nc", "w", format="NETCDF3_CLASSIC") as file:
        for name, size in AXES.items():
            file.createDimension(name, len(size))
        file.createVariable("v", kind, ("z", "y", "x"))[:2] = _array("int16")[:2]
    volume = read_volume(tmp_path / "v.nc")
    assert volume.mask is not None
    np.testing.assert_array_equal(volume.mask, np.arange(4)[:, None, None] < np.full((4, 5, 6), 2))


def test_all_missing(tmp_path: Path) -> None:
    path = _netcdf(tmp_path / "v.nc", {"v": np.full((4, 5, 6), np.nan, "f4")})
    with pytest.raises(DataError, match="all values are missing"):
        read_volume(path)


@pytest.mark.parametrize("kind", ["int16", "int32", "uint8"])
def test_packed_values(tmp_path: Path, kind: str) -> None:
    stored = _array(kind)
    path = _netcdf(tmp_path / "v.nc", {"v": stored}, attributes={"scale_factor": 0.25, "add_offset": 100.0})
    volume = read_volume(path)
    np.testing.assert_allclose(volume.values, stored * 0.25 + 100.0)
    assert volume.values.dtype == (np.float64 if kind == "int32" else np.float32)


@pytest.mark.parametrize("file_format", ["NETCDF3_CLASSIC", "NETCDF4"])
def test_descending_axis_is_turned_round(tmp_path: Path, file_format: str) -> None:
    values = _array()
    path = _netcdf(tmp_path / "v.nc", {"v": values}, file_format, AXES | {"z": AXES["z"][::-1]})
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.values, values[::-1])
    assert volume.spacing == pytest.approx((3.0, 2.0, 0.5))


def test_units_decide_whether_axes_compare(tmp_path: Path) -> None:
    values = _array()
    degrees = {"x": "degrees_east", "y": "degrees_north", "z": "degrees"}
    path = _netcdf(tmp_path / "same.nc", {"v": values}, units=degrees)
    assert read_volume(path).spacing == pytest.approx((3.0, 2.0, 0.5))
    path = _netcdf(tmp_path / "mixed.nc", {"v": values}, units=degrees | {"z": "m"})
    assert read_volume(path).spacing == pytest.approx((1.0, 1.0, 1.0))
    assert read_volume(path, spacing=(1.0, 2.0, 3.0)).spacing == (1.0, 2.0, 3.0)


def test_uneven_axis_is_resampled(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    z = np.array([0.0, 1.0, 3.0, 7.0])
    grid = z[:, None, None] + 10.0 * AXES["y"][:, None] + 100.0 * AXES["x"]
    path = _netcdf(tmp_path / "v.nc", {"v": grid}, "NETCDF3_CLASSIC", AXES | {"z": z})
    volume = read_volume(path)
    assert volume.dims == (6, 5, 8)
    assert volume.spacing == pytest.approx((3.0, 2.0, 1.0))
    expected = np.arange(8.0)[:, None, None] + 10.0 * AXES["y"][:, None] + 100.0 * AXES["x"]
    np.testing.assert_allclose(volume.values, expected, rtol=1e-12)
    assert "resampled from 6 x 5 x 4 to 6 x 5 x 8" in caplog.text


def test_series_of_pictures_is_no_volume(tmp_path: Path) -> None:
    with netCDF4.Dataset(tmp_path / "v.nc", "w") as file:
        for name, size in (("time", 4), ("y", 5), ("x", 6)):
            file.createDimension(name, size)
        file.createVariable("v", "f4", ("time", "y", "x"))[:] = _array()
    with pytest.raises(DataError, match="no three-dimensional numeric array"):
        read_volume(tmp_path / "v.nc")


def _npz(path: Path, compressed: bool, **arrays: np.ndarray) -> Path:
    (np.savez_compressed if compressed else np.savez)(path, **arrays)
    return path


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["uint8", "int16", "float16", "float32", "float64", ">f4"])
def test_npz_round_trip(tmp_path: Path, compressed: bool, dtype: str) -> None:
    array = _array("float64").astype(dtype)
    path = _npz(
        tmp_path / "v.npz", compressed, a=array, f=np.asfortranarray(array), series=np.stack([array, -array])
    )
    for name in ("a", "f"):
        np.testing.assert_array_equal(read_volume(path, name).values, array)
    np.testing.assert_array_equal(read_volume(path, "series", step=1).values, -array)
    if not compressed and dtype == "uint8":
        assert isinstance(read_volume(path, "a").values, np.memmap)


@pytest.mark.parametrize("text", [b"{'descr': (", b"{'descr': '<f4', 'shape': (4,", b"[" * 9000, b"\xff\n"])
def test_a_header_that_numpy_cannot_parse(tmp_path: Path, text: bytes) -> None:
    with zipfile.ZipFile(tmp_path / "v.npz", "w") as archive:
        archive.writestr("v.npy", b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text)
    with pytest.raises(DataError, match=r"v.npz.* is not a readable .npz file"):
        list_variables(tmp_path / "v.npz")


def test_vectors_and_their_components(tmp_path: Path) -> None:
    vectors = _array("float32", (4, 5, 6, 3))
    path = _npz(tmp_path / "v.npz", False, u=vectors, x=AXES["x"], y=AXES["y"], z=AXES["z"])
    (variable,) = list_variables(path)
    assert (variable.dims, variable.components) == ((6, 5, 4), 3)
    volume = read_volume(path)
    np.testing.assert_allclose(volume.values, np.linalg.norm(vectors, axis=-1), rtol=1e-6)
    assert volume.spacing == pytest.approx((3.0, 2.0, 0.5))
    np.testing.assert_array_equal(read_volume(path, "u.y").values, vectors[..., 1])


@pytest.mark.parametrize("options", [{}, {"chunks": (2, 3, 4), "compression": "gzip"}, {"chunks": (4, 5, 6)}])
@pytest.mark.parametrize("dtype", ["bool", "uint8", "int64", "float16", "float32", ">f8"])
def test_hdf5_round_trip(tmp_path: Path, dtype: str, options: dict) -> None:
    array = _array("float64").astype(dtype)
    array.flat[:2] = 0, 1
    with h5py.File(tmp_path / "v.h5", "w") as file:
        file.create_dataset("fields/density", data=array, **options)
        file["fields/series"] = np.stack([array, array[::-1]])
        for name, axis in AXES.items():
            file[f"fields/{name}"] = axis
        file["text"] = "not a field"
    volume = read_volume(tmp_path / "v.h5", "fields/density")
    np.testing.assert_array_equal(volume.values, array)
    assert volume.spacing == pytest.approx((3.0, 2.0, 0.5))
    np.testing.assert_array_equal(read_volume(tmp_path / "v.h5", "fields/series", step=1).values, array[::-1])
    if not options and dtype == "uint8":
        assert isinstance(volume.values, np.memmap)


def test_choices_that_are_not_there(tmp_path: Path) -> None:
    path = _npz(
        tmp_path / "v.npz", False, Temperature=_array(), Pressure=_array(), s=_array("f4", (3, 4, 5, 6))
    )
    with pytest.raises(UnknownName, match="Did you mean Temperature"):
        read_volume(path, "Temprature")
    with pytest.raises(DataError, match="time steps 0 to 2"):
        read_volume(path, "s", step=3)
    with pytest.raises(DataError, match=r"holds 3 variables.*Name one: Temperature"):
        read_volume(path)
    with pytest.raises(DataError, match="Only meshes"):
        read_volume(path, "s", resolution=9)
    np.save(tmp_path / "v.npy", _array())
    with pytest.raises(DataError, match="no choice of variable"):
        read_volume(tmp_path / "v.npy", array="v")


def test_a_reader_that_dies_or_stands_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(tmp_path / "v.h5")
    source = sandbox.Stored(tmp_path / "v.h5", "hdf5")
    os.kill(source._child._child.pid, signal.SIGSEGV)
    with pytest.raises(DataError, match=r"crashed \(SIGSEGV\)"):
        source.read("v")
    source = sandbox.Stored(tmp_path / "v.h5", "hdf5")
    monkeypatch.setattr(source._child, "_patience", 0.2)
    os.kill(source._child._child.pid, signal.SIGSTOP)
    with pytest.raises(DataError, match="stood still"):
        source.read("v")
    assert source._child._child.poll() is not None


def test_dataset_of_all_variables(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n) for n in (12, 13, 14)], indexing="ij")
    blob = np.exp(-3.0 * (x * x + y * y + z * z)).astype(np.float32)
    path = _npz(
        tmp_path / "run.npz", False, T=blob, **{"a b": blob * x.astype("f4")}, flat=np.ones_like(blob)
    )
    dataset = open_dataset(path)
    assert list(dataset.volumes) == ["T", "a_b"]
    assert {scene.name.partition("_tf")[0] for scene in dataset.scenes} == {"T", "a_b"}
    assert dataset.compositions["all"] == tuple(scene.name for scene in dataset.scenes)
    assert "left out: flat (all values are 1)" in caplog.text
    np.testing.assert_array_equal(dataset.volume("T").values, blob)
    colors = [scene.transfer.bumps[0].color for scene in dataset.scenes if scene.transfer]
    assert len(set(colors)) == len(colors)

    one = open_dataset(f"{path}:variable=a b,step=0")
    assert one.name == "run-a_b-step0"
    assert [scene.variable for scene in one.scenes] == ["a_b"] * len(one.scenes)
    with pytest.raises(UnknownName, match="Did you mean variable"):
        open_dataset(f"{path}:varable=T")
    with pytest.raises(DataError, match="is no number"):
        open_dataset(f"{path}:variable=T,step=x")


def test_many_variables_become_at_most_twelve_scenes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = _npz(tmp_path / "run.npz", False, **{f"v{i}": _array(seed=i) for i in range(15)})
    dataset = open_dataset(path)
    assert len(dataset.scenes) == 12
    assert "left out: v12 (more than 12 scenes); v13" in caplog.text


def test_catalogue_entries_choose_array_and_step(tmp_path: Path) -> None:
    series = _array("f4", (3, 4, 5, 6))
    path = _npz(tmp_path / "v.npz", False, velocityMag=series, other=_array())
    volume = _reader(path, {"variable": "wind", "array": "velocityMag", "step": 2}, (1.0, 1.0, 2.0))()
    assert (volume.name, volume.spacing) == ("wind", (1.0, 1.0, 2.0))
    np.testing.assert_array_equal(volume.values, series[2])
    np.testing.assert_array_equal(_reader(path, {"variable": "other"}, None)().values, _array())


def _write(path: Path) -> Path:
    if path.suffix == ".npz":
        return _npz(path, "deflated" in path.name, v=_array("int16"), w=_array("float32"), **AXES)
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["v"] = _array()
            file.create_dataset("w", data=_array("int16"), chunks=(2, 2, 2), compression="gzip")
        return path
    return _netcdf(path, {"v": _array("int16"), "w": _array("float32", (2, 4, 5, 6))}, path.stem.upper())


@pytest.mark.parametrize(
    ("name", "many"),
    [
        *(
            (name, 40)
            for name in ("stored.npz", "deflated.npz", "netcdf3_classic.nc", "netcdf3_64bit_data.nc")
        ),
        *(pytest.param(name, 150, marks=pytest.mark.slow) for name in ("v.h5", "netcdf4.nc")),
    ],
)
def test_damaged_files(forks: None, tmp_path: Path, name: str, many: int) -> None:
    def check(path: Path) -> None:
        for variable in ("v", "w"):
            check_volumes(path, lambda variable=variable: [read_volume(path, variable)])

    check_damage(tmp_path / name, _write, check, "cut", "set", many=many)


@PROPERTY
@given(
    shape=st.tuples(*[st.integers(2, 7)] * 3), steps=st.integers(1, 3), seed=st.integers(0, 99),
    dtype=st.sampled_from(["int8", "int16", "int32", "float32", "float64"]),
    file_format=st.sampled_from(CLASSIC), suffix=st.sampled_from([".npz", ".nc"]),
)  # fmt: skip
def test_any_round_trip(
    tmp_path: Path, shape: tuple, steps: int, seed: int, dtype: str, file_format: str, suffix: str
) -> None:
    array = _array(dtype, (steps, *shape), seed)
    array[:, 0, 0, :2] = 5, 6
    path = tmp_path / f"v{suffix}"
    if suffix == ".npz":
        _npz(path, bool(seed % 2), v=array[..., None] if shape[-1] <= 4 else array)
    else:
        _netcdf(path, {"v": array}, file_format, {})
    if suffix == ".npz" and shape[-1] <= 4:
        return  # taken for vectors: a documented rule, tested above
    np.testing.assert_array_equal(read_volume(path, step=steps - 1).values, array[-1])


MEASURE = """
import sys
from econgs_bench.datasets.memory import peak_host_bytes
from econgs_bench.datasets.readers import read_volume
if sys.argv[2] == "volume":
    volume = read_volume(sys.argv[1], sys.argv[3] or None)
    assert float(volume.values[-1, -1, -1]) == 1.0
else:
    import econgs_bench.datasets.readers.arrays, econgs_bench.datasets.readers.sandbox
    import econgs_bench.datasets.readers.npz
    import econgs_bench.datasets.readers.netcdf3, econgs_bench.datasets.volume
print(peak_host_bytes())
"""


def peak_bytes(path: Path, variable: str = "") -> int:
    """Peak resident memory of a process that reads a file, less that of one that reads nothing."""
    peaks = []
    for what in ("volume", "nothing"):
        command = [sys.executable, "-c", MEASURE, str(path), what, variable]
        peaks.append(int(subprocess.check_output(command, cwd=path.parent)))
    return peaks[0] - peaks[1]


def big_array() -> np.ndarray:
    """64 MiB of float32."""
    big = np.zeros((256, 256, 256), np.float32)
    big[:, :, ::3] = np.arange(256, dtype=np.float32)[:, None, None] / 255.0
    big[-1] = 1.0
    return big


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["stored.npz", "deflated.npz", "classic.nc", "plain.h5", "gzip.h5", "nc4.nc", "masked.nc"]
)
def test_never_more_than_two_copies_in_memory(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    big = big_array()
    if path.suffix == ".npz":
        _npz(path, "deflated" in name, v=big)
    elif path.suffix == ".h5":
        packed = {"compression": "gzip", "compression_opts": 1} if "gzip" in name else {}
        with h5py.File(path, "w") as file:
            file.create_dataset("v", data=big, **packed)
    else:
        entries = {"_FillValue": np.float32(-1.0)} if "masked" in name else {}
        if "masked" in name:
            big[30:200, 40:90, 60:] = -1.0
        _netcdf(
            path, {"v": big}, "NETCDF4" if "4" in name else "NETCDF3_64BIT_OFFSET", {}, attributes=entries
        )
    masks = 2 * big.size if "masked" in name else 0  # the result, and the one that grows while it is filled
    assert peak_bytes(path) < 2.1 * big.nbytes + masks
