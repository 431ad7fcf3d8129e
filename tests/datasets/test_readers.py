"""Readers: round trips against the formats' own libraries, and one clear error for whatever is wrong."""

from __future__ import annotations

import gzip
import os
from functools import partial
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import read_volume
from econgs_bench.datasets.volume import Volume
from tests.datasets.damage import PROPERTY, array, check_damage, check_refused, check_volumes

INTEGERS = tuple(f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("u", ""))
KINDS = (*INTEGERS, "float16", "float32", "float64")


_array = partial(array, shape=(3, 4, 5))


def _write(path: Path, array: np.ndarray, spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
    """Write a (z, y, x) array by suffix."""
    if path.name.endswith(".npy"):
        np.save(path, array)
    elif path.name.endswith(".nrrd"):
        nrrd.write(str(path), array.transpose(2, 1, 0), {"spacings": spacing})
    elif ".nii" in path.name:
        image = nibabel.Nifti1Image(array.transpose(2, 1, 0), np.diag([*spacing, 1.0]), dtype=array.dtype)
        nibabel.save(image, path)
    else:
        data = array.tobytes()
        path.write_bytes(gzip.compress(data) if path.name.endswith(".gz") else data)


@pytest.mark.parametrize("dtype", KINDS)
@pytest.mark.parametrize(
    "name", ["v_5x4x3_{}.raw", "v_5x4x3_{}_le.raw.gz", "v.npy", "v.nrrd", "v.nii", "v.nii.gz"]
)
def test_round_trip(tmp_path: Path, name: str, dtype: str) -> None:
    if dtype == "float16" and ("nii" in name or "nrrd" in name):
        pytest.skip("the format has no half precision")
    path = tmp_path / name.format(dtype)
    array = _array(dtype)
    _write(path, array)
    volume = read_volume(path, "density")
    np.testing.assert_array_equal(volume.values, array)
    assert volume.values.dtype == np.dtype(dtype)
    assert volume.name == "density"
    assert volume.dims == (5, 4, 3)
    assert volume.value_range == (float(array.min()), float(array.max()))


def test_x_is_fastest_and_y_next(tmp_path: Path) -> None:
    path = tmp_path / "axes_4x3x2_uint8.raw"
    path.write_bytes(bytes(range(24)))
    volume = read_volume(path)
    assert volume.values[0, 0, 3] == 3
    assert volume.values[0, 2, 0] == 8
    assert volume.values[1, 0, 0] == 12
    assert isinstance(volume.values, np.memmap)


def test_big_endian(tmp_path: Path) -> None:
    array = _array("int16")
    path = tmp_path / "v_5x4x3_int16_be.raw"
    path.write_bytes(array.astype(">i2").tobytes())
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.values, array)
    assert volume.values.dtype.isnative


def test_sidecar_leads(tmp_path: Path) -> None:
    array = _array("float32")
    path = tmp_path / "scan_9x9x9_uint8.raw"
    path.write_bytes(b"header!" + array.astype(">f4").tobytes())
    (tmp_path / "scan_9x9x9_uint8.raw.toml").write_text(
        'dims = [5, 4, 3]\ndtype = "float32"\nendian = "big"\nspacing = [1, 1, 2.5]\nheader_bytes = 7\n'
    )
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.values, array)
    assert volume.spacing == (1.0, 1.0, 2.5)
    np.testing.assert_allclose(volume.extent, np.array([4, 3, 5]) / 5)


@pytest.mark.parametrize("name", ["v.nrrd", "v.nii", "v.nii.gz"])
def test_spacing_of_the_file(tmp_path: Path, name: str) -> None:
    _write(tmp_path / name, _array("int16"), (0.5, 1.0, 2.0))
    assert read_volume(tmp_path / name).spacing == pytest.approx((0.5, 1.0, 2.0))


def test_nrrd_space_directions_detached_and_big_endian(tmp_path: Path) -> None:
    array = _array("int16")
    header = {"space directions": np.array([[0, 2, 0], [3, 0, 0], [0, 0, 0.5]]), "space dimension": 3}
    header |= {"encoding": "raw", "endian": "big"}
    nrrd.write(str(tmp_path / "v.nhdr"), array.transpose(2, 1, 0), header, detached_header=True)
    volume = read_volume(tmp_path / "v.nhdr")
    np.testing.assert_array_equal(volume.values, array)
    assert volume.spacing == (2.0, 3.0, 0.5)


def test_nifti_slope_and_intercept(tmp_path: Path) -> None:
    stored = _array("int16")
    image = nibabel.Nifti1Image(stored.transpose(2, 1, 0), np.eye(4))
    image.header.set_slope_inter(0.5, -3.0)
    nibabel.save(image, tmp_path / "v.nii.gz")
    volume = read_volume(tmp_path / "v.nii.gz")
    np.testing.assert_allclose(
        volume.values, nibabel.load(tmp_path / "v.nii.gz").get_fdata().transpose(2, 1, 0)
    )
    assert volume.value_range[0] != float(stored.min())


def test_large_integers_keep_their_differences() -> None:
    values = (2**40 + np.arange(27, dtype=np.int64)).reshape(3, 3, 3)
    volume = Volume("v", values, (1.0, 1.0, 1.0), (2.0**40, 2.0**40 + 26), "")
    np.testing.assert_allclose(volume.normalised().reshape(-1), np.arange(27) / 26, atol=1e-6)


