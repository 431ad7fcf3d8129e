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

from econgs_bench.bench.run.experiment import _executor
from econgs_bench.bench.run.request import Execution
from econgs_bench.datasets.errors import DataError

from .conftest import PATIENCE, Bench, attempts, plain_tables, suite_file

pytest.importorskip("distributed")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are pinned to cores on Linux only")

ON = ("--executor", "dask", "--scheduler")
SWEEP = """threads = 1
seeds = [0, 1, 2, 3, 4, 5]
variants = [{ fake-torch = { behaviour = "refuse", only = "b,c" } }]"""
"""57 jobs: of scene a all are done; of the others the fits are refused, and the rest is given up."""


def _wait_for(condition, process: subprocess.Popen) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.02)


def _done(bench: Bench) -> int:
    return len(list(bench.store.glob("jobs/*/record.json")))


def _at_work(process: subprocess.Popen) -> list[psutil.Process]:
    """Dask's workers that run a job now."""
    found = []
    with suppress(psutil.Error):
        for child in psutil.Process(process.pid).children():
            if "spawn_main" in " ".join(child.cmdline()):
                for grandchild in child.children():
                    forks = (
                        grandchild.children()
                        if "econgs_bench.bench.run.processes" in grandchild.cmdline()
                        else []
                    )
                    if forks or "econgs_bench.bench.run.worker" in grandchild.cmdline():
                        found.append(child)
    return found


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Address of a scheduler with two workers, which live on when a run dies."""
    file = tmp_path_factory.mktemp("cluster") / "start.py"
    code = (
        "import sys, distributed\n"
        "if __name__ == '__main__':\n"
        "    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as c:\n"
        "        print(c.scheduler_address, flush=True)\n"
        "        sys.stdin.read()\n"
    )
    file.write_text(code)
    environment = Bench(file.parent, file.parent).environment
    environment["DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES"] = "1"
    process = subprocess.Popen(
        [sys.executable, file], env=environment, encoding="utf-8",
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    yield process.stdout.readline().strip()
    process.communicate(timeout=PATIENCE)


def _hold(bench: Bench, cluster: str, tmp_path) -> tuple[subprocess.Popen, tuple[str, ...]]:
    """A run on a cluster whose fit stands still until the file `go on` is there, and its options."""
    options = ("--set", "fake.behaviour=hold", "--set", f"fake.file={tmp_path / 'go on'}")
    process = bench.start(*options, "--set", "fake.iterations=40", *ON, cluster)
    _wait_for(
        lambda: any('"held"' in p.read_text() for p in bench.store.glob("partial/fit-*/progress.jsonl")),
        process,
    )
    return process, (*options, "--set", "fake.iterations=40")


@pytest.mark.slow
def test_a_sweep_with_a_worker_killed_and_one_that_hangs_ends_as_a_local_run(
    bench, dataset, tmp_path
) -> None:
    suite = suite_file(tmp_path, f'"{dataset}" = ["a", "b"]', SWEEP)
    local = Bench(tmp_path / "local", dataset)
    local.store.parent.mkdir()
    local.run_suite(suite, "--method", "fake-torch", code=1)

    bench.environment["DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL"] = "1s"
    process = bench.start_suite(suite, "--method", "fake-torch", "--executor", "dask", "--workers", 3)
    for done, number in ((8, signal.SIGKILL), (16, signal.SIGSTOP)):
        _wait_for(lambda done=done: _done(bench) >= done and _at_work(process), process)
        with suppress(ProcessLookupError):
            os.kill(_at_work(process)[0].pid, number)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1, output

    assert len(local.records()) == 38
    assert plain_tables(bench.store) == plain_tables(local.store)
    assert not list((bench.store / "partial").iterdir())
    assert not list((bench.store / "locks").glob("*-*"))
    assert attempts(local.store) <= attempts(bench.store) <= attempts(local.store) + 2


def test_what_workers_write_after_a_run_has_died_counts(bench, cluster, tmp_path) -> None:
    process, options = _hold(bench, cluster, tmp_path)
    process.kill()
    process.communicate(timeout=PATIENCE)
    (tmp_path / "go on").touch()
    end = time.monotonic() + PATIENCE
    while not list(bench.store.glob("jobs/fit-*")):
        assert time.monotonic() < end
        time.sleep(0.05)
    again = bench.run(*options, *ON, cluster)
    assert "] fit" not in again.stderr
    assert "] measure" in again.stderr
    assert all(record.ok for record in bench.records().values())
    assert attempts(bench.store) == 4


def test_ctrl_c_checkpoints_on_the_workers_and_any_executor_resumes(bench, cluster, tmp_path) -> None:
    process, options = _hold(bench, cluster, tmp_path)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, output
    (checkpoint,) = bench.store.glob("partial/fit-*/checkpoint/0*")
    assert int(checkpoint.name) == 20
    (tmp_path / "go on").touch()
    bench.run(*options)
    (fit,) = bench.of_kind("fit")
    assert fit.result.resumed == 1


def test_a_job_that_takes_its_workers_down_is_a_row(bench, cluster) -> None:
    bench.environment["DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES"] = "1"
    bench.run("--set", "fake.behaviour=parent", *ON, cluster, code=1)
    (row,) = bench.tables()["results"].to_dict("records")
    assert row["status"] == "failed"
    assert row["reason"].startswith("fit: killed with its worker 2 times or more")


def test_a_job_that_hangs_ends_at_its_limit(bench, cluster) -> None:
    bench.run("--set", "fake.behaviour=sleep", "--time-limit", "3", *ON, cluster, code=1)
    (fit,) = bench.of_kind("fit")
    assert (fit.status, "time limit of 3 s" in fit.reason) == ("timeout", True)


def test_what_cannot_be_done_is_said_with_a_remedy(bench, tmp_path, monkeypatch) -> None:
    assert "Add --executor dask" in bench.run("--workers", 2, code=2).stderr
    bench.environment["DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"] = "1s"
    lost = bench.run(*ON, "tcp://127.0.0.1:1", code=2).stderr
    assert "no scheduler answers there" in lost
    for name in ("econgs_bench.bench.run.cluster", "econgs_bench.bench.run.node"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        DataError, match=r"needs the package distributed. pip install 'econgs-bench\[cluster\]'"
    ):
        _executor(Execution(executor="dask", workers=2))


STRANGER = """
import asyncio, contextlib, os, sys, urllib.request, urllib.error
import distributed
if os.getuid() == 0: os.setgroups([]); os.setgid(65534); os.setuid(65534)
for port in map(int, sys.argv[1:]):
    for scheme in ("tcp", "tls"):
        with contextlib.suppress(Exception):
            client = distributed.Client(f"{scheme}://127.0.0.1:{port}", timeout=1, set_as_default=False)
            print("scheduler", port, client.run_on_scheduler(os.getpid), client.run(os.getpid))
        async def ask():
            async with distributed.rpc(f"{scheme}://127.0.0.1:{port}", timeout=1) as one:
                return await asyncio.wait_for(one.identity(), 1)
        with contextlib.suppress(Exception):
            print("identity", port, asyncio.run(ask()))
    for page in ("", "info/main/workers.html", "info/logs.html", "json/identity.json", "status", "health"):
        with contextlib.suppress(Exception):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=1) as answer:
                print("page", port, page, answer.read()[:80])
print("end")
"""


def _ports(process: psutil.Process) -> list[int]:
    """TCP ports on which a process and its children listen."""
    ports = set()
    for one in (process, *process.children(recursive=True)):
        with suppress(psutil.Error):
            ports |= {at.laddr.port for at in one.net_connections("tcp") if at.status == psutil.CONN_LISTEN}
    return sorted(ports)


@pytest.mark.slow
def test_another_user_of_the_machine_gives_no_orders_to_its_workers(bench, tmp_path) -> None:
    options = ("--set", "fake.behaviour=hold", "--set", f"fake.file={tmp_path / 'go on'}")
    run = bench.start(*options, "--set", "fake.iterations=40", "--executor", "dask", "--workers", 1)
    _wait_for(lambda: list(bench.store.glob("partial/fit-*/progress.jsonl")), run)
    ports = _ports(psutil.Process(run.pid))
    assert len(ports) >= 2
    stranger = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", STRANGER, *map(str, ports)], capture_output=True,
        encoding="utf-8", timeout=PATIENCE, check=False, cwd="/",
    )  # fmt: skip
    assert stranger.stdout == "end\n", stranger.stderr
    (tmp_path / "go on").touch()
    assert run.wait(PATIENCE) == 0, run.stdout.read()
