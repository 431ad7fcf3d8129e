"""``bench scenes``: an entry to edit, which round trips, and its contact sheet."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.commands.scenes import account, without_repeats
from econgs_bench.datasets import procedural
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.scene import Dataset

SMALL = ["--views", "1", "--size", "24"]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))
    (tmp_path / "data").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")


def _volume(tmp_path: Path, name: str = "shells one.npy") -> Path:
    path = tmp_path / "data" / name
    np.save(path, 1000.0 * procedural.make_volumes("shells", 32)["shells"].normalised() - 200.0)
    return path


def _same(one: Dataset, other: Dataset) -> None:
    assert one.frame == other.frame
    assert one.compositions == other.compositions
    assert len(one.scenes) == len(other.scenes)
    for a, b in zip(one.scenes, other.scenes, strict=True):
        assert (a.name, a.variable, a.light, a.background) == (b.name, b.variable, b.light, b.background)
        assert a.transfer is not None
        assert b.transfer is not None
        x = np.linspace(0.0, 1.0, 2001)
        np.testing.assert_allclose(a.transfer.table(64), b.transfer.table(64), rtol=0.1, atol=1.0)
        assert ((a.transfer.classify(x)[:, 3] > 0) != (b.transfer.classify(x)[:, 3] > 0)).sum() <= 2
        assert [bump.color for bump in a.transfer.bumps] == [bump.color for bump in b.transfer.bumps]
    for variable in one.volumes:
        np.testing.assert_array_equal(one.volume(variable).values, other.volume(variable).values)


def test_propose_edit_look(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = _volume(tmp_path)
    assert main(["scenes", str(file), *SMALL]) == 0
    printed = capsys.readouterr().out
    entry, sheet = Path("shells_one.toml"), Path("shells_one.png")
    assert printed.startswith("shells_one.toml: 3 scenes proposed\nshells_one.png: the contact sheet\n")
    assert "bench scenes shells_one.toml" in printed
    assert "bench run quick --dataset shells_one.toml" in printed
    _same(open_dataset(str(file)), open_dataset(str(entry)))
    pixels = np.asarray(Image.open(sheet))
    assert 0.02 < (pixels.min(axis=-1) < 250).mean() < 0.9

    text = entry.read_text(encoding="utf-8")
    first = re.search(r"range = \[([0-9.]+).*?ends: (\S+)", text)
    assert first is not None
    low, high = float(np.load(file).min()), float(np.load(file).max())
    value = low + float(first[1]) * (high - low)
    assert float(first[2]) == pytest.approx(value, abs=0.2), "the data's own units"
    keys = {line.split(" = ")[0] for line in text.splitlines() if re.match(r"[a-z]+ = .*\[*#", line)}
    assert keys >= {"title", "path", "variable", "name", "range", "color", "opacity"}, (
        "each key has a comment"
    )

    edited = text.replace("opacity = ", "opacity = 0.0001 #", 1)
    entry.write_text(edited, encoding="utf-8")
    for again in (str(file), str(entry)):  # the volume's name or the entry's
        assert main(["scenes", again, *SMALL]) == 0
        assert entry.read_text(encoding="utf-8") == edited, "never overwritten"
        assert "nearly empty" in capsys.readouterr().out
    assert (np.asarray(Image.open(sheet)) != pixels).any()
    assert not list(Path().glob(".*.toml"))


def test_several_variables_and_choices_round_trip(tmp_path: Path) -> None:
    file = tmp_path / "data" / "two.npz"
    shells = procedural.make_volumes("shells", 24)["shells"].normalised()
    np.savez(file, **{"shell s": shells, "turned": shells[::-1].copy() ** 2})
    assert main(["scenes", str(file), "--out", str(tmp_path / "data" / "mine.toml"), *SMALL]) == 0
    entry = tmp_path / "data" / "mine.toml"
    _same(without_repeats(open_dataset(str(file))), open_dataset(str(entry)))
    assert {one["path"] for one in tomllib.loads(entry.read_text())["files"]} == {"two.npz"}, "beside it"
    assert main(["scenes", f"{file}:variable=turned", *SMALL]) == 0
    (scenes,) = (
        {
            one["variable"]
            for one in tomllib.loads(Path("two-turned.toml").read_text(encoding="utf-8"))["files"]
        },
    )
    assert len(scenes) == 1


def test_the_account_names_what_is_wrong(tmp_path: Path) -> None:
    _volume(tmp_path, "v.npy")
    bump = (
        '[[scenes]]\nname = "{0}"\n[[scenes.bumps]]\nname = "b"\nrange = {1}\n'
        "color = [1.0, 0.0, 0.0]\nopacity = 0.9\n"
    )
    scenes = {
        "one": [0.4, 0.45, 0.5, 0.55], "two": [0.42, 0.47, 0.52, 0.57], "box": [0.0, 0.0, 1.0, 1.0],
        "none": [0.99999, 0.99999, 1.0, 1.0],
    }  # fmt: skip
    entry = tmp_path / "data" / "e.toml"
    text = '[[files]]\npath = "v.npy"\n' + "".join(bump.format(*one) for one in scenes.items())
    entry.write_text(text)
    words = {one.scene: one.words for one in account(open_dataset(str(entry)))}
    assert "much the same as two" in words["one"]
    assert words["box"].startswith("a solid box")
    assert words["none"].startswith("nearly empty")


def test_scenes_that_repeat_another_are_left_out(tmp_path: Path, monkeypatch, capsys) -> None:
    """Variables of which one follows from another, as many of a simulation do."""
    z, y, x = np.mgrid[-1:1:24j, -1:1:24j, -1:1:24j]
    ball, side = np.exp(-4 * (x * x + y * y + z * z)), np.exp(-8 * ((x - 0.6) ** 2 + (y - 0.6) ** 2 + z * z))
    np.savez(tmp_path / "v.npz", density=ball, energy=3.0 * ball + 1.0, other=side)
    monkeypatch.chdir(tmp_path)
    assert any("much the same" in one.words for one in account(open_dataset("v.npz")))
    assert main(["scenes", "v.npz", "--views", "1", "--size", "16"]) == 0
    assert re.search(r"proposed; left out \d that show much the same\n", capsys.readouterr().out)
    kept = open_dataset("v.toml")
    assert {scene.variable for scene in kept.scenes} == {"density", "other"}
    assert all("much the same" not in one.words for one in account(kept))
    assert set(kept.compositions["all"]) == {scene.name for scene in kept.scenes}


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["vortices"], "is a dataset of the catalogue"),
        (["nothing.npy"], "nothing.npy"),
        (["x.toml"], "cannot be read"),
        (["FILE", "--out", "x.txt"], "is no name of an entry"),
        (["FILE", "--out", "x/../../data/shells one.npy/x.toml"], "shells one.npy"),
    ],
)
def test_unusable_requests(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments, reason) -> None:
    file = _volume(tmp_path)
    assert main(["scenes", *(str(file) if one == "FILE" else one for one in arguments)]) == 2
    assert reason in capsys.readouterr().err
    assert not [path for path in Path().rglob("*") if path.is_file()]
