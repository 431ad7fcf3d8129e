"""DICOM: slope x stored + intercept of each frame, in its place; what leaves that open is refused."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import list_variables, read_volume
from econgs_bench.datasets.readers.child import elements
from econgs_bench.datasets.readers.limits import Limits
from tests.datasets import dicom_files as dicom

pytestmark = pytest.mark.usefixtures("forks")

UPRIGHT = dicom.UPRIGHT
TURNED = (UPRIGHT, (0, 1, 0, 0, 0, 1))
V = dicom.values()
SPACING = (0.5, 1.0, 2.0)


def folder(path: Path, each: Any, values: NDArray[Any] = V, **options: Any) -> Path:
    """A series of slices 2 apart; ``each`` gives further elements of slice k."""
    path.mkdir()
    for k, plane in enumerate(values):
        own = {0x00200032: (0, 0, 2 * k), 0x00200037: UPRIGHT} | each(k)
        dicom.write(path / f"{9 - k}.dcm", plane, k, own, **options)
    return path


def check(path: Path, expected: NDArray[Any], kind: Any, spacing: Any = SPACING, **choice: Any) -> None:
    volume = read_volume(path, **choice)
    np.testing.assert_allclose(volume.values, expected, rtol=1e-6)
    assert volume.values.dtype == kind
    assert volume.spacing == pytest.approx(spacing)


def test_a_rescale_of_each_slice(tmp_path: Path) -> None:
    slopes = np.array([1, 0.5, 0.25, 0.1])
    path = folder(tmp_path / "slope", lambda k: {0x00281053: slopes[k], 0x00281052: 0})
    check(path, V * slopes[:, None, None], np.float32)
    starts = np.array([0, -1024, 0, -1024])
    path = folder(tmp_path / "intercept", lambda k: {0x00281053: 1, 0x00281052: starts[k]})
    check(path, V + starts[:, None, None], np.int32)
    path = folder(tmp_path / "digits", lambda k: {0x00281053: 0.5, 0x00281052: 1e8 + k})
    check(path, 0.5 * V + 1e8 + np.arange(4)[:, None, None], np.float64)  # float32 has 8 between two values


@pytest.mark.parametrize(("kind", "stored"), [("u1", 8), ("u2", 12), ("u2", 16), ("i2", 12), ("i2", 16)])
def test_monochrome1_is_not_inverted(tmp_path: Path, kind: str, stored: int) -> None:
    stack = (V % 200 - (100 if kind == "i2" else 0)).astype(kind)
    path = folder(
        tmp_path / "m",
        lambda k: {0x00281053: 2, 0x00281052: -7},
        stack,
        stored=stored,
        photometric="MONOCHROME1",
    )
    np.testing.assert_array_equal(read_volume(path).values, 2 * stack.astype(int) - 7)


def test_files_of_several_frames_are_variables(tmp_path: Path) -> None:
    for n in range(3):
        dicom.write(tmp_path / f"{n}.dcm", V + np.uint16(1000 * n), n, {0x00180088: 2})
    names = {v.name: v.dims for v in list_variables(tmp_path)}
    assert names == dict.fromkeys(("series0", "series1", "series2"), (6, 5, 4))
    first = {int(read_volume(tmp_path, name).values[0, 0, 0]) for name in names}
    assert first == {0, 1000, 2000}
    with pytest.raises(DataError, match="3 variables"):
        read_volume(tmp_path)


@pytest.mark.parametrize("syntax", [dicom.EXPLICIT, dicom.IMPLICIT])
@pytest.mark.parametrize("closed", [True, False])
def test_the_frames_of_an_enhanced_file(tmp_path: Path, syntax: str, closed: bool) -> None:
    path, options = tmp_path / "e.dcm", {"syntax": syntax, "closed": closed}
    slopes = [1, 0.5, 0.25, 3]
    frames = [dicom.frame(z, slope) for z, slope in zip((0, 6, 3, 9), slopes, strict=True)]
    dicom.enhanced(path, V, frames, **options)
    expected = V * np.array(slopes)[:, None, None] + 3
    check(path, expected[[0, 2, 1, 3]], np.float32, (0.5, 1.0, 3.0))
    dicom.enhanced(path, V, frames, photometric="MONOCHROME1", stored=10, **options)
    check(path, expected[[0, 2, 1, 3]], np.float32, (0.5, 1.0, 3.0))
    shared = {0x00289145: [{0x00281052: -5, 0x00281053: 2}]}
    dicom.enhanced(path, V, [dicom.frame(z) for z in (6, 4, 2, 0)], shared, **options)
    check(path, 2.0 * V[::-1] - 5, np.int32)


def test_the_times_of_an_enhanced_file(tmp_path: Path) -> None:
    path = tmp_path / "e.dcm"
    both = np.stack([V, V + np.uint16(7)], 1).reshape(8, 5, 6)
    dicom.enhanced(path, both, [dicom.frame(z, time=t) for z in (0, 2, 4, 6) for t in (1, 2)])
    (variable,) = list_variables(path) or [None]
    assert variable is not None
    assert (variable.dims, variable.steps) == ((6, 5, 4), 2)
    for step in (0, 1):
        check(path, V + 7 * step, np.uint16, step=step)


def test_a_series_of_enhanced_files_of_one_frame(tmp_path: Path) -> None:
    for k in range(4):
        own = {
            0x00280030: None, 0x00280008: 1, 0x52009230: [dicom.frame(2.0 * (3 - k), k + 1)],
            0x52009229: [{0x00209116: [{0x00200037: UPRIGHT}], 0x00289110: [{0x00280030: (1, 0.5)}]}],
        }  # fmt: skip
        dicom.write(tmp_path / f"{k}.dcm", V[k], k, own, model=dicom.ENHANCED)
    check(tmp_path, (V * np.arange(1, 5)[:, None, None] + 3)[::-1], np.int32)


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        ([dicom.frame(z) for z in (0, 2, 4, 10)], "missing slices detected"),
        ([dicom.frame(z) for z in (0, 0, 2, 2)], "several slices at one position"),
        ([dicom.frame(z, segment=z // 4) for z in (0, 2, 4, 6)], "several segments"),
        ([dicom.frame(z, 0.0) for z in (0, 2, 4, 6)], "cannot be"),
        ([dicom.frame(z) for z in (0, 2, 4)], "3 frames where it has 4"),
        ([dicom.frame(z, time=max(1, z // 3)) for z in (0, 2, 4, 6)], "other numbers of frames"),
        ([dicom.frame(z) | {0x00209116: [{0x00200037: TURNED[z // 6]}]} for z in (0, 2, 4, 6)], "orient"),
        ([dicom.frame(z) | {0x00289110: [{0x00280030: (1 + z, 1)}]} for z in (0, 2, 4, 6)], "distances"),
        ([{0x00209113: [{0x00200032: (0, 0, z)}] * 2} for z in (0, 2, 4, 6)], "several items"),
    ],
)  # fmt: skip
def test_frames_that_are_no_volume(tmp_path: Path, frames: list[Any], reason: str) -> None:
    path = tmp_path / "e.dcm"
    dicom.enhanced(path, V, frames)
    with pytest.raises(DataError, match=reason) as error:
        read_volume(path)
    assert "\n" not in str(error.value)
    assert error.value.remedy


@pytest.mark.parametrize("syntax", [dicom.EXPLICIT, dicom.IMPLICIT, dicom.DEFLATED])
def test_the_frames_of_a_film_are_refused(tmp_path: Path, syntax: str) -> None:
    path = tmp_path / "f.dcm"
    for tag, what in ((0x00181063, "time"), (0x00540020, "detector")):
        dicom.write(path, V, elements={0x00280009: tag}, model=dicom.CAPTURE, syntax=syntax)
        with pytest.raises(DataError, match=f"f.dcm are no slices: they differ in {what}"):
            read_volume(path)
    dicom.write(path, V, elements={0x00280009: 0x00540080, 0x00180088: 2}, syntax=syntax)  # slices
    check(path, V, np.uint16)
    frames = [dicom.frame(2.0 * k) for k in range(4)]
    dicom.enhanced(path, V, frames, syntax=syntax, counted=0x00181063)  # each says its place
    check(path, V, np.uint16)


def test_distances_without_positions(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bare = {0x00200032: None, 0x00200037: None}
    for name, own, z in (
        ("between", {0x00180088: 2, 0x00180050: 5}, 2.0),
        ("thickness", {0x00180050: 3}, 3.0),
        ("neither", {}, 0.75),
    ):
        for model in (dicom.CT, dicom.CAPTURE):
            caplog.clear()
            path = folder(tmp_path / f"{name}{model}", lambda k, own=own: bare | own, model=model)
            check(path, V, np.uint16, (0.5, 1.0, z))
            assert "positions" in caplog.text or "along z" in caplog.text


def test_a_gantry_tilt_is_refused(tmp_path: Path) -> None:
    def turned(degrees: float) -> Any:
        angle = math.radians(degrees)
        return {0x00200037: (1, 0, 0, 0, f"{math.cos(angle):.12g}", f"{math.sin(angle):.12g}")}

    path = folder(tmp_path / "tilt", lambda k: turned(20))
    with pytest.raises(DataError, match=r"tilt of 20\.0 degrees"):
        read_volume(path)
    check(
        folder(tmp_path / "rounding", lambda k: turned(0.5)),
        V,
        np.uint16,
        (0.5, 1.0, 2 * math.cos(math.radians(0.5))),
    )


def test_doses(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "d.dcm"
    own = {0x3004000E: 0.5, 0x00280009: 0x3004000C, 0x00200032: (0, 0, 0), 0x00200037: UPRIGHT}
    dicom.write(path, V, 0, own | {0x3004000C: (0, 2, 4, 6)}, model=dicom.DOSE)
    check(path, 0.5 * V, np.float32)
    dicom.write(path, V, 0, own | {0x3004000C: (0, 1, 2, 4)}, model=dicom.DOSE)  # uneven: resampled
    expected = 0.5 * np.stack([V[0], V[1], V[2], (V[2] + V[3]) / 2, V[3]])
    check(path, expected, np.float32, (0.5, 1.0, 1.0))
    assert "unevenly spaced" in caplog.text
    dicom.write(path, V, 0, own | {0x3004000C: (0, 1, 2)}, model=dicom.DOSE)
    with pytest.raises(DataError, match="3 frame offsets for 4 frames"):
        read_volume(path)


@pytest.mark.parametrize("syntax", [dicom.EXPLICIT, dicom.IMPLICIT, dicom.DEFLATED])
def test_indices_into_a_table_are_refused(tmp_path: Path, syntax: str) -> None:
    table = {0x00283000: [{0x00283002: 4, 0x00283006: b"\0\0\1\0\4\0\11\0"}]}
    folder(tmp_path / "s", lambda k: table if k == 2 else {}, syntax=syntax)
    with pytest.raises(DataError, match=r"7\.dcm holds indices into a table .*apply_modality_lut"):
        read_volume(tmp_path / "s")
    tag = np.frombuffer(b"\x28\0\0\x30" * 2, np.uint16)
    stack = np.broadcast_to(tag, (*V.shape[:2], 4)).copy()
    same = folder(tmp_path / "pixels", lambda k: {}, stack, syntax=syntax)  # which is no element there
    np.testing.assert_array_equal(read_volume(same).values, stack)


@pytest.mark.parametrize("kind", ["u2", "i2"])
@pytest.mark.parametrize("slope", [1, 2, 0.1, -1])
@pytest.mark.parametrize("limit", [None, 0xF004])
def test_padding_is_no_value(tmp_path: Path, kind: str, slope: float, limit: int | None) -> None:
    """Stored numbers up to the limit stand for what the scanner did not see."""
    stored = V.astype(kind)
    stored[:, :2] = np.array([[0xF000], [0xF004]], "u2").astype(kind)
    own = {0x00280120: 0xF000, 0x00280121: limit, 0x00281053: slope, 0x00281052: -1000}
    right = np.zeros(V.shape, bool)
    right[:, : 1 if limit is None else 2] = True
    path = folder(tmp_path / "s", lambda k: own, stored)
    frames = [dicom.frame(2.0 * k, slope) for k in range(4)]
    dicom.enhanced(
        tmp_path / "e.dcm", stored, frames, padding={tag: own[tag] for tag in (0x00280120, 0x00280121)}
    )
    for at, intercept in ((path, -1000), (tmp_path / "e.dcm", 3)):
        volume = read_volume(at, limits=Limits("all"))
        assert volume.mask is not None
        np.testing.assert_array_equal(~volume.mask, right)
        expected = slope * stored.astype(float) + intercept
        np.testing.assert_allclose(volume.values[~right], expected[~right], rtol=1e-6)


def test_big_endian_files(tmp_path: Path) -> None:
    path = folder(tmp_path / "s", lambda k: {0x00281053: 2, 0x00281052: -7}, syntax=dicom.BIG)
    files = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(path))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(sitk.ReadImage(files)), 2 * V.astype(int) - 7)
    check(path, 2 * V.astype(int) - 7, np.int32)
    file = path / "9.dcm"
    file.write_bytes(file.read_bytes()[:-2])
    with pytest.raises(DataError, match=r"its file 9\.dcm has no pixels, or is truncated"):
        read_volume(path)


@pytest.mark.parametrize("syntax", [dicom.EXPLICIT, dicom.IMPLICIT])
def test_files_without_a_preamble(tmp_path: Path, syntax: str) -> None:
    folder(tmp_path / "s", lambda k: {}, syntax=syntax)
    for file in (tmp_path / "s").iterdir():
        whole = file.read_bytes()
        file.rename(file.with_suffix("")).write_bytes(whole[whole.index(b"\x08\0\x16\0") :])
    check(tmp_path / "s", V, np.uint16)


def test_deflated_files(tmp_path: Path) -> None:
    path = tmp_path / "d.dcm"
    dicom.write(path, V, 0, {0x00180088: 2}, syntax=dicom.DEFLATED)
    check(path, V, np.uint16)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DataError, match="truncated"):
        read_volume(path)
    dicom.enhanced(path, V, [dicom.frame(z) for z in (0, 2, 6, 4)], syntax=dicom.DEFLATED)
    check(path, V[[0, 1, 3, 2]], np.uint16)
    dicom.enhanced(path, V, [dicom.frame(z, z + 1) for z in (0, 2, 6, 4)], syntax=dicom.DEFLATED)
    with pytest.raises(DataError, match="deflated"):
        read_volume(path)


def test_more_frames_than_bytes(tmp_path: Path) -> None:
    path = tmp_path / "n.dcm"
    dicom.write(path, V, 0, {0x00280008: 2**31 - 1})
    with pytest.raises(DataError, match=r"frames in \d+ bytes|cannot be read"):
        read_volume(path)


def test_hostile_sequences_end() -> None:
    """Every cut of a file, and sequences nested without end: no loop, no recursion, no crash."""
    deep: Any = {0x00180050: 1}
    for _ in range(40):
        deep = {0x00289110: [deep]}
    with pytest.raises(elements.Malformed, match="nested"):
        elements.read(dicom.encoded({0x52009229: [deep]}))
    whole = dicom.encoded({0x00280004: "MONOCHROME1", 0x52009230: [dicom.frame(1, 2)] * 3}, closed=False)
    assert len(elements.read(whole).frames) == 3
    for end in range(1, len(whole)):
        with suppress(elements.Malformed):
            assert not elements.read(whole[:end]).frames  # a cut between two elements: all are lost, or none
