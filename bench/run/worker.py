"""Runs one job in this process: ``python -m econgs_bench.bench.run.worker FOLDER``.

FOLDER is ``RUNS/partial/<kind>-<key>`` with a ``job.json``. Exit codes: 0, the job has a record (of success
or failure); 75, stopped and resumable; 76, another process works on it; 1, a defect, or a job that has a
record of success failed when it ran again.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import psutil
from pydantic import ValidationError

from econgs_bench.bench.jobs.context import SCRATCH
from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.jobs.monitor import Progress, Stop, Stopped
from econgs_bench.bench.machine.device import prepare_device
from econgs_bench.bench.machine.locks import holder, locked
from econgs_bench.bench.machine.timing import peak_device_bytes
from econgs_bench.bench.store.leases import BEAT, Held, Lease, Lost
from econgs_bench.bench.store.progress import now, traces
from econgs_bench.bench.store.records import Record, Result, Status, Task, record_of
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError, text_of
from econgs_bench.datasets.memory import peak_host_bytes
from econgs_bench.methods.failures import failure, is_memory_error
from econgs_bench.methods.interface import Diverged, Refused
from econgs_bench.methods.shared.decoders import decode_here

if TYPE_CHECKING:
    from econgs_bench.methods.interface import MethodSpec

STOPPED, BUSY = 75, 76
GRACE_SECONDS = 60.0
"""How long a fit may take to its next checkpoint once it is to stop."""


def main(folder: Path) -> int:
    """Run the job of a partial folder to its record."""
    decode_here()
    store = Store(folder.parent.parent, checked=True)
    task = Task.model_validate_json((folder / "job.json").read_bytes())
    stop = Stop()
    with ExitStack() as stack:
        try:
            lease = stack.enter_context(store.lease(task.job.id).acquire(timeout=0))
        except Held:
            return BUSY
        if (folder / "record.json").is_file():  # a kill came between record and rename
            store.put_in_place(folder, task.job.id, lease)
            return 0
        before = store.record(task.job.id)
        # From another run meanwhile.
        whole = before is not None and (store.holds_files_of(before) or not before.ok)
        if whole and before is not None and before.finished != task.replaces:
            shutil.rmtree(folder, ignore_errors=True)
            return 0
        stop.install()
        _follow(stop, lease)
        report = Progress(folder / "progress.jsonl")
        try:
            if task.job.kind != "views":  # timed jobs have the machine to themselves
                _wait_for_turn(task.alone, stack, report)
            report(stage=task.job.kind, waiting=False)
            record = run(task, folder, store, stop, report)
        except Stopped:
            return STOPPED
        if before is not None and before.ok and not record.ok:  # what is finished stays
            print(record.reason)
            return 1
        try:
            store.finish(record, folder, lease)
        except Lost:
            return BUSY
    return 0


def _wait_for_turn(alone: bool, stack: ExitStack, report: Progress) -> None:
    """Take the lock of this machine, alone or with other workers of a cluster; a wait is reported."""
    try:
        stack.enter_context(locked("timing", shared=not alone, wait=False))
    except BlockingIOError:
        who = holder("timing")
        words = "waiting for another timed job on this machine" + (f" ({who})" if who else "")
        report(stage=words, waiting=True)
        stack.enter_context(locked("timing", shared=not alone))


def run(task: Task, folder: Path, store: Store, stop: Stop, report: Progress) -> Record:
    """Run the job and return its record, of success or failure; only :class:`Stopped` is raised."""
    job = task.job
    shutil.rmtree(folder / SCRATCH, ignore_errors=True)  # of an attempt that was killed
    started, start = now(), time.perf_counter()
    status: Status = "ok"
    reason: str | None = None
    result: Result | None = None
    spec: MethodSpec | None = None
    context = None
    device = job.device if isinstance(job, MethodJob) else "cpu"
    try:
        from econgs_bench.bench.jobs.context import Context
        from econgs_bench.methods.registry import Registry

        if isinstance(job, MethodJob):
            spec = Registry(task.plugins, lenient=True).spec(job.method)  # others may have gone meanwhile
            prepare_device(device, spec)
        context = Context(job, folder, store, spec, task.threads, stop, report)
        result = job.run(context)
    except Refused as error:
        status, reason = "refused", text_of(error)
    except Diverged as error:
        status, reason = "diverged", text_of(error)
    except DataError as error:
        status, reason = "failed", text_of(error)
    except Exception as error:
        traceback.print_exc()
        status = "oom" if is_memory_error(error) else "failed"
        reason = f"{type(error).__name__}: {text_of(error)}"
        if spec is not None and (place := failure(error, spec).place):
            reason = f"{reason} ({place})"
    stop.deferred = True  # the job is finished: its record must be written
    if context is not None:
        shutil.rmtree(context.scratch, ignore_errors=True)
    from econgs_bench.bench.machine.provenance import provenance

    record = Record(
        job=job,
        status=status,
        reason=reason,
        started=started,
        finished=now(),
        wall_seconds=time.perf_counter() - start,
        peak_host_bytes=(context.peak_host_bytes if context else None) or peak_host_bytes(),
        peak_device_bytes=(context.peak_device_bytes if context else None) or peak_device_bytes(device),
        provenance=provenance(task.threads, spec, device),
        result=result,
        **({} if status == "ok" else traces(folder)),
    )
    try:
        record_of(record.model_dump_json(), job.kind)
    except ValidationError as error:  # a number that is not finite, where there must be one
        wrong = error.errors()[0]
        words = f"its results cannot be stored: {'.'.join(map(str, wrong['loc']))}: {wrong['msg']}"
        failed = {"result": None, "status": "failed", "reason": words, **traces(folder)}
        record = record.model_copy(update=failed)
    return record


def _follow(stop: Stop, lease: Lease) -> None:
    """Renew the lease; stop, as on SIGTERM, once the parent process has died; end once the lease is lost."""
    parent = os.getppid()

    def watch() -> None:
        beat = time.monotonic()
        while os.getppid() == parent:
            time.sleep(0.5)
            if time.monotonic() - beat > BEAT:
                beat = time.monotonic()
                try:
                    lease.renew()
                except Lost:
                    print("bench: another process took this job over", flush=True)
                    os._exit(BUSY)
                except OSError:  # the disk is away: the lease expires if that lasts
                    pass
        if stop.deferred:
            stop.requested.set()
            time.sleep(GRACE_SECONDS)
        for child in psutil.Process().children(recursive=True):  # programs lead groups of their own
            with suppress(psutil.Error):
                child.kill()
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)  # with all that the method started
        os._exit(STOPPED)

    threading.Thread(target=watch, daemon=True).start()


def end(code: int) -> NoReturn:
    """End a worker whose record is written; taking libraries down would take up to two seconds more."""
    sys.stdout.flush()
    sys.stderr.flush()
    ctypes.CDLL(None).fflush(None)  # what libraries have printed
    os._exit(code)


if __name__ == "__main__":
    end(main(Path(sys.argv[1]).resolve()))
