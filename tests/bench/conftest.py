"""A tiny pre-rendered dataset, a method without torch, and `bench` as a user starts it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.jobs.measure import MeasureResult
from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.plan.selection import Selection
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.store.records import Job, ViewResult
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.datasets.camera import Camera
from econgs_bench.reports.schema import COLUMNS

PLUGINS = Path(__file__).parent / "plugins"
SIZE = 8
PATIENCE = 300.0
"""Seconds that nothing on a busy machine takes; only a hang does."""


PRESET = """
[presets.quick]
train_views = 12
test_views = 4
width = 16
height = 16
prerendered_limit = 16
"""
SMALL = f'"argon_bubble_like@32" = []{PRESET}'


def suite_file(folder: Path, datasets: str, more: str = "") -> str:
    """Path of a suite of the method fake."""
    path = folder / "suite.toml"
    path.write_text(f'title = "t"\nmethods = ["fake"]\npreset = "quick"\n{more}\n[datasets]\n{datasets}\n')
    return str(path)


@pytest.fixture
def suite(tmp_path):
    """Writes a suite of two small scenes and the composition of both."""
    return lambda more="": suite_file(tmp_path, SMALL, more)


def plan(suite: str, store: Store | None = None, **changes) -> list[Job]:
    """Jobs of a suite with options of the command line."""
    selection = Selection(load_suite(suite), plugins=(str(PLUGINS),))
    return Planner(replace(selection, **changes), {"psnr": "1"}).jobs(store)


def measured(psnr: float, primitives: int, views: tuple[ViewResult, ...] = ()) -> MeasureResult:
    return MeasureResult(
        load_seconds=1.0, frame_seconds=0.1, frame_seconds_p05=0.1, frame_seconds_p95=0.1, frames=1,
        warmup_frames=1, warmup_stable=True, timing={"frame": 0.1}, primitives=primitives,
        metrics={"psnr": psnr}, missing={}, views=list(views), reference_seconds=None,
    )  # fmt: skip


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data") / "tiny")


def write_dataset(root: Path) -> Path:
    """Three scenes of 12 training and 4 test views, 8 x 8 pixels."""
    from econgs_bench.datasets.cloud import random_cloud
    from econgs_bench.datasets.png import write_png
    from tests.datasets.views_folder import write_ply, write_transforms

    rng = np.random.default_rng(1)
    for scene in ("a", "b", "c"):
        color = rng.random(3).astype(np.float32)
        for split, count in (("train", 12), ("test", 4)):
            folder = root / scene / split
            folder.mkdir(parents=True)
            cameras = [_camera(i, count, f"r_{i:04d}") for i in range(count)]
            for index, camera in enumerate(cameras):
                image = np.ones((SIZE, SIZE, 4), dtype=np.float32)
                image[..., :3] = color
                image[0, : index % 4 + 1] = 0.0  # transparent pixels: no two neighbours have equal errors
                write_png(folder / f"{camera.name}.png", image)
            write_transforms(root / scene / f"transforms_{split}.json", cameras)
        write_ply(root / scene / "points3d.ply", random_cloud(20, 0.5))
    return root


def _camera(index: int, count: int, name: str) -> Camera:
    angle = 2 * np.pi * index / count
    forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
    right = np.array([-np.sin(angle), np.cos(angle), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = -2.0 * forward
    return Camera.with_fov(matrix, 0.6, SIZE, SIZE, name)


def workers(process: subprocess.Popen) -> list[psutil.Process]:
    """Those of a run: interpreters of their own, and forks of the server."""
    try:
        children = psutil.Process(process.pid).children()
        forks = [
            fork
            for child in children
            if "econgs_bench.bench.run.processes" in child.cmdline()
            for fork in child.children()
        ]
        return [child for child in children if "econgs_bench.bench.run.worker" in child.cmdline()] + forks
    except psutil.Error:
        return []


def runs(process: psutil.Process) -> bool:
    """Whether a process is alive; a zombie only waits for whoever adopted it."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_for(condition: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.02)


def plain_tables(store: Path) -> dict[str, str]:
    """The tables without what depends on the machine, its speed and the program's commit."""
    apart = {"processor", "fit_processor", "threads", "timing", "commit", "finished", "differences"}
    apart |= {
        name
        for name, one in COLUMNS.items()
        if one.unit in ("s", "ms", "FPS")
        or name.endswith(("host_bytes", "device_bytes"))
        or name.startswith("ms_")
    }
    return {
        name: table.drop(columns=[column for column in table if column in apart]).to_csv()
        for name, table in build_tables(Store(store), write=False).items()
        if name != "differences"  # of times on this machine
    }


def attempts(store: Path) -> int:
    """How often any job of a store began."""
    files = store.glob("jobs/*/progress.jsonl")
    return sum(file.read_text().count('"waiting": false') for file in files)


