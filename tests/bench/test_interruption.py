"""Real signals at awkward moments: nothing half-written, lost only the work since the last checkpoint."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from econgs_bench.bench.store.store import Store, read_record

from .conftest import Bench, runs, wait_for, workers

METHODS = ("fake", "fake-torch")
"""Without torch, in an interpreter of its own, and with it, forked."""
SLOW = ("--set", "fake.pace=0.05", "--set", "fake.iterations=40")


def _records_are_whole(store: Path) -> int:
    """Every record in the store can be read (``read_record`` raises otherwise); their number."""
    files = [*store.glob("jobs/*/record.json"), *store.glob("partial/*/record.json")]
    for file in files:
        read_record(file)
    assert not [f for f in store.glob("jobs/*") if not (f / "record.json").is_file()]
    return len(files)


def _models(store: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in store.glob("jobs/encode-*/model/*")}


def _held(store: Path) -> bool:
    return any('"held"' in p.read_text() for p in store.glob("partial/fit-*/progress.jsonl"))


class Hold:
    """Options of a fit that stands still half-way until it is let go."""

    def __init__(self, folder: Path, method: str) -> None:
        self._file = folder / "go on"
        self.method = method
        options = ("behaviour=hold", f"file={self._file}", "iterations=40")
        self.options = tuple(part for option in options for part in ("--set", f"{method}.{option}"))

    def start(self, bench, *before: str) -> subprocess.Popen:
        """A run, once its fit stands still; words before its command."""
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup a child would be deaf to it
        command = [*before, *bench.run_arguments("--no-report", *self.options, method=self.method)]
        process = bench._start(command)
        wait_for(lambda: _held(bench.store))
        return process

    def let_go(self) -> None:
        self._file.touch()

    def run(self, bench, *more: str, code: int = 0) -> None:
        """A whole run."""
        bench.run(*self.options, *more, method=self.method, code=code)


@pytest.fixture(params=METHODS)
def hold(tmp_path, request) -> Hold:
    return Hold(tmp_path, request.param)


@pytest.fixture(scope="module")
def undisturbed(dataset, tmp_path_factory):
    """Method -> models of a run that nobody touched."""
    models = {}
    for method in METHODS:
        bench = Bench(tmp_path_factory.mktemp("undisturbed"), dataset)
        bench.run("--set", f"{method}.iterations=40", method=method)
        models[method] = _models(bench.store)
    return models


@pytest.mark.parametrize(
    ("hold", "number"),
    [
        ("fake-torch", signal.SIGTERM),
        pytest.param("fake", signal.SIGINT, marks=pytest.mark.slow),
        pytest.param("fake", signal.SIGHUP, marks=pytest.mark.slow),
    ],
    indirect=["hold"],
)
def test_ctrl_c_checkpoints_and_resumes(bench, hold, undisturbed, number) -> None:
    process = hold.start(bench)
    process.send_signal(number)
    if number == signal.SIGHUP:  # of the shell, and of the system
        time.sleep(0.1)
        process.send_signal(number)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130, output
    assert "run the same command again to resume" in output
    assert not bench.of_kind("fit")
    (checkpoint,) = bench.store.glob("partial/fit-*/checkpoint/0*")
    assert int(checkpoint.name) == 20

    hold.let_go()
    hold.run(bench)
    (fit,) = bench.of_kind("fit")
    assert fit.result.resumed == 1
    assert _models(bench.store) == undisturbed[hold.method]
    assert not list((bench.store / "partial").iterdir())


@pytest.mark.parametrize("hold", ["fake"], indirect=True)
def test_a_run_under_nohup_outlives_its_terminal(bench, hold) -> None:
    process = hold.start(bench, "nohup")
    process.send_signal(signal.SIGHUP)
    time.sleep(0.2)
    hold.let_go()
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert bench.of_kind("measure")


@pytest.mark.parametrize(
    ("hold", "whole"), [("fake", True), ("fake-torch", False)], indirect=["hold"], ids=["removed", "emptied"]
)
def test_a_run_ends_with_an_error_once_its_store_is_gone(bench, hold, whole) -> None:
    process = hold.start(bench)
    for path in [bench.store] if whole else list(bench.store.iterdir()):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    hold.let_go()
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 2, output
    assert f"{bench.store}: the run store was removed or moved during the run. Put it back" in output
    assert bench.store.exists() is not whole  # nothing is written where it was


def test_killing_the_executor_stops_its_worker(bench, hold, undisturbed) -> None:
    process = hold.start(bench)
    (worker,) = workers(process)
    process.kill()
    process.communicate(timeout=120)
    wait_for(lambda: not runs(worker))
    _records_are_whole(bench.store)
    hold.let_go()
    hold.run(bench)
    assert _models(bench.store) == undisturbed[hold.method]


@pytest.mark.parametrize(
    ("hold", "victim"),
    [
        ("fake-torch", "worker"),
        pytest.param("fake", "worker", marks=pytest.mark.slow),
        pytest.param("fake-torch", "server", marks=pytest.mark.slow),
    ],
    indirect=["hold"],
)
def test_killing_a_worker_or_its_server_is_a_failure_that_retry_resumes(
    bench, hold, undisturbed, victim
) -> None:
    process = hold.start(bench)
    (worker,) = workers(process)
    (worker if victim == "worker" else worker.parent()).kill()
    process.communicate(timeout=120)
    assert process.returncode == 1
    wait_for(lambda: not runs(worker))
    (fit,) = bench.of_kind("fit")
    assert (fit.status, fit.reason) == ("failed", "killed by signal 9 (SIGKILL)")
    hold.let_go()
    hold.run(bench, code=1)
    hold.run(bench, "--retry")
    assert _models(bench.store) == undisturbed[hold.method]
    assert not list((bench.store / "partial").iterdir())


@pytest.mark.parametrize("seed", [1, *(pytest.param(s, marks=pytest.mark.slow) for s in (2, 3, 4))])
def test_kill_9_at_random_moments(bench, undisturbed, seed: int) -> None:
    """Executor or worker dies again and again; in the end all is as if nothing had happened."""
    rng = random.Random(seed)
    for _ in range(4):
        process = bench.start(*SLOW, "--retry")
        time.sleep(rng.uniform(0.3, 4.0))
        victims = [process.pid, *(worker.pid for worker in workers(process))]
        rng.shuffle(victims)
        for victim in victims[: rng.choice([1, 2])]:
            try:
                os.kill(victim, signal.SIGKILL)
            except ProcessLookupError:
                continue
        if process.pid not in victims[:1]:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)
        _records_are_whole(bench.store)
    bench.run(*SLOW, "--retry")
    assert _records_are_whole(bench.store) == 4
    assert all(record.ok for record in Store(bench.store).records())
    assert _models(bench.store) == undisturbed["fake"]


def test_two_runs_on_one_store_share_the_work(bench, undisturbed) -> None:
    first, second = bench.start(*SLOW), bench.start(*SLOW)
    for process in (first, second):
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 0, output
    assert _records_are_whole(bench.store) == 4
    assert _models(bench.store) == undisturbed["fake"]