BAD = {
    "short_4x4x4_uint8.raw": (bytes(63), "holds 63 bytes"),
    "long_4x4x4_uint8.raw": (bytes(65), "holds 65 bytes"),
    "zero_0x4x4_uint8.raw": (bytes(1), "no samples"),
    "flat_4x4_uint8.raw": (bytes(16), "2-D"),
    "thin_4x4x1_uint8.raw": (bytes(range(16)), "2-D"),
    "five_2x2x2x2x2_uint8.raw": (bytes(32), "5-D"),
    "constant_2x2x2_uint8.raw": (bytes(8), "all values are 0"),
    "odd_2x2x2_uint7.raw": (bytes(8), "unknown type 'uint7'"),
    "nameless.raw": (bytes(8), "does not say the dims and type"),
    "typeless_2x2x2.raw": (bytes(8), "does not say the type"),
    "huge_99999999x99999999x99999999_float64.raw": (bytes(8), "need"),
    "huge_99999999x99999999x99999999_float64.raw.gz": (gzip.compress(bytes(8)), "need"),
    "nogzip_2x2x2_uint8.raw.gz": (bytes(range(8)), "gzip stream"),
    "cut_4x4x4_uint8.raw.gz": (gzip.compress(bytes(range(64)))[:-12], "gzip stream"),
    "bomb_4x4x4_uint8.raw.gz": (gzip.compress(bytes(10**7)), "more than 64 bytes"),
    "few_4x4x4_uint8.raw.gz": (gzip.compress(bytes(range(60))), "60 bytes"),
    "nan_2x2x2_float32.raw": (
        np.array([np.nan, *range(7)], "f4").tobytes(),
        "1 of 8 values are NaN or infinite",
    ),
    "inf_2x2x2_float64.raw": (np.array([np.inf, -np.inf, *range(6)]).tobytes(), "2 of 8 values are NaN"),
    "giant_2x2x2_float64.raw": ((1e300 * np.arange(8.0)).tobytes(), "single precision"),
    "empty.npy": (b"", "is empty"),
    "text.npy": (b"hello, I am no array", "not a readable .npy"),
    "text.nrrd": (b"hello, I am no array", "no readable NRRD header"),
    "text.nii": (b"hello, I am no array", "not a readable NIfTI"),
    "picture.jpeg": (b"II*", "unknown volume format '.jpeg'"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files(tmp_path: Path, name: str) -> None:
    check_refused(tmp_path / name, *BAD[name])


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((4, 4)),
        np.zeros((0, 4, 4)),
        np.zeros((2, 2, 2, 3)),
        np.full((3, 3, 3), 1 + 1j),
        np.array(3.0),
    ],
    ids=["2-D", "empty", "4-D", "complex", "scalar"],
)
def test_bad_arrays(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "v.npy", array)
    with pytest.raises(DataError):
        read_volume(tmp_path / "v.npy")


def test_objects_are_not_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "v.npy", np.array([[[object()]]]), allow_pickle=True)
    with pytest.raises(DataError, match=r"not a readable \.npy"):
        read_volume(tmp_path / "v.npy")


def test_missing_and_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_volume(tmp_path / "none_2x2x2_uint8.raw")
    (tmp_path / "d_2x2x2_uint8.raw").mkdir()
    with pytest.raises(DataError, match="is a folder"):
        read_volume(tmp_path / "d_2x2x2_uint8.raw")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable(tmp_path: Path) -> None:
    path = tmp_path / "v_2x2x2_uint8.raw"
    path.write_bytes(bytes(range(8)))
    path.chmod(0)
    with pytest.raises(DataError, match="cannot be read"):
        read_volume(path)


@pytest.mark.parametrize(
    "text",
    [
        "dims = [2, 2]\ndtype = 'uint8'",
        "dims = 'a'\ndtype = 'uint8'",
        "dims = [2, 2, 2]",
        "dims = [2, 2, 2]\ndtype = 'what'",
        "dims = [2, 2, 2]\ndtype = 'uint8'\nspacing = [0, 1, 1]",
        "dims = [2, 2, 2]\ndtype = 'uint8'\nspacing = [1]",
        "dims = [2, 2, 2]\ndtype = 'uint8'\nheader_bytes = -1",
        "dims = [2, 2, 2]\ndtype = 'uint8'\ndim = 3",
        "dims = [-2, -2, 2]\ndtype = 'uint8'",
        "not toml",
    ],
)
def test_bad_sidecars(tmp_path: Path, text: str) -> None:
    path = tmp_path / "v.raw"
    path.write_bytes(bytes(range(8)))
    (tmp_path / "v.raw.toml").write_text(text)
    with pytest.raises(DataError):
        read_volume(path)


NAMES = ["v_5x4x3_int16.raw", "v_5x4x3_int16.raw.gz", "v.npy", "v.nrrd", "v.nii", "v.nii.gz"]


@pytest.mark.parametrize("name", NAMES)
def test_damaged_files(tmp_path: Path, name: str) -> None:
    def check(path: Path) -> None:
        check_volumes(path, lambda: [read_volume(path)])

    check_damage(tmp_path / name, lambda path: _write(path, _array("int16")), check, "cut", "insert", "set")


@PROPERTY
@given(
    shape=st.tuples(*[st.integers(2, 7)] * 3), dtype=st.sampled_from(KINDS), seed=st.integers(0, 99),
    suffix=st.sampled_from([".raw", ".raw.gz"]),
)  # fmt: skip
def test_any_raw_round_trip(tmp_path: Path, shape: tuple, dtype: str, seed: int, suffix: str) -> None:
    array = _array(dtype, shape=shape, seed=seed)
    path = tmp_path / f"v_{shape[2]}x{shape[1]}x{shape[0]}_{dtype}{suffix}"
    _write(path, array)
    volume = read_volume(path)
    np.testing.assert_array_equal(volume.values, array)
