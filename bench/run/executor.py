"""Walks a plan: starts jobs whose needs have records, until nothing is left; on this machine, one by one."""

from __future__ import annotations

import shutil
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.machine.timing import available_cores
from econgs_bench.bench.plan.estimates import Past
from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.run.display import Display
from econgs_bench.bench.run.limits import Limit, finished_here
from econgs_bench.bench.run.request import Execution
from econgs_bench.bench.run.runner import POLL_SECONDS, Runner
from econgs_bench.bench.store.leases import Held
from econgs_bench.bench.store.progress import log_tail, now
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store

_HANGUP = getattr(signal, "SIGHUP", None)
"""None on Windows."""


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


def _stop_signals() -> list[int]:
    """Signals that end a run; `nohup` has hang-ups ignored."""
    stops: list[int] = [signal.SIGINT, signal.SIGTERM]
    if _HANGUP is not None and signal.getsignal(_HANGUP) != signal.SIG_IGN:
        stops.append(_HANGUP)
    return stops


class Ending(NamedTuple):
    """How a job ended: with a record, or with a note that says why there is none."""

    job: Job
    record: Record | None
    note: str = ""


class Executor(ABC):
    """Runs the jobs of a planner into a store.

    A first SIGINT, SIGTERM or SIGHUP (of a terminal that is gone) asks the running jobs to checkpoint and
    ends the run. A second one kills them. Finished jobs stay finished.

    Args:
        store: where the jobs go.
        planner: makes the plan; again after a partition, and for repeats of broken rungs.
        display: shows progress.
        past: finished jobs, from which limits of time follow.
        execution: finished jobs that run again, and limits of each job.
    """

    def __init__(
        self,
        store: Store,
        planner: Planner,
        display: Display,
        past: Past,
        execution: Execution,
    ) -> None:
        self._store = store
        self._planner = planner
        self._display = display
        self._past = past
        self._retry, self._limits = execution.retry, execution.limits
        self._signals = 0
        self._hung_up: int | None = None
        self._numbers: dict[str, int] = {}
        self._total = ""
        self._waiting: dict[str, Job] = {}
        self._running: dict[str, Job] = {}
        self._attempted: set[str] = set()
        self._restored: set[str] = set()
        self._again: dict[str, str] = {}

    @abstractmethod
    def _workers(self) -> AbstractContextManager[Any]:
        """What runs the jobs, for as long as the run lasts."""

    @abstractmethod
    def _has_room(self) -> bool:
        """Whether another job may be started beside the running ones."""

    @abstractmethod
    def _start(self, job: Job) -> None:
        """Start a job."""

    @abstractmethod
    def _endings(self) -> Iterable[Ending]:
        """Running jobs that have ended, after some wait; after a signal, in the end all."""

    def run(self) -> Outcome:
        """Run every job that is not finished yet; the failure of one does not end the run."""
        outcome = Outcome()
        before = {number: signal.signal(number, self._on_signal) for number in _stop_signals()}
        try:
            self._store.sweep()
            if self._retry == "busy":
                from econgs_bench.bench.results.disturbed import to_measure_again

                self._again = to_measure_again(self._store.records())
            with self._workers():
                self._walk(outcome)
        finally:
            for number, handler in before.items():
                # The second hang-up may come while the command ends.
                signal.signal(number, signal.SIG_IGN if number == self._hung_up else handler)
        outcome.stopped = bool(self._signals)
        jobs = self._planner.jobs(self._store)
        results = [(job, self._store.record(job.id)) for job in jobs]
        outcome.records = [record for _, record in results if record is not None]
        outcome.unfinished = [job.id for job, record in results if record is None]
        return outcome

    def _on_signal(self, number: int, frame: Any) -> None:
        if number == _HANGUP:
            self._hung_up = number
            if self._signals:  # shell and system may both send it
                return
        self._signals += 1

    def _walk(self, outcome: Outcome) -> None:
        self._plan()
        while True:
            if not self._signals:
                self._start_ready()
            if self._running:
                for ending in self._endings():
                    self._take(ending, outcome)
                continue
            # A rung on which a method broke is repeated with further seeds.
            known = set(self._numbers)
            if not self._signals:
                self._plan()
            if self._numbers.keys() <= known:
                return

    def _plan(self) -> None:
        """Make the plan, again if there is one; what runs goes on."""
        jobs = self._planner.jobs(self._store)
        self._numbers = {job.id: number for number, job in enumerate(jobs, 1)}
        total, more = self._planner.total(jobs, self._store)
        self._total = f"{total}{'+' if more else ''}"
        self._waiting = {job.id: job for job in jobs if not self._is_final(job)}

    def _start_ready(self) -> None:
        """Start jobs whose needs have records, as long as there is room."""
        for job in list(self._waiting.values()):
            if not self._has_room():
                return
            if any(need in self._waiting or need in self._running for need in job.needs):
                continue
            del self._waiting[job.id]
            if self._is_final(job):
                continue
            records = [self._store.record(need) for need in job.needs]
            needs = [record for record in records if record is not None]
            if len(needs) < len(records):
                continue
            cause = next((record for record in needs if not record.ok), None)
            if cause is not None:
                self._attempted.add(job.id)
                if self._give_up(job, cause) and job.kind == "partition":
                    return self._plan()
            elif (lack := next((r for r in needs if not self._store.holds_files_of(r)), None)) is None:
                self._attempted.add(job.id)
                self._begin(job)
            elif lack.job.kind == "views" and lack.job.id not in self._restored:
                self._waiting[job.id] = job
                self._restored.add(lack.job.id)
                self._begin(lack.job)
            else:
                self._attempted.add(job.id)
                self._announce(job)
                self._display.end(job, None, self._without_files(lack))
        return None

    def _begin(self, job: Job) -> None:
        self._running[job.id] = job
        self._announce(job)
        self._start(job)

    def _announce(self, job: Job) -> None:
        self._display.begin(job, self._numbers[job.id], self._total)

    def _take(self, ending: Ending, outcome: Outcome) -> None:
        """Take note of a job that has ended."""
        job, record, note = ending
        del self._running[job.id]
        if job.id in self._restored and job.id not in self._attempted:
            done = self._store.record(job.id)
            success = done is not None and self._store.holds_files_of(done)
            self._display.end(job, record if success else None, note)
            return
        if record is not None:
            self._past.add(self._store, record)
        self._display.end(job, record, note)
        outcome.ran.append(job.id)
        if record is not None and job.kind == "partition":
            self._plan()

    def _without_files(self, need: Record) -> str:
        """Why a job cannot run: a record that it needs came without its files."""
        if need.job.kind == "views":
            reason = (log_tail(self._store.partial / need.job.id) or "stopped").splitlines()[-1]
            return f"not run: the views cannot be made again: {reason}"
        return (
            f"not run: {need.job.id} came from a bundle, without the files that this needs; "
            "run into a new store (--out) and join the two (bench merge)"
        )

    def _is_final(self, job: Job) -> bool:
        """Whether a job has a record and is not to run again."""
        if job.id in self._attempted:
            return True
        record = self._store.record(job.id)
        if record is None or record.ok:
            return record is not None and record.finished != self._again.get(job.id)
        if record.cause is not None:  # the job never ran, and the cause may be mended
            cause = self._store.record(record.cause)
            if cause is None or cause.ok or cause.finished > record.finished:
                return False
        return self._retry not in (True, "failed")

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
            with self._store.lease(job.id).acquire(timeout=0) as lease:
                folder = self._store.partial / job.id
                shutil.rmtree(folder, ignore_errors=True)
                self._store.finish(record, lease=lease)
        except Held:
            return None
        return record

    def _limit(self, job: Job) -> Limit:
        """The limit of a job's time."""
        spec = self._planner.registry.spec(job.method) if isinstance(job, MethodJob) else None
        return self._limits.time(job, self._past, spec)


