"""Forked workers: what their server must not do, and that they measure what an interpreter does."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from econgs_bench.bench.machine.provenance import imports_torch
from econgs_bench.bench.machine.timing import available_cores
from econgs_bench.bench.run.processes import Fork, Processes
from econgs_bench.bench.run.runner import THREAD_VARIABLES
from econgs_bench.bench.store.store import Store

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")


@pytest.fixture
def processes(bench):
    processes = Processes(bench.environment | dict.fromkeys(THREAD_VARIABLES, "2"))
    yield processes
    processes.close()


def _fork(processes: Processes, folder: Path) -> Fork:
    """A worker of a folder without a job: it ends at once with exit code 1."""
    with (folder / "log.txt").open("ab") as log:
        worker = processes.fork(folder, log)
    assert isinstance(worker, Fork)
    return worker


def test_the_server_only_imports_libraries(processes, tmp_path) -> None:
    """A thread in it would be missing in its workers: their first operation on several threads would hang."""
    assert _fork(processes, tmp_path).wait() == 1
    assert "no run store" in (tmp_path / "log.txt").read_text()
    server = Path("/proc", str(processes.server.pid))
    threads = [line.split()[1] for line in (server / "status").read_text().splitlines() if "Threads" in line]
    assert threads == ["1"]
    libraries = {Path(line.split()[-1]).name for line in (server / "maps").read_text().splitlines()}
    assert any("torch_cpu" in name for name in libraries)
    assert not [name for name in libraries if any(word in name for word in ("_native", "LLVM", "drjit"))]


def test_a_server_that_died_is_started_again(processes, tmp_path) -> None:
    assert _fork(processes, tmp_path).wait() == 1
    first = processes.server.pid
    processes.server.kill()
    processes.server.wait()
    assert _fork(processes, tmp_path).wait() == 1
    assert processes.server.pid != first


def test_a_worker_whose_server_is_gone_is_waited_for(processes, tmp_path) -> None:
    before = {one.pid for one in psutil.Process().children(recursive=True)}
    with processes.adopting():
        worker = _fork(processes, tmp_path)
        processes.close()
        assert psutil.pid_exists(worker.pid), "it has nobody who waits for it"
    left = [one for one in psutil.Process().children(recursive=True) if one.pid not in before]
    assert not left


def test_without_a_server_workers_have_interpreters_of_their_own(processes, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("econgs_bench.bench.run.processes.SERVER", "no.such.module")
    with (tmp_path / "log.txt").open("ab") as log:
        worker = processes.fork(tmp_path, log)
    assert isinstance(worker, subprocess.Popen)
    assert worker.wait() == 1


def test_a_fork_takes_the_memory_of_an_interpreter_of_its_own(bench, tmp_path) -> None:
    bench.run(method="fake-torch")
    (forked,) = bench.of_kind("fit")
    job = shutil.move(bench.store / "jobs" / forked.job.id, bench.store / "partial")
    for name in ("record.json", "checkpoint", "progress.jsonl"):
        path = Path(job, name)
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    environment = bench.environment | dict.fromkeys(THREAD_VARIABLES, str(available_cores()))
    subprocess.run(
        [sys.executable, "-m", "econgs_bench.bench.run.worker", job],
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    alone = Store(bench.store).record(forked.job.id)
    assert alone.result.losses == forked.result.losses
    assert forked.peak_host_bytes == pytest.approx(alone.peak_host_bytes, rel=0.03)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("import torch\n", True),
        ("def f():\n    from torch.nn import functional\n", True),
        ("import torchlight\n", False),
        ('"""import torch"""\n', False),
        ("import numpy\n", False),
    ],
)
def test_methods_with_torch_are_known_by_their_source(tmp_path, monkeypatch, source, expected) -> None:
    name = f"source_{abs(hash(source))}"
    (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    assert imports_torch(name) is expected
    assert not imports_torch("no_such_module_at_all")
