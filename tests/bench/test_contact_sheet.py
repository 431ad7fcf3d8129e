"""``bench render --contact-sheet``: one picture per dataset, of scenes, compositions and automatic scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from econgs_bench.bench.__main__ import main

SMALL = ["--views", "2", "--size", "24"]


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BENCH_CACHE", str(tmp_path / "cache"))


def _height(path: Path) -> int:
    return Image.open(path).height


def test_one_sheet_per_dataset(tmp_path, capsys) -> None:
    np.save(tmp_path / "mine.npy", np.random.default_rng(0).random((8, 9, 10)).astype(np.float32))
    sheets = ["shells@16", str(tmp_path / "mine.npy")]
    assert main(["render", "--contact-sheet", *sheets, *SMALL, "--out", str(tmp_path / "out")]) == 0
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [path.name for path in paths] == ["shells@16.png", "mine.png"]
    for path in paths:
        pixels = np.asarray(Image.open(path))
        assert 0.02 < (pixels.min(axis=-1) < 250).mean() < 0.9


def test_scenes_compositions_and_automatic_scenes_have_tiles(tmp_path, capsys) -> None:
    command = ["render", "--contact-sheet", "shells@16", *SMALL, "--out", str(tmp_path)]
    assert main([*command, "--scene", "core"]) == 0
    one = _height(tmp_path / "shells@16.png")
    assert main([*command, "--scene", "core", "--scene", "all"]) == 0
    assert _height(tmp_path / "shells@16.png") == one  # beside each other
    assert main(command) == 0  # three scenes and "all"
    every = _height(tmp_path / "shells@16.png")
    assert every > one
    assert main([*command, "--automatic"]) == 0
    assert _height(tmp_path / "shells@16.png") > every