class LocalExecutor(Executor):
    """Runs the jobs on this machine, one after the other.

    Args:
        plugins: plugin folders for the workers.
        threads: most threads of a job; default: a thread per core.
    """

    def __init__(
        self,
        store: Store,
        planner: Planner,
        display: Display,
        execution: Execution,
        *,
        plugins: tuple[str, ...] = (),
        threads: int | None = None,
    ) -> None:
        super().__init__(store, planner, display, finished_here(store), execution)
        self._runner = Runner(
            store,
            planner.registry,
            self._limits.bytes(),
            plugins=plugins,
            threads=min(available_cores(), threads or available_cores()),
            stops=lambda: self._signals,
            show=display.state,
        )

    def _workers(self) -> Runner:
        return self._runner

    def _has_room(self) -> bool:
        return not self._running

    def _start(self, job: Job) -> None:
        if job.kind == "views" and any(map(self._runner.forks, self._waiting.values())):
            self._runner.prepare()  # views are not timed: its imports may run beside

    def _endings(self) -> Iterable[Ending]:
        (job,) = self._running.values()
        replaces = self._again.get(job.id, "")
        while True:
            try:
                return [Ending(job, *self._runner.run(job, self._limit(job), replaces))]
            except Held:
                self._display.state(job, {"stage": "another run works on it"})
            while not self._signals and self._store.lease(job.id).is_held:
                time.sleep(POLL_SECONDS)
            record = self._store.record(job.id)
            if record is not None and record.finished != replaces:
                return [Ending(job, record, "by another run")]
            if self._signals:
                return [Ending(job, None, "stopped; resumes from its last checkpoint")]