class Bench:
    """Runs ``bench`` in processes of their own, against one store."""

    def __init__(self, folder: Path, dataset: Path) -> None:
        self.store = folder / "runs"
        self.dataset = dataset
        self.plugins = PLUGINS
        self.patience = PATIENCE
        self.environment = {
            **os.environ,
            "PYTHONSAFEPATH": "1",
            "BENCH_LOCKS": str(folder / "locks"),
            "BENCH_CACHE": str(folder / "cache"),
            "TORCH_HOME": str(folder / "torch"),
            "XDG_STATE_HOME": str(folder / "state"),
        }
        self.environment.pop("BENCH_DATA", None)

    def command(self, *arguments: object) -> list[str]:
        return [sys.executable, "-m", "econgs_bench.bench", *map(str, arguments)]

    def run_arguments(
        self, *more: object, scenes: tuple[str, ...] = ("a",), method: str = "fake"
    ) -> list[str]:
        arguments: list[object] = ["run", "quick", "--dataset", self.dataset, "--method", method]
        for scene in scenes:
            arguments += ["--scene", scene]
        return self.command(*arguments, "--plugins", self.plugins, "--out", self.store, *more)

    def __call__(self, *arguments: object, code: int | None = 0) -> subprocess.CompletedProcess[str]:
        """A command, which must end with an exit code; None: with any."""
        return self._finish(self.command(*arguments), code)

    def run(
        self, *more: object, scenes: tuple[str, ...] = ("a",), method: str = "fake", report: bool = False,
        code: int = 0,
    ) -> subprocess.CompletedProcess[str]:  # fmt: skip
        """A whole run; without the report, which takes longer than all jobs together."""
        quick = () if report else ("--no-report",)
        return self._finish(self.run_arguments(*quick, *more, scenes=scenes, method=method), code)

    def run_suite(
        self, suite: str, *more: object, report: bool = False, code: int = 0
    ) -> subprocess.CompletedProcess[str]:
        quick = () if report else ("--no-report",)
        command = self.command("run", suite, "--plugins", self.plugins, "--out", self.store, *quick, *more)
        return self._finish(command, code)

    def plan(self, scene: str, out: Path, *more: object) -> str:
        """What ``bench plan`` prints of the method fake."""
        return self("plan", "quick", "--dataset", self.dataset, "--method", "fake", "--scene", scene,
                    "--plugins", self.plugins, "--out", out, *more).stdout  # fmt: skip

    def start(self, *more: object, method: str = "fake") -> subprocess.Popen[str]:
        return self._start(self.run_arguments("--no-report", *more, method=method))

    def start_suite(self, suite: str, *more: object) -> subprocess.Popen[str]:
        arguments = ("run", suite, "--plugins", self.plugins, "--out", self.store, "--no-report", *more)
        return self._start(self.command(*arguments))

    def _start(self, command: list[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            command, env=self.environment, cwd=self.store.parent, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8",
        )  # fmt: skip

    def _finish(self, command: list[str], code: int | None) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            command, env=self.environment, cwd=self.store.parent, capture_output=True, encoding="utf-8",
            timeout=self.patience, check=False,
        )  # fmt: skip
        assert code in (done.returncode, None), done.stdout + done.stderr
        return done

    def tables(self) -> dict:
        return build_tables(Store(self.store), write=False)

    def records(self) -> dict[str, object]:
        return {record.job.id: record for record in Store(self.store).records()}

    def of_kind(self, kind: str) -> list:
        return [record for record in self.records().values() if record.job.kind == kind]


@pytest.fixture
def bench(tmp_path: Path, dataset: Path) -> Bench:
    return Bench(tmp_path, dataset)


@pytest.fixture
def inside(bench: Bench, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """Commands other than runs end in this process: no interpreter starts, and nothing is imported again."""
    for name in ("BENCH_LOCKS", "BENCH_CACHE", "TORCH_HOME", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, bench.environment[name])
    monkeypatch.delenv("BENCH_DATA", raising=False)
    monkeypatch.chdir(bench.store.parent)

    def call(self: Bench, *arguments: object, code: int | None = 0) -> subprocess.CompletedProcess[str]:
        words = [*map(str, arguments)]
        capfd.readouterr()
        try:
            found = main(words)
        except SystemExit as end:
            found = int(end.code or 0)
        done = subprocess.CompletedProcess(words, found, *capfd.readouterr())
        assert code in (found, None), done.stdout + done.stderr
        return done

    monkeypatch.setattr(Bench, "__call__", call)


@pytest.fixture(scope="session")
def _finished_store(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    bench = Bench(tmp_path_factory.mktemp("finished"), dataset)
    bench.run()
    return bench.store


@pytest.fixture
def finished(bench: Bench, _finished_store: Path) -> Bench:
    """A store of its own in which scene a is done."""
    shutil.copytree(_finished_store, bench.store)
    return bench
