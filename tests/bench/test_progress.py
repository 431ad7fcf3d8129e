"""Commands name the steps that may take long, before each begins."""

from pathlib import Path

import numpy as np
import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.reports.progress import Watch


@pytest.fixture
def steps(monkeypatch) -> list[str]:
    named: list[str] = []
    monkeypatch.setattr(Watch, "step", lambda watch, text, done=0, total=0: named.append(text), raising=True)
    monkeypatch.setattr(Watch, "beat", lambda watch, now: None)
    return named


@pytest.fixture
def volume(tmp_path: Path) -> Path:
    z, y, x = np.mgrid[-1:1:16j, -1:1:16j, -1:1:16j]
    path = tmp_path / "ball_16x16x16_float32.raw"
    noise = np.random.default_rng().normal(0.0, 0.01, x.shape)  # its views are in no cache
    (x * x + y * y + z * z + noise).astype(np.float32).tofile(path)
    return path


def test_proposals_and_sheets(steps, volume, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["scenes", str(volume), "--views", "1", "--size", "16"]) == 0
    doing = "drawing the sheet of ball_16x16x16_float32"
    expected = [f"reading {volume}", "proposing scenes", "looking at what the scenes show", doing]
    assert [one for one in dict.fromkeys(steps) if one in expected] == expected
    assert doing in steps


def test_pictures_and_samples(steps, volume, tmp_path) -> None:
    assert main(["render", str(volume), "--views", "2", "--size", "16", "--out", str(tmp_path / "p")]) == 0
    assert steps[:2] == ["render", f"reading {volume}"]
    assert sum(one.startswith("drawing ") for one in steps) >= 2
    steps.clear()
    assert main(["samples", "shells@16", "--scene", "core", "--views", "2", "--size", "16"]) == 0
    assert "drawing the finer views of core" in steps
    assert sum(one == "drawing core with 4 rays a pixel" for one in steps) == 2


def test_stores_and_bundles(steps, finished, tmp_path) -> None:
    store, file = str(finished.store), str(tmp_path / "b.zip")
    plugins = ["--plugins", str(finished.plugins)]
    assert main(["bundle", "--runs", store, "--out", file]) == 0
    assert main(["verify", file, *plugins]) == 0
    assert main(["merge", store, file, "--out", str(tmp_path / "all"), *plugins]) == 0
    assert main(["compare", store, str(tmp_path / "all")]) == 0
    assert main(["report", "--runs", store, *plugins]) == 0
    assert steps == [
        "bundle", f"packing {store}",
        "verify", f"checking {file}",
        "merge", "checking what is to be joined", *[one for one in steps if one.startswith("joining")],
        "making tables",
        "compare", "making tables of both",
        "report", "making tables", f"writing {finished.store / 'report.html'}",
    ]  # fmt: skip
    assert sum(one.startswith("joining the jobs of") for one in steps) == 2


def test_plans(steps) -> None:
    assert main(["plan", "quick", "--dataset", "shells@16", "--scene", "core"]) == 0
    assert "reading and hashing the data of the plan" in steps
