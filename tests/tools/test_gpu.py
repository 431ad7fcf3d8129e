"""The GPU script in its CPU form: what does not need the device runs here as it will there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SUITE = """title = "t"
methods = ["3dgs"]
preset = "tiny"
[datasets]
"vortices@16" = ["cores"]
[presets.tiny]
like = "quick"
budget = 0.1
train_views = 6
test_views = 2
width = 24
height = 24
prerendered_limit = 24
"""


def test_figures_and_records_come_back(tmp_path: Path) -> None:
    (tmp_path / "suite.toml").write_text(SUITE, encoding="utf-8")
    command = [sys.executable, "-P", "-m", "tools.gpu", "--device", "cpu", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [*command, "--suite", str(tmp_path / "suite.toml"), "--anchors", "40"],
        env=os.environ | {"PYTHONPATH": str(ROOT), "BENCH_CACHE": str(tmp_path / "cache")},
        capture_output=True, encoding="utf-8", timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads((tmp_path / "out" / "gpu.json").read_text(encoding="utf-8"))
    assert figures["machine"]["gpu"] is None
    assert set(figures["launches"]) == {"plain", "compiled"}
    assert min(figures["launches"].values()) > 0
    with zipfile.ZipFile(tmp_path / "out" / "runs.zip") as bundle:
        kinds = {
            name.split("/")[1].partition("-")[0] for name in bundle.namelist() if name.startswith("jobs/")
        }
    assert {"views", "fit", "encode", "measure"} <= kinds


def test_without_a_device_the_reason_is_named(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-P", "-m", "tools.gpu", "--out", str(tmp_path / "out")],
        env=os.environ | {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True, encoding="utf-8", timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "finds no CUDA device" in done.stderr
    assert not (tmp_path / "out").exists()
