"""A range is not its outlier: the same data with and without it are the same picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from econgs_bench.datasets.camera_paths import test_cameras as orbit
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.catalogue.proposal import write_entry
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth import probe
from econgs_bench.datasets.ground_truth.model import Layer
from econgs_bench.datasets.readers import read_volume
from econgs_bench.datasets.readers.limits import Limits
from econgs_bench.datasets.readers.naming import FileName
from econgs_bench.datasets.render_views import marcher_of
from econgs_bench.datasets.scene import BasicScene
from econgs_bench.datasets.transfer import MOST_ENTRIES, Bump, TransferFunction
from econgs_bench.datasets.volume import Volume

N = 24
_Z, _Y, _X = np.mgrid[:N, :N, :N] / (N - 1) - 0.5
BALL = np.exp(-(_X**2 + 1.5 * _Y**2 + _Z**2) / 0.03).astype("f4")
ENTRY = """[[files]]
path = "{name}.npy"
{keys}
[[scenes]]
name = "shell"
[[scenes.bumps]]
name = "shell"
range = {ends}
color = [0.9, 0.6, 0.2]
opacity = 0.4

[frame]
centre = [0.0, 0.0, 0.0]
radius = 0.5
"""


def _picture(scene: BasicScene, volume: Volume) -> np.ndarray:
    draw = marcher_of((volume,), probe.Backend("none")).prepare((Layer.of(scene, volume),), 1)
    return draw(orbit(1, 1.6, 32, 32))


def _decibels(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10.0 * np.log10(max(np.mean((a - b) ** 2), 1e-14)))


def _entry(folder: Path, name: str, values: np.ndarray, whole: float, keys: str = "") -> np.ndarray:
    """The picture of an entry whose bump lies from 0.3 to 0.5 of the data, in shares of a range from 0."""
    np.save(folder / f"{name}.npy", values)
    ends = [end / whole for end in (0.3, 0.35, 0.45, 0.5)]
    (folder / f"{name}.toml").write_text(ENTRY.format(name=name, ends=ends, keys=keys), encoding="utf-8")
    dataset = open_dataset(folder / f"{name}.toml")
    return _picture(dataset.scenes[0], dataset.volume("value"))


@pytest.mark.parametrize("place", [(0, 0, 0), (12, 12, 3), (10, 14, 12)])
@pytest.mark.parametrize("hot", [1e3, 1e6, 1e30])
def test_entry_with_a_hot_voxel(tmp_path: Path, place: tuple[int, int, int], hot: float) -> None:
    clean = _entry(tmp_path, "clean", BALL, float(BALL.max()))
    values = BALL.copy()
    values[place] = hot
    assert _decibels(clean, _entry(tmp_path, "hot", values, hot)) > 40.0
    given = f"range = [0.0, {float(BALL.max())}]"
    assert _decibels(clean, _entry(tmp_path, "given", values, float(BALL.max()), given)) > 40.0


@pytest.mark.parametrize("fill", [1e35, -9999.0, 9.96921e36])
def test_fill_values(tmp_path: Path, caplog: pytest.LogCaptureFixture, fill: float) -> None:
    values = BALL.copy()
    values[:5] = fill
    np.save(tmp_path / "v.npy", values)
    volume = read_volume(tmp_path / "v.npy")
    assert volume.mask is not None
    np.testing.assert_array_equal(volume.mask, values != fill)
    assert volume.value_range == (float(BALL[5:].min()), float(BALL[5:].max()))
    assert "far beyond the others" in caplog.text
    named = read_volume(tmp_path / "v.npy", limits=Limits(missing=(fill,)))
    np.testing.assert_array_equal(named.mask, volume.mask)


def test_what_is_no_outlier(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    tail = rng.lognormal(0.0, 3.0, BALL.shape).astype("f4")  # spans decades without a gap
    levels = np.where(BALL > 0.5, 1000, 0).astype("i2")
    for name, values in {"tail": tail, "levels": levels, "bytes": (BALL * 255).astype("u1")}.items():
        np.save(tmp_path / f"{name}.npy", values)
        volume = read_volume(tmp_path / f"{name}.npy")
        assert volume.mask is None
        assert volume.whole is None
        assert volume.value_range == (float(values.min()), float(values.max()))


def test_missing_values_are_named(tmp_path: Path) -> None:
    values = BALL.copy()
    values[0] = np.nan
    np.save(tmp_path / "v.npy", values)
    with pytest.raises(DataError, match="NaN or infinite"):
        read_volume(tmp_path / "v.npy")
    text = f"{tmp_path / 'v.npy'}:range=0,0.5,missing=nan"
    assert FileName.parse(text).value_range == (0.0, 0.5)
    dataset = open_dataset(text)
    volume = dataset.volume("value")
    assert volume.value_range == (0.0, 0.5)
    np.testing.assert_array_equal(volume.mask, ~np.isnan(values))
    write_entry(dataset, tmp_path / "v.toml")
    again = open_dataset(tmp_path / "v.toml")
    assert again.volume("value").value_range == (0.0, 0.5)
    np.testing.assert_array_equal(again.volume("value").mask, volume.mask)


def test_a_proposal_without_outliers_is_what_the_entry_shows(tmp_path: Path) -> None:
    values = BALL.copy()
    values[3, 4, 5] = 1e20
    np.save(tmp_path / "v.npy", values)
    proposed = open_dataset(tmp_path / "v.npy")
    write_entry(proposed, tmp_path / "v.toml")
    again = open_dataset(tmp_path / "v.toml")
    assert again.volume("value").value_range == pytest.approx(proposed.volume("value").value_range)
    a, b = (_picture(d.scenes[0], d.volume("value")) for d in (proposed, again))
    assert _decibels(a, b) > 40.0


def test_sidecar_of_a_raw_file(tmp_path: Path) -> None:
    path = tmp_path / "v_24x24x24_float32.raw"
    values = BALL.copy()
    values[:, 0] = -5.0
    path.write_bytes(values.tobytes())
    text = 'dims = [24, 24, 24]\ndtype = "float32"\nrange = [0.0, 2.0]\nmissing = -5.0\n'
    path.with_name(path.name + ".toml").write_text(text, encoding="utf-8")
    volume = read_volume(path)
    assert volume.value_range == (0.0, 2.0)
    np.testing.assert_array_equal(volume.mask, values != -5.0)
    assert read_volume(path, limits=Limits(value_range=(0.0, 1.0))).value_range == (0.0, 1.0)
    for ends in ([0.15, 0.2, 0.25, 0.3], [0.1, 0.2, 0.8, 0.9]):  # shares of the range of the sidecar
        text = ENTRY.format(name="v", ends=ends, keys="").replace("v.npy", path.name)
        (tmp_path / "v.toml").write_text(text, encoding="utf-8")
        dataset = open_dataset(tmp_path / "v.toml")
        assert dataset.volume("value").value_range == (0.0, 2.0)
        assert dataset.scenes[0].transfer.bumps[0].start == ends[0]


@pytest.mark.parametrize(
    "keys", ["range = [1.0, 0.0]", "range = [0.0, inf]", 'range = "some"', 'missing = "x"']
)
def test_malformed_keys(tmp_path: Path, keys: str) -> None:
    with pytest.raises(DataError, match=r"range|missing"):
        _entry(tmp_path, "v", BALL, 1.0, keys)


@pytest.mark.parametrize("text", ["range=1", "range=2,1", "range=a,b", "missing=x"])
def test_malformed_choices(tmp_path: Path, text: str) -> None:
    np.save(tmp_path / "v.npy", BALL)
    with pytest.raises(DataError, match=r"range|missing"):
        FileName.parse(f"{tmp_path / 'v.npy'}:{text}")


def test_a_table_resolves_what_is_visible() -> None:
    """A bump in a small part of a wide range is the picture of the same bump in a narrow one."""
    bump = Bump("b", 0.3, 0.35, 0.45, 0.5, (0.9, 0.6, 0.2), 0.4)
    volume = Volume("v", BALL, (1.0, 1.0, 1.0), (0.0, 1.0), "test")
    right = _picture(BasicScene("s", "v", TransferFunction("s", (bump,))), volume)
    share = 1e-3
    ends = [share * end for end in (bump.start, bump.rise, bump.fall, bump.end)]
    narrow = TransferFunction("s", (replace(bump, start=ends[0], rise=ends[1], fall=ends[2], end=ends[3]),))
    wide = replace(volume, value_range=(0.0, 1.0 / share))
    assert narrow.entries(16384) > 16384
    assert _decibels(right, _picture(BasicScene("s", "v", narrow), wide)) > 40.0
    thin = replace(narrow, bumps=(replace(bump, start=0.1, rise=0.1, fall=0.1 + 1e-9, end=0.1 + 1e-9),))
    assert thin.entries(16384) == MOST_ENTRIES
