"""Default limits: no job that was ever recorded comes near them, and each says how to lift it."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from econgs_bench.bench.plan.estimates import Past
from econgs_bench.bench.results.bundle import zip_of
from econgs_bench.bench.run.limits import (
    LEAST_SECONDS,
    SHARE,
    TIMES,
    Limit,
    Limits,
    available_memory,
    time_reason,
    used_memory,
)
from econgs_bench.bench.run.runner import Runner
from econgs_bench.bench.store.records import Record
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.seals import unsealed
from econgs_bench.methods.registry import Registry

from .conftest import plan

BUNDLES = sorted((Path(__file__).parents[2] / "reports" / "measured").rglob("*.zip.xz"))
BUSY = 8.0
"""How much longer a fit took on a busy machine than on the same machine at rest."""


def _records(bundle: Path) -> list[Record]:
    with zip_of(bundle) as archive:
        names = [name for name in archive.namelist() if name.endswith("record.json")]
        texts = [unsealed(archive.read(name).decode()) for name in names]
        records = map(Record.model_validate_json, texts)
        return [record.job.migrated(record) for record in records]


class Shelf:
    """Stands for a store whose jobs have no files."""

    jobs = Path("nowhere")


@pytest.mark.parametrize("bundle", BUNDLES, ids=lambda path: path.stem)
def test_no_recorded_job_would_have_been_ended_even_on_a_busy_machine(bundle) -> None:
    registry, alike = Registry(), defaultdict(list)
    for record in _records(bundle):
        if record.ok:
            alike[record.job.kind, record.job.axes()["method"], record.job.preset].append(record)
    assert alike
    for (_, method, _), records in alike.items():
        spec = registry.spec(method) if method else None
        for record in records:
            others = Past([])
            for other in records:
                if other is not record:
                    others.add(Shelf(), other)
            limit = Limits().time(record.job, others, spec)
            assert record.wall_seconds * BUSY < limit.amount, (record.job.title, limit)
            assert (record.peak_host_bytes or 0) < SHARE * record.provenance.memory_bytes


def _record(job, seconds: float) -> Record:
    return Record(job=job, status="ok", started="", finished="", wall_seconds=seconds)


def test_a_limit_says_where_it_comes_from_and_how_to_lift_it(suite) -> None:
    fit = next(job for job in plan(suite()) if job.kind == "fit")
    spec, past = Registry([Path(__file__).parent / "plugins"]).spec("fake"), Past([])
    first = Limits().time(fit, past, spec)
    assert first.amount == 8 * 3600
    longer = fit.model_copy(update={"iterations": 3 * fit.iterations})
    assert Limits().time(longer, past, spec).amount == 3 * first.amount
    past.add(Shelf(), _record(fit, 1.0))
    assert Limits().time(fit, past, spec).amount == LEAST_SECONDS
    past.add(Shelf(), _record(fit, 999.0))
    assert Limits().time(fit, past, spec).amount == TIMES * 500
    assert Limits().time(longer, past, spec).amount == 3 * TIMES * 500
    other = fit.model_copy(update={"variant": "fake.points=500000"})
    assert Limits().time(other, past, spec).amount == first.amount
    past.add(Shelf(), _record(other, 9990.0))
    assert Limits().time(other, past, spec).amount == TIMES * 9990
    reason = time_reason(Limits().time(fit, past, spec))
    assert reason.startswith("killed after its time limit of 8:20 h")
    assert "--time-limit none" in reason
    off = Limits(math.inf, math.inf)
    assert off.time(fit, past, spec).amount == off.bytes().amount == math.inf
    assert "--memory-limit none" in Limits().bytes().origin


def test_an_estimate_grows_with_the_iterations_of_a_fit(suite) -> None:
    fit = next(job for job in plan(suite()) if job.kind == "fit")
    past = Past([])
    past.add(Shelf(), _record(fit, 10.0))
    longer = fit.model_copy(update={"iterations": 16 * fit.iterations})
    assert past.estimate(longer).seconds_for(longer) == 160.0


def test_views_from_the_cache_say_nothing_of_views_that_must_be_rendered(suite) -> None:
    views = next(job for job in plan(suite()) if job.kind == "views")
    past = Past([])
    past.add(Shelf(), _record(views, 0.01))
    assert Limits().time(views, past, None).amount >= 8 * 3600


def test_looks_at_memory_go_on_while_the_machine_is_busy(suite, tmp_path, monkeypatch) -> None:
    """Looks that wait 50 ms for a processor each, of which the sixth finds too much."""
    looks = []

    def slow(pid: int, limit: float) -> int:
        looks.append(pid)
        time.sleep(0.05)
        return 200 if len(looks) > 5 else 0

    def wait(timeout: float | None = None) -> int:
        if timeout is None:
            return -9
        time.sleep(0.01)
        raise subprocess.TimeoutExpired("worker", timeout)

    job = next(job for job in plan(suite()) if job.kind == "fit")
    store = Store(tmp_path / "runs", create=True)
    (store.partial / job.id).mkdir()
    monkeypatch.setattr("econgs_bench.bench.run.runner.used_memory", slow)
    monkeypatch.setattr("econgs_bench.bench.run.runner.end_session", lambda pid: None)
    runner = Runner(
        store, None, Limit(100, "here"), plugins=(), threads=1, stops=lambda: 0, show=lambda job, state: None
    )
    start = time.monotonic()
    _, verdict = runner._watch(SimpleNamespace(pid=1, poll=lambda: None, wait=wait), job, Limit(60.0, "here"))
    assert verdict[0] == "oom"
    assert time.monotonic() - start < 5.0  # by the clock, five pauses of 2.5 s


MAPPED = """
import mmap, subprocess, sys
with open(sys.argv[1], "rb") as opened, mmap.mmap(opened.fileno(), 0, prot=mmap.PROT_READ) as pages:
    assert pages[:: mmap.PAGESIZE].count(b"x") == len(pages) // mmap.PAGESIZE
    child = subprocess.Popen([sys.executable, "-c", ""])
    print(child.pid, flush=True)
    sys.stdin.read()
"""
"""A process with a file in memory, and a child that has ended and that nobody has waited for."""


@pytest.mark.skipif(sys.platform != "linux", reason="no fork here")
def test_pages_of_files_are_no_memory_of_a_job(tmp_path) -> None:
    """Against the system's own count of anonymous pages, with a file of 64 MiB in memory."""
    file = tmp_path / "volume.raw"
    file.write_bytes(b"x" * 2**26)
    command = [sys.executable, "-c", MAPPED, str(file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        child = psutil.Process(int(process.stdout.readline()))
        while child.status() != psutil.STATUS_ZOMBIE:
            time.sleep(0.01)
        resident = psutil.Process(process.pid).memory_info().rss
        assert used_memory(process.pid, math.inf) == pytest.approx(resident, rel=0.1)
        held = used_memory(process.pid, 0)
        assert held <= resident - 2**26
        lines = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8").splitlines()
        counts = [int(line.split()[1]) for line in lines if line.startswith(("RssAnon", "RssShmem"))]
        assert held == pytest.approx(1024 * sum(counts), rel=0.05)
        process.communicate()
    assert 0 < available_memory() <= psutil.virtual_memory().total + psutil.swap_memory().total
