"""Leases: one holder, whatever died, expired or stood still; who lost a lease puts nothing in place."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest

from econgs_bench.bench.jobs.complexity import Complexity
from econgs_bench.bench.store import leases
from econgs_bench.bench.store.leases import EXPIRY, Held, Lease, Lost
from econgs_bench.bench.store.records import Record, Request
from econgs_bench.bench.store.store import Store

from .conftest import PATIENCE

HOLDER = """
import sys, time
from pathlib import Path
from econgs_bench.bench.store.leases import Lease
lease = Lease(Path(sys.argv[1])).acquire()
print("held", flush=True)
time.sleep(600)
"""


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "locks" / "fit-1"


@pytest.fixture
def holder(bench, folder):
    """Another process with the lease."""
    folder.parent.mkdir()
    command = [sys.executable, "-c", HOLDER, str(folder)]
    process = subprocess.Popen(command, env=bench.environment, stdout=subprocess.PIPE, encoding="utf-8")
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate(timeout=PATIENCE)


def _elsewhere(lease: Lease, monkeypatch) -> Lease:
    """Take a lease as a process on another machine does."""
    with monkeypatch.context() as patch:
        patch.setattr(leases, "_machine", lambda: "elsewhere")
        return lease.acquire(timeout=0)


def _age(folder, seconds: float) -> None:
    (token,) = folder.iterdir()
    beat = token.stat().st_mtime - seconds
    os.utime(token, (beat, beat))


def test_one_has_it_until_it_is_released(folder) -> None:
    folder.parent.mkdir()
    first, second = Lease(folder), Lease(folder)
    with first:
        assert second.is_held
        with pytest.raises(Held):
            second.acquire(timeout=0)
        first.renew()
    assert not second.is_held
    assert not list(folder.parent.iterdir())
    with second.acquire(timeout=0):
        assert first.is_held


def test_it_is_free_when_its_holder_dies(folder, holder) -> None:
    with pytest.raises(Held):
        Lease(folder).acquire(timeout=0)
    holder.kill()
    holder.wait(timeout=PATIENCE)
    with Lease(folder).acquire(timeout=0):
        pass
    assert not list(folder.parent.iterdir())


def test_a_holder_that_is_stopped_keeps_it_until_it_expires(folder, holder) -> None:
    _age(folder, 2 * EXPIRY)
    assert Lease(folder).is_held  # it runs, however busy it is
    holder.send_signal(signal.SIGSTOP)
    while psutil.Process(holder.pid).status() != psutil.STATUS_STOPPED:
        time.sleep(0.01)
    assert not Lease(folder).is_held


def test_a_file_that_is_no_token_keeps_nobody_out_for_longer_than_a_lease(folder) -> None:
    folder.mkdir(parents=True)
    (folder / "stray").touch()
    assert Lease(folder).is_held
    _age(folder, 2 * EXPIRY)
    with Lease(folder).acquire(timeout=0):
        assert not (folder / "stray").exists()
    assert not folder.exists()


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_token_of_a_received_store_keeps_nobody_out_for_ever(folder, kind) -> None:
    folder.mkdir(parents=True)
    token = folder / "node-0123456789ab-1-1-01234567"
    token.touch() if kind == "file" else token.mkdir()
    _age(folder, -3e9)
    with Lease(folder).acquire(timeout=0):
        pass
    assert not Lease(folder).is_held


def test_an_expired_lease_of_another_machine_is_taken_over_once(folder, monkeypatch) -> None:
    folder.parent.mkdir()
    lost = _elsewhere(Lease(folder), monkeypatch)
    _age(folder, EXPIRY / 2)
    assert Lease(folder).is_held
    lost.renew()
    _age(folder, 2 * EXPIRY)
    assert not Lease(folder).is_held

    def takes(_) -> bool:
        try:
            Lease(folder).acquire(timeout=0)
        except Held:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(takes, range(8))) == 1
    with pytest.raises(Lost):
        lost.renew()
    lost.release()
    assert Lease(folder).is_held


def test_holders_take_turns(folder) -> None:
    folder.parent.mkdir()
    inside = []

    def work(number: int) -> None:
        for _ in range(5):
            with Lease(folder):
                inside.append(number)
                assert len(inside) == 1
                inside.remove(number)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))


def test_without_its_lease_a_record_is_not_put_in_place(tmp_path, monkeypatch) -> None:
    store = Store(tmp_path / "s", create=True)
    job = Complexity(
        key="1" * 16, identity={}, dataset="d", dataset_name="d", scenes=("a",),
        preset="quick", request=Request(train_views=1, test_views=1, width=1, height=1),
    )  # fmt: skip
    record = Record(job=job, status="ok", started="", finished="", wall_seconds=1.0)
    lost = _elsewhere(store.lease(job.id), monkeypatch)
    _age(store.locks / job.id, 2 * EXPIRY)
    with store.lease(job.id) as lease:
        with pytest.raises(Lost):
            store.finish(record, lease=lost)
        assert store.record(job.id) is None
        store.finish(record, lease=lease)
    assert store.record(job.id) == record


def test_a_fit_whose_lease_was_taken_over_writes_nothing(bench, tmp_path) -> None:
    """The run then waits for the new holder, which ends here without a record, and starts the fit again."""
    go_on = tmp_path / "go on"
    process = bench.start("--set", "fake.behaviour=hold", "--set", f"fake.file={go_on}")
    while not any('"held"' in p.read_text() for p in bench.store.glob("partial/fit-*/progress.jsonl")):
        assert process.poll() is None
        time.sleep(0.05)
    (token,) = bench.store.glob("locks/fit-*/*")
    os.rename(token, token.with_name(leases._token()))
    go_on.touch()
    (log,) = bench.store.glob("partial/fit-*/progress.jsonl")
    fit = log.parent.name
    try:
        while psutil.pid_exists(int(token.name.rsplit("-", 4)[2])):
            time.sleep(0.05)
        assert Store(bench.store).record(fit) is None
    finally:
        (thief,) = bench.store.glob("locks/fit-*/*")
        thief.unlink()
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert all(record.ok for record in bench.records().values())
    assert (bench.store / "jobs" / fit / log.name).read_text().count('"stage": "fit"') == 2
