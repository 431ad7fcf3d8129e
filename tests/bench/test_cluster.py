"""Runs on workers of Dask: what is lost is done again, once, and the tables are those of a local run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import psutil
import pytest

from bench.store import Store
from bench.tables import build_tables
from reports.schema import COLUMNS

from .conftest import PATIENCE, Bench

pytest.importorskip("distributed")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are pinned to cores on Linux only")

CLUSTER = ("--executor", "dask")
SWEEP = (
    *(part for seed in range(10) for part in ("--seed", seed)),
    *("--scene", "b", "--set", "fake-torch.behaviour=refuse", "--set", "fake-torch.only=b"),
)
"""62 jobs: of one scene all are done, of the other the fits are refused and the rest is given up."""


def _wait_for(condition, process: subprocess.Popen) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.02)


def _done(bench: Bench) -> int:
    return len(list(bench.store.glob("jobs/*/record.json")))


def _attempts(bench: Bench) -> int:
    """How often any job began."""
    files = bench.store.glob("jobs/*/progress.jsonl")
    return sum(file.read_text().count('"waiting": false') for file in files)


def _at_work(process: subprocess.Popen) -> list[psutil.Process]:
    """Dask's workers that run a job now."""
    found = []
    with suppress(psutil.Error):
        for child in psutil.Process(process.pid).children():
            if "spawn_main" in " ".join(child.cmdline()):
                for grandchild in child.children():
                    forks = grandchild.children() if "bench.processes" in grandchild.cmdline() else []
                    if forks or "bench.worker" in grandchild.cmdline():
                        found.append(child)
    return found


def _tables(bench: Bench) -> dict[str, str]:
    """The tables without what depends on the machine and its speed."""
    apart = {"processor", "fit_processor", "threads", "timing"}
    apart |= {
        name
        for name, one in COLUMNS.items()
        if one.unit in ("s", "ms", "FPS") or name.endswith(("host_bytes", "device_bytes"))
    }
    return {
        name: table.drop(columns=[column for column in table if column in apart]).to_csv()
        for name, table in build_tables(Store(bench.store), write=False).items()
    }


def test_a_sweep_with_a_worker_killed_and_one_that_hangs_ends_as_a_local_run(
    bench, dataset, tmp_path
) -> None:
    local = Bench(tmp_path / "local", dataset)
    local.store.parent.mkdir()
    local.run(*SWEEP, method="fake-torch", code=1)

    bench.environment["DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL"] = "1s"
    process = bench.start(*SWEEP, *CLUSTER, "--workers", 3, method="fake-torch")
    for done, number in ((8, signal.SIGKILL), (16, signal.SIGSTOP)):
        _wait_for(lambda done=done: _done(bench) >= done and _at_work(process), process)
        with suppress(ProcessLookupError):
            os.kill(_at_work(process)[0].pid, number)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1, output

    assert len(local.records()) == 62
    assert {job: record.status for job, record in bench.records().items()} == {
        job: record.status for job, record in local.records().items()
    }
    assert _tables(bench) == _tables(local)
    assert not list((bench.store / "partial").iterdir())
    assert not list((bench.store / "locks").glob("*-*"))
    assert _attempts(local) <= _attempts(bench) <= _attempts(local) + 2
