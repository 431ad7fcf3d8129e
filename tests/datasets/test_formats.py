"""Every format: the right values in the right places, and what is damaged is refused."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageSequence

from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import list_variables, read_volume, sandbox
from tests.datasets import samples
from tests.datasets.forked import use_forks
from tests.datasets.fuzz import fuzz

REAL = ("v.h5", "v3.zarr", "v.vti", "v.mha", "v.tif")
"""A format of each library, read by a process of its own as users read it; forks read the others."""
PARSED = ("v3.nc", "v.vtk", "v.ex2", "v.nii", "v.nii.gz", "raw.nrrd", "v.nrrd")
"""Formats without a child: their damage is tested with their readers."""


@pytest.mark.parametrize("name", samples.FORMATS)
def test_values_and_axes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    if name not in REAL:
        use_forks(monkeypatch)
    path = samples.write(tmp_path, name)
    variables = {v.name: v for v in list_variables(path)}
    field = {"v.xyz": "Density", "v.q": "Density", "v.case": "f_n"}.get(
        name, "f" if "f" in variables else None
    )
    if field is not None and variables[field].dims is None:
        volume = read_volume(path, field, resolution=17)
        axes = [np.linspace(0, a[-1], n) for a, n in zip(samples.AXES, volume.dims, strict=True)]
        assert volume.dims == (11, 17, 4)
        assert volume.mask is None
        inside = slice(None)
        if name in samples.CELLS:
            inner = [(a > 0.999 * b[1]) & (a < b[-2] + 1e-3) for a, b in zip(axes, samples.AXES, strict=True)]
            inside = np.ix_(*inner[::-1])
        np.testing.assert_allclose(volume.values[inside], samples.linear(*axes)[inside], atol=1e-3)
        return
    volume = read_volume(path, field)
    expected = samples.FIELD.astype(np.uint8) if name in samples.BYTES else samples.FIELD
    np.testing.assert_allclose(volume.values, expected)
    assert volume.spacing == pytest.approx((1.0, 1.0, 1.0) if name in samples.UNIT else samples.SPACING)


@pytest.mark.parametrize("name", [n for n in samples.FORMATS if n not in PARSED])
def test_damage_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    outcome = fuzz(samples.write(tmp_path, name), 15, tmp_path, monkeypatch, seed=1)
    assert not outcome.faults
    assert outcome.counts["refused"] > 3


@pytest.mark.slow
@pytest.mark.parametrize("name", samples.FORMATS)
def test_much_damage_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    assert not fuzz(samples.write(tmp_path, name), 300, tmp_path, monkeypatch).faults


def test_slices_that_are_missing(forks: None, tmp_path: Path) -> None:
    """A folder of slices says so when one is not there, whatever its format."""
    for name, slice_name, reason in (
        ("dicom", "image8.dcm", "missing slices detected"),
        ("tiff", "slice9.tif", "a slice is missing after number 8"),
        ("png", "slice10.png", "a slice is missing after number 9"),
    ):
        path = samples.write(tmp_path, name)
        (path / slice_name).unlink()
        with pytest.raises(DataError, match=reason):
            read_volume(path)


@pytest.mark.parametrize("name", ["png", "tiff", "dicom"])
def test_files_that_systems_add_to_a_folder(forks: None, tmp_path: Path, name: str) -> None:
    path = samples.write(tmp_path, name)
    for file in sorted(path.iterdir()):
        (path / f"._{file.name}").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X")
    for file in (".DS_Store", "Thumbs.db", "desktop.ini"):
        (path / file).write_bytes(b"x")
    expected = samples.FIELD.astype(np.uint8) if name in samples.BYTES else samples.FIELD
    np.testing.assert_array_equal(read_volume(path).values, expected)


def test_a_slice_that_differs_is_named(forks: None, tmp_path: Path) -> None:
    for name, found, other in (("a", np.uint8, (5, 5)), ("b", np.uint16, (5, 6))):
        (tmp_path / name).mkdir()
        for k in range(4):
            shape, kind = (other, found) if k == 2 else ((5, 6), np.uint8)
            tifffile.imwrite(tmp_path / name / f"s{k}.tif", np.zeros(shape, kind))
        with pytest.raises(DataError, match=r"its file s2.tif differs in size or type") as error:
            read_volume(tmp_path / name)
        assert error.value.remedy == "Copy it again"


PAGES: dict[str, Callable[[int], dict[str, Any]]] = {
    "alike": lambda k: {},
    "compression": lambda k: {"compression": "zlib" if k > 1 else None},
    "strips": lambda k: {"rowsperstrip": 2 if k > 1 else 5},
}


@pytest.mark.parametrize("preview", [True, False])
@pytest.mark.parametrize("kind", PAGES)
def test_pages_that_were_written_one_by_one(forks: None, tmp_path: Path, kind: str, preview: bool) -> None:
    """tifffile may begin a series with each; a page of reduced resolution is a preview."""
    path = tmp_path / "v.tif"
    with tifffile.TiffWriter(path) as file:
        for k, page in enumerate(samples.FIELD.astype("f4")):
            file.write(page, contiguous=False, metadata=None, **PAGES[kind](k))
        if preview:
            file.write(np.zeros((2, 3), "f4"), contiguous=False, metadata=None, subfiletype=1)
    with Image.open(path) as image:
        right = [np.asarray(page) for page in ImageSequence.Iterator(image)]
    np.testing.assert_array_equal(read_volume(path).values, right[: len(samples.FIELD)])
    (tmp_path / "slices").mkdir()
    for k in range(2):
        shutil.copy(path, tmp_path / "slices" / f"{k}.tif")
    with pytest.raises(DataError, match=r"0\.tif is no slice"):
        read_volume(tmp_path / "slices")


@pytest.mark.parametrize(
    "last",
    [np.zeros((2, 3), "f4"), np.zeros((5, 6), "u1"), np.zeros((5, 6, 3), "f4")],
    ids=["size", "type", "colors"],
)
def test_pages_of_other_kinds_are_refused(forks: None, tmp_path: Path, last: np.ndarray) -> None:
    path = tmp_path / "v.tif"
    with tifffile.TiffWriter(path) as file:
        for page in [*samples.FIELD.astype("f4"), last]:
            file.write(page, photometric="minisblack" if page.ndim == 2 else "rgb", metadata=None)
    with pytest.raises(DataError, match="page 5 differs in size, type or colors from the first"):
        read_volume(path)


def test_further_images_of_ome_are_told(
    forks: None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "v.ome.tif"
    with tifffile.TiffWriter(path) as file:
        for factor in (1, 2):
            file.write(factor * samples.FIELD, photometric="minisblack", metadata={"axes": "ZYX"})
    np.testing.assert_array_equal(read_volume(path).values, samples.FIELD)
    assert "images after the first are left out: 1" in caplog.text


@pytest.mark.parametrize("text", [b"", b"no JSON", b"[1]", b'{"error": "x"}'])
def test_a_library_that_ends_with_the_code_of_an_error(tmp_path: Path, monkeypatch, text: bytes) -> None:
    """It is a crash like any other, whatever it wrote."""

    def start(options: list[str], stderr: object) -> subprocess.Popen[bytes]:
        code = f"import os; os.write(2, {text!r}); os._exit(4)"
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": stderr}
        return subprocess.Popen([sys.executable, "-c", code], bufsize=0, **pipes)

    monkeypatch.setattr(sandbox, "_start", start)
    with pytest.raises(DataError, match="is damaged: the library that reads it ended with code 4"):
        read_volume(samples.write(tmp_path, "v.tif"))


def test_a_chunk_that_is_absent_has_the_fill_value(
    forks: None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = samples.write(tmp_path, "v3.zarr")
    (path / "f" / "c" / "1" / "0" / "1").unlink()
    volume = read_volume(path)
    assert volume.mask is not None  # xarray's fill value is NaN
    np.testing.assert_array_equal(volume.mask[2:, :3, 3:], False)
    np.testing.assert_array_equal(volume.values[volume.mask], samples.FIELD[volume.mask])
    assert "1 of 8 chunks of 'f' are absent" in caplog.text


def test_time_steps_and_channels_of_a_stack(forks: None, tmp_path: Path) -> None:
    stack = np.stack([samples.FIELD, samples.FIELD[::-1]]).astype(np.uint16)
    tifffile.imwrite(tmp_path / "t.tif", stack, imagej=True, metadata={"axes": "TZYX"})
    assert list_variables(tmp_path / "t.tif")[0].steps == 2
    np.testing.assert_array_equal(read_volume(tmp_path / "t.tif", step=1).values, samples.FIELD[::-1])
    colors = np.stack([samples.FIELD, 2 * samples.FIELD, 0 * samples.FIELD], axis=-1).astype(np.float32)
    tifffile.imwrite(tmp_path / "c.tif", colors, photometric="rgb")
    np.testing.assert_array_equal(read_volume(tmp_path / "c.tif", array="value.y").values, 2 * samples.FIELD)


def test_metaimage_shorter_than_its_header_says(forks: None, tmp_path: Path) -> None:
    path = samples.write(tmp_path, "v.mha")
    path.write_bytes(path.read_bytes().replace(b"DimSize = 6 5 4", b"DimSize = 60000 50000 40000"))
    with pytest.raises(DataError, match="is truncated"):
        read_volume(path)


def test_a_scale_that_itk_does_not_apply_is_told(
    forks: None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = samples.write(tmp_path, "v.mha")
    whole = path.read_bytes()
    for slope, told in ((b"1", False), (b"2", True)):
        line = b"ElementToIntensityFunctionSlope = " + slope + b"\nElementDataFile"
        path.write_bytes(whole.replace(b"ElementDataFile", line))
        np.testing.assert_array_equal(read_volume(path).values, samples.FIELD)
        assert ("ElementToIntensityFunction (Slope 2) is not applied" in caplog.text) == told


def test_dataset_of_a_folder(forks: None, tmp_path: Path) -> None:
    path = samples.write(tmp_path, "dicom")
    dataset = open_dataset(path)
    assert (dataset.name, dataset.kind) == ("dicom", "volume")
    volume = dataset.volume("value")
    np.testing.assert_array_equal(volume.values, samples.FIELD)
    (path / "transforms_train.json").write_text("{}")  # pre-rendered views
    assert open_dataset(path).kind == "views"
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="without pre-rendered views or a volume"):
        open_dataset(tmp_path / "empty")


def test_the_limits_of_a_child(tmp_path: Path) -> None:
    """A process of its own, with limits of memory and time."""
    source = sandbox.Stored(samples.write(tmp_path, "v.h5"), "hdf5")
    limits = Path(f"/proc/{source._child._child.pid}/limits").read_text(encoding="utf-8")
    memory = int(re.search(r"Max address space +(\d+)", limits)[1])
    assert 4 << 30 <= memory < (4 << 30) + (2 << 30)
    assert re.search(r"Max cpu time +3600", limits)
