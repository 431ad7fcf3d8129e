"""Runs a plan on this machine: one job after the other, each in a process of its own."""

from __future__ import annotations

import os
import shutil
import signal
import site
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import Timeout

from bench.display import Display
from bench.limits import Limits, finished_here, memory_reason, time_reason, used_memory
from bench.plan import Planner
from bench.processes import Process, Processes, end_session
from bench.provenance import imports_torch
from bench.records import Job, Record, Status, Task
from bench.store import Store, write_text
from bench.timing import available_cores
from bench.worker import BUSY, STOPPED, log_tail, now, read_progress, traces

POLL_SECONDS = 0.1
GRACE_SECONDS = 60.0
EXIT_SECONDS = 5.0
"""How long a worker may take to exit once its record is written."""
LOOK_PAUSE = 50.0
"""Looks at memory take this part of the time: they must not slow down what is timed."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "ECONGS_THREADS")


@dataclass
class Outcome:
    """Records of the plan's jobs, of this run and of earlier ones.

    Attributes:
        ran: ids of the jobs that this run executed.
        unfinished: ids of jobs without a record.
        stopped: a signal ended the run.
    """

    records: list[Record] = field(default_factory=list)
    ran: list[str] = field(default_factory=list)
    unfinished: list[str] = field(default_factory=list)
    stopped: bool = False

    @property
    def failed(self) -> list[Record]:
        return [record for record in self.records if not record.ok]


class LocalExecutor:
    """Runs the jobs of a planner into a store.

    A first SIGINT or SIGTERM asks the running job to checkpoint and ends the run. A second one kills the job.
    Finished jobs stay finished.

    Args:
        retry: run failed jobs again.
        limits: of each job; default: those of :mod:`bench.limits`.
        plugins: plugin folders for the workers.
        threads: most threads of a job; default: a thread per core.
    """

    def __init__(
        self,
        store: Store,
        planner: Planner,
        display: Display,
        *,
        retry: bool = False,
        limits: Limits | None = None,
        plugins: tuple[str, ...] = (),
        threads: int | None = None,
    ) -> None:
        self._store = store
        self._planner = planner
        self._display = display
        self._retry = retry
        self._limits = limits or Limits()
        self._memory = self._limits.bytes()
        self._past = finished_here(store)
        self._plugins = plugins
        self._threads = min(available_cores(), threads or available_cores())
        self._processes = Processes(self._environment())
        self._signals = 0
        self._attempted: set[str] = set()

    def run(self) -> Outcome:
        """Run every job that is not finished yet; the failure of one does not end the run."""
        outcome = Outcome()
        before = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            self._store.sweep()
            with self._processes.adopting():
                while self._pass(outcome) and not self._signals:
                    pass
        finally:
            self._processes.close()
            for number, handler in before.items():
                signal.signal(number, handler)
        outcome.stopped = bool(self._signals)
        jobs = self._planner.jobs(self._store)
        results = [(job, self._store.record(job.id)) for job in jobs]
        outcome.records = [record for _, record in results if record is not None]
        outcome.unfinished = [job.id for job, record in results if record is None]
        return outcome

    def _on_signal(self, number: int, frame: Any) -> None:
        self._signals += 1

    # ------------------------------------------------------------------ the graph

    def _pass(self, outcome: Outcome) -> bool:
        """Go once through the plan; True if it must be planned again."""
        jobs = self._planner.jobs(self._store)
        for number, job in enumerate(jobs, 1):
            if self._signals:
                return False
            if self._is_final(job):
                continue
            records = {need: self._store.record(need) for need in job.needs}
            if any(record is None for record in records.values()):
                continue
            self._attempted.add(job.id)
            cause = next((record for record in records.values() if record and not record.ok), None)
            if cause is not None:
                record = self._give_up(job, cause)
            elif note := self._without_files(records.values(), number, len(jobs)):
                self._display.begin(job, number, len(jobs))
                self._display.end(job, None, note)
                continue
            else:
                if job.kind == "views" and any(map(self._forks, jobs)):
                    self._processes.prepare()  # views are not timed: its imports may run beside
                self._display.begin(job, number, len(jobs))
                record, note = self._run_job(job)
                if record is not None:
                    self._past.add(self._store, record)
                self._display.end(job, record, note)
                outcome.ran.append(job.id)
            if record is not None and job.kind == "partition":
                return True
        # A rung on which a method broke is repeated with further seeds.
        known = {job.id for job in jobs}
        return any(job.id not in known for job in self._planner.jobs(self._store))

    def _without_files(self, needs: Iterable[Record | None], number: int, total: int) -> str:
        """Why a job cannot run: records that it needs came without their files. Views are rendered again."""
        for record in needs:
            if record is None or self._store.holds_files_of(record):
                continue
            if record.job.kind == "views":
                self._display.begin(record.job, number, total)
                attempt, note = self._run_job(record.job)
                success = self._store.holds_files_of(record)
                self._display.end(record.job, attempt if success else None, note)
                if success:
                    continue
                reason = (log_tail(self._store.partial / record.job.id) or "stopped").splitlines()[-1]
                return f"not run: the views cannot be made again: {reason}"
            return (
                f"not run: {record.job.id} came from a bundle, without the files that this needs; "
                "run into a new store (--out) and join the two (bench merge)"
            )
        return ""

    def _is_final(self, job: Job) -> bool:
        """Whether a job has a record and is not to run again."""
        if job.id in self._attempted:
            return True
        record = self._store.record(job.id)
        if record is None or record.ok:
            return record is not None
        if record.cause is not None:  # the job never ran, and the cause may be mended
            cause = self._store.record(record.cause)
            if cause is None or cause.ok or cause.finished > record.finished:
                return False
        return not self._retry

    def _give_up(self, job: Job, cause: Record) -> Record | None:
        """A record for a job that cannot run because a job that it needs failed."""
        record = Record(
            job=job,
            status=cause.status,
            reason=cause.reason if cause.cause else f"{cause.job.kind}: {cause.reason}",
            cause=cause.cause or cause.job.id,
            stage=cause.stage,
            iteration=cause.iteration,
            started=now(),
            finished=now(),
            wall_seconds=0.0,
            provenance=cause.provenance,
        )
        try:
            with self._store.lock(job.id).acquire(timeout=0):
                folder = self._store.partial / job.id
                shutil.rmtree(folder, ignore_errors=True)
                self._store.finish(record)
        except Timeout:
            return None
        return record

    # ------------------------------------------------------------------ one job

    def _run_job(self, job: Job) -> tuple[Record | None, str]:
        """Run one job to its record; without one, the note says why."""
        while True:
            code, verdict = self._attempt(job)
            if code != BUSY or self._signals:
                break
            self._display.state({"stage": "another run works on it"})
            self._wait_for(job)
            if (record := self._store.record(job.id)) is not None:
                return record, "by another run"
        record = self._store.record(job.id)
        if record is not None:
            return record, ""
        if code == STOPPED or self._signals:
            return None, "stopped; resumes from its last checkpoint"
        try:
            with self._store.lock(job.id).acquire(timeout=5):
                return self._post_mortem(job, code, verdict), ""
        except Timeout:
            return None, "another run took it over"

    def _attempt(self, job: Job) -> tuple[int, tuple[Status, str] | None]:
        """Start a worker and watch it: its exit code, and status and reason if this program ended it."""
        folder = self._store.partial / job.id
        previous = self._store.record(job.id)
        if previous is not None and not previous.ok:
            with self._store.lock(job.id):
                self._store.reopen(previous)
        task = Task(job=job, plugins=self._plugins, threads=self._threads)
        self._started = time.time()
        try:
            folder.mkdir(exist_ok=True)
            write_text(folder / "job.json", task.model_dump_json(indent=1) + "\n")
            log = (folder / "log.txt").open("ab")
        except FileNotFoundError:  # another run has just renamed the folder in place
            return BUSY, None
        with log:
            start = self._processes.fork if self._forks(job) else self._processes.start
            process = start(folder, log)
        try:
            return self._watch(process, job)
        finally:
            if process.poll() is None:
                _kill(process)
            # Before the next job: what is left may hold its locks and take its time.
            if names := self._processes.end_leftovers():
                self._log(job, f"ended what the job left behind: {', '.join(names)}")

    def _forks(self, job: Job) -> bool:
        """Whether a job is forked from the server: its method uses torch, on the CPU."""
        if job.method is None or job.device != "cpu" or sys.platform != "linux":
            return False
        return imports_torch(*self._planner.registry.spec(job.method).source)

    def _watch(self, process: Process, job: Job) -> tuple[int, tuple[Status, str] | None]:
        folder = self._store.partial / job.id
        spec = self._planner.registry.spec(job.method) if job.method is not None else None
        limit = self._limits.time(job, self._past, spec)
        offset = 0
        start: float | None = None
        stop_time: float | None = None
        end_time: float | None = None
        look_time = 0.0
        while (code := process.poll()) is None:
            states, offset = read_progress(folder, offset)
            for state in states:
                if state["time"] < self._started:
                    continue  # from an earlier attempt
                if state.get("waiting") is False:
                    start = time.monotonic()
                self._display.state(state)
            if self._signals:
                if stop_time is None:
                    stop_time = time.monotonic()
                    process.send_signal(signal.SIGTERM)
                    self._display.state({"stage": "stopping (again to kill)"})
                elif self._signals > 1 or time.monotonic() - stop_time > GRACE_SECONDS:
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
                look = time.monotonic()
                used = used_memory(process.pid, self._memory.amount)
                look_time = time.monotonic() + LOOK_PAUSE * (time.monotonic() - look)
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

    def _post_mortem(self, job: Job, code: int, verdict: tuple[Status, str] | None) -> Record:
        """A record for a job whose process died without writing one."""
        folder = self._store.partial / job.id
        if (folder / "record.json").is_file():
            self._store.put_in_place(folder, job.id)
            record = self._store.record(job.id)
            assert record is not None
            return record
        if verdict is None and code < 0:
            verdict = ("failed", f"killed by signal {-code} ({signal.Signals(-code).name})")
        status, reason = verdict or ("failed", f"its process ended with exit code {code}")
        record = Record(
            job=job,
            status=status,
            reason=reason,
            started=now(),
            finished=now(),
            wall_seconds=time.time() - self._started,
            **traces(folder),
        )
        self._store.finish(record)
        return record

    def _wait_for(self, job: Job) -> None:
        while not self._signals:
            try:
                with self._store.lock(job.id).acquire(timeout=0):
                    return
            except Timeout:
                time.sleep(POLL_SECONDS)

    def _environment(self) -> dict[str, str]:
        """The worker's: pinned threads, and this very package before any other of its name."""
        environment = dict(os.environ)
        environment.update(dict.fromkeys(THREAD_VARIABLES, str(self._threads)))
        # Spinning OpenMP threads take the cores from the native kernels' own threads: an iteration of
        # 3DGS took 75 to 180 ms instead of 18 on a busy machine.
        environment.setdefault("OMP_WAIT_POLICY", "passive")
        environment["PYTHONSAFEPATH"] = "1"
        root = str(Path(__file__).resolve().parent.parent)
        if root not in site.getsitepackages():
            environment["PYTHONPATH"] = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
        return environment


def _kill(process: Process) -> None:
    """End a worker and all that it started."""
    end_session(process.pid)
    process.wait()
