"""Runs single jobs on this machine, each in a process of its own."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Self

from econgs_bench.bench.jobs.context import SCRATCH
from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.machine.provenance import imports_torch
from econgs_bench.bench.run.limits import Limit, memory_reason, time_reason, used_memory
from econgs_bench.bench.run.processes import Process, Processes, end_session
from econgs_bench.bench.run.worker import BUSY, GRACE_SECONDS, STOPPED
from econgs_bench.bench.store.leases import Held, Lease
from econgs_bench.bench.store.progress import log_tail, now, read_progress, traces
from econgs_bench.bench.store.records import Job, Record, Status, Task
from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.methods.registry import Registry

POLL_SECONDS = 0.1
EXIT_SECONDS = 5.0
"""How long a worker may take to exit once its record is written."""
LOOK_PAUSE = 50.0
"""Looks at memory take this part of a processor's time: they must not slow down what is timed.

By the clock, a look on a busy machine would put off the next one for many seconds.
"""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "ECONGS_THREADS")


class Runner:
    """Runs jobs one after the other; open as a context.

    Args:
        store: where they are.
        registry: the methods.
        memory: limit of any job's memory.
        plugins: plugin folders for the workers.
        threads: of a job.
        alone: timed jobs have the machine to themselves; else they run beside jobs on other cores.
        stops: how often the run was asked to stop: once, the job is to checkpoint; twice, it is killed.
        show: takes the states of a job.
    """

    def __init__(
        self,
        store: Store,
        registry: Registry,
        memory: Limit,
        *,
        plugins: tuple[str, ...],
        threads: int,
        alone: bool = True,
        stops: Callable[[], int],
        show: Callable[[Job, dict[str, Any]], None],
    ) -> None:
        self._store = store
        self._registry = registry
        self._memory = memory
        self._plugins = plugins
        self._threads = threads
        self._alone = alone
        self._stops = stops
        self._show = show
        self._processes = Processes(_environment(threads))
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(self._processes.adopting())
        self._stack.callback(self._processes.close)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, job: Job, limit: Limit, replaces: str = "") -> tuple[Record | None, str]:
        """Run one job to its record; without one, the note says why.

        Args:
            job: whose needs have records.
            limit: of its time.
            replaces: when the record ended that this run is to replace, by success alone; "" for none.

        Raises:
            Held: another process works on it.
            DataError: the run store was removed meanwhile.
        """
        try:
            return self._run(job, limit, replaces)
        except FileNotFoundError:
            self._store.check()
            raise

    def _run(self, job: Job, limit: Limit, replaces: str) -> tuple[Record | None, str]:
        code, verdict = self._attempt(job, limit, replaces)
        if code == BUSY and not self._stops() and not self._died(job):
            raise Held(job.id)
        record = self._store.record(job.id)
        if record is not None and record.finished != replaces:
            return record, ""
        if code == STOPPED or self._stops():
            return None, "stopped; resumes from its last checkpoint"
        try:
            with self._store.lease(job.id).acquire(timeout=5) as lease:
                if record is not None:
                    return record, self._in_vain(job, code, verdict)
                return self._post_mortem(job, code, verdict, lease), ""
        except Held:
            return None, "another run took it over"

    def _died(self, job: Job) -> bool:
        """Whether a job began in the last attempt and nobody works on it: a method may exit with any code."""
        if self._store.lease(job.id).is_held:
            return False
        states, _ = read_progress(self._store.partial / job.id)
        return any(state["time"] >= self._started and state.get("waiting") is False for state in states)

    def prepare(self) -> None:
        """Start the server that workers are forked from; its imports go on after the return."""
        self._processes.prepare()

    def forks(self, job: Job) -> bool:
        """Whether a job is forked from the server: its method uses torch, on the CPU."""
        if not isinstance(job, MethodJob) or job.device != "cpu" or sys.platform != "linux":
            return False
        return imports_torch(*self._registry.spec(job.method).source)

    def _in_vain(self, job: Job, code: int, verdict: tuple[Status, str] | None) -> str:
        """Note on a finished job that failed when it ran again; what it left is removed."""
        folder = self._store.partial / job.id
        tail = (log_tail(folder) or f"exit code {code}").splitlines()[-1]
        shutil.rmtree(folder, ignore_errors=True)
        return f"failed when it ran again ({verdict[1] if verdict else tail}); its earlier record stays"

    def _attempt(self, job: Job, limit: Limit, replaces: str) -> tuple[int, tuple[Status, str] | None]:
        """Start a worker and watch it: its exit code, and status and reason if this program ended it."""
        folder = self._store.partial / job.id
        if self._store.record(job.id) is not None:
            with self._store.lease(job.id).acquire(timeout=0):
                previous = self._store.record(job.id)
                if previous is not None and not previous.ok:
                    self._store.reopen(previous)
        task = Task(
            job=job, plugins=self._plugins, threads=self._threads, alone=self._alone, replaces=replaces
        )
        self._started = time.time()
        try:
            folder.mkdir(exist_ok=True)
            write_text(folder / "job.json", task.model_dump_json(indent=1) + "\n")
            log = (folder / "log.txt").open("ab")
        except FileNotFoundError:  # another run has just renamed the folder in place
            self._store.check()
            return BUSY, None
        with log:
            start = self._processes.fork if self.forks(job) else self._processes.start
            process = start(folder, log)
        try:
            return self._watch(process, job, limit)
        finally:
            if process.poll() is None:
                _kill(process)
            shutil.rmtree(folder / SCRATCH, ignore_errors=True)
            # Before the next job: what is left may take its time.
            if names := self._processes.end_leftovers():
                self._log(job, f"ended what the job left behind: {', '.join(names)}")

    def _watch(self, process: Process, job: Job, limit: Limit) -> tuple[int, tuple[Status, str] | None]:
        folder = self._store.partial / job.id
        offset = 0
        start: float | None = None
        stop_time: float | None = None
        end_time: float | None = None
        look_time = 0.0
        while (code := process.poll()) is None:
            states, offset = read_progress(folder, offset)
            for state in (one for one in states if one["time"] >= self._started):  # others: earlier attempts
                if state.get("waiting") is False:
                    start = time.monotonic()
                self._show(job, state)
            if self._stops():
                if stop_time is None:
                    stop_time = time.monotonic()
                    process.send_signal(signal.SIGTERM)
                    self._show(job, {"stage": "stopping (again to kill)"})
                elif self._stops() > 1 or time.monotonic() - stop_time > GRACE_SECONDS:
                    _kill(process)
                    return STOPPED, None
            elif not folder.exists():  # the record is written, and its folder renamed
                end_time = end_time or time.monotonic()
                if time.monotonic() - end_time > EXIT_SECONDS:
                    _kill(process)
                    self._log(job, f"ended {EXIT_SECONDS:g} s after its record was written: it did not exit")
                    return 0, None
            elif start is not None and time.monotonic() - start > limit.amount:
                _kill(process)
                return process.wait(), ("timeout", time_reason(limit))
            elif time.monotonic() >= look_time:
                look = time.thread_time()
                used = used_memory(process.pid, self._memory.amount)
                look_time = time.monotonic() + LOOK_PAUSE * (time.thread_time() - look)
                if used > self._memory.amount:
                    _kill(process)
                    return process.wait(), ("oom", memory_reason(self._memory, used))
            try:
                process.wait(POLL_SECONDS)
            except subprocess.TimeoutExpired:
                continue
        return code, None

    def _log(self, job: Job, text: str) -> None:
        """Add a line to a job's log, wherever that is by now."""
        for folder in (self._store.jobs / job.id, self._store.partial / job.id):
            if folder.is_dir():
                with (folder / "log.txt").open("a", encoding="utf-8") as log:
                    log.write(f"bench: {text}\n")
                return

    def _post_mortem(self, job: Job, code: int, verdict: tuple[Status, str] | None, lease: Lease) -> Record:
        """A record for a job whose process died without writing one."""
        if verdict is None and code < 0:
            verdict = ("failed", f"killed by signal {-code} ({signal.Signals(-code).name})")
        status, reason = verdict or ("failed", f"its process ended with exit code {code}")
        return finish_dead(self._store, job, status, reason, time.time() - self._started, lease)


def finish_dead(store: Store, job: Job, status: Status, reason: str, seconds: float, lease: Lease) -> Record:
    """The record of a job whose process is dead: its own, if it wrote one, or one of its failure."""
    folder = store.partial / job.id
    if (folder / "record.json").is_file():
        store.put_in_place(folder, job.id, lease)
        record = store.record(job.id)
        assert record is not None
        return record
    record = Record(
        job=job,
        status=status,
        reason=reason,
        started=now(),
        finished=now(),
        wall_seconds=seconds,
        **traces(folder),
    )
    store.finish(record, lease=lease)
    return record


def _environment(threads: int) -> dict[str, str]:
    """The workers': pinned threads, and nothing of the folder that they start in."""
    environment = dict(os.environ)
    environment.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    # Spinning OpenMP threads take the cores from the native kernels' own threads: an iteration of
    # 3DGS took 75 to 180 ms instead of 18 on a busy machine.
    environment.setdefault("OMP_WAIT_POLICY", "passive")
    environment["PYTHONSAFEPATH"] = "1"
    environment["PYTHONIOENCODING"] = "utf-8:backslashreplace"  # of logs, whatever this terminal has
    return environment


def _kill(process: Process) -> None:
    """End a worker and all that it started."""
    end_session(process.pid)
    process.wait()
