"""Runs a plan on a cluster: each job is a task of Dask, which a worker runs in a process of its own.

The run walks the plan and submits jobs whose needs have records, as many at a time as there are workers. All
else goes through the store, on a folder that the nodes share: states of jobs, their records, and the leases
that keep two processes from one job. So records count whoever wrote them, and a run that died is resumed by
another one.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, KilledWorker, LocalCluster
from distributed.security import Security

from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.machine.timing import available_cores
from econgs_bench.bench.plan.estimates import Past
from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.run.display import Display
from econgs_bench.bench.run.executor import Ending, Executor
from econgs_bench.bench.run.limits import available_memory
from econgs_bench.bench.run.node import SLOT, Node, Order, Reply, run_order, stop_run, visible_record
from econgs_bench.bench.run.request import Execution
from econgs_bench.bench.run.runner import finish_dead
from econgs_bench.bench.run.worker import GRACE_SECONDS
from econgs_bench.bench.store.leases import Held
from econgs_bench.bench.store.progress import read_progress
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError

POLL_SECONDS = 0.5
LOOK_SECONDS = 1.0
"""Between looks at the store and at the workers."""
_NO_PAGES: dict[str, list[str]] = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
"""Pages of schedulers and workers show logs and settings to whoever reaches their ports."""
REPLY_SECONDS = 30.0
"""How long a worker may keep its reply once the record of its job is there."""


@dataclass
class _Flight:
    """A job that was given to the cluster.

    Attributes:
        future: None once Dask has answered without a record: another process works on the job.
        before: when an earlier record of the job was finished, which failed.
        offset: bytes of its progress that were read.
        begun: how often a worker began it since its last checkpoint.
        seen: when its record was seen, by this process's clock.
    """

    job: Job
    before: str
    start: float
    offset: int
    begun: int = 0
    future: Future | None = None
    seen: float | None = None


class DaskExecutor(Executor):
    """Runs the jobs on workers of Dask, beside each other.

    Args:
        plugins: plugin folders for the workers.
        threads: most threads of a job; default: as many as its worker has.
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
        super().__init__(store, planner, display, Past([store]), execution)
        self._scheduler, self._count = execution.scheduler, execution.workers or 1
        self._plugins = plugins
        self._threads = threads
        self._name = uuid.uuid4().hex[:8]
        self._most = 1 + int(dask.config.get("distributed.scheduler.allowed-failures"))
        self._flights: dict[str, _Flight] = {}
        self._replies: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._look_time = 0.0
        self._workers_here: dict[str, Any] = {}
        self._noted = ""
        self._stops_sent = 0
        self._stop_time = 0.0

    # ------------------------------------------------------------------ the cluster

    @contextmanager
    def _workers(self) -> Iterator[None]:
        with ExitStack() as stack:
            self._client = stack.enter_context(self._connected(stack))
            try:
                self._client.register_plugin(Node())
            except Exception as error:
                raise DataError(
                    self._place,
                    f"its workers cannot run jobs ({error})",
                    "Start them where this version of econgs-bench is installed",
                ) from error
            self._look()
            yield

    @property
    def _place(self) -> str:
        return self._scheduler or "the cluster on this machine"

    def _connected(self, stack: ExitStack) -> Client:
        """A client of the scheduler, of one on this machine if none is named."""
        for name in ("distributed", "distributed.scheduler", "distributed.worker", "distributed.nanny"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        address: Any = self._scheduler
        named = Path(address).is_file()
        if not address:
            count = self._count
            stack.enter_context(dask.config.set(_NO_PAGES))
            address = stack.enter_context(
                LocalCluster(
                    n_workers=count,
                    threads_per_worker=max(1, available_cores() // count),
                    memory_limit=int(available_memory() / count),
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                    security=_secret(),
                )
            )
        try:
            return Client(**{"scheduler_file" if named else "address": address}, set_as_default=False)
        except (OSError, ValueError) as error:
            raise DataError(
                f"--scheduler {address}",
                "no scheduler answers there",
                "Start one (`dask scheduler`, or dask-jobqueue) and give the address that it prints",
            ) from error

    def _look(self) -> None:
        """Ask which workers there are, and note what keeps jobs waiting."""
        self._look_time = time.monotonic() + LOOK_SECONDS
        if self._client.status not in ("running", "connecting"):
            raise self._lost()
        if self._client.status == "running":
            self._workers_here = dict(self._client.scheduler_info()["workers"])
        note = ""
        for flight in self._flights.values():
            lacking = [
                f"{name}={amount:g}"
                for name, amount in self._resources(flight.job).items()
                if not any(one["resources"].get(name, 0) >= amount for one in self._workers_here.values())
            ]
            if flight.future is not None and lacking:
                note = "waiting for workers" + (f" with {', '.join(lacking)}" if self._workers_here else "")
        if note and note != self._noted:
            self._display.note(note)
        self._noted = note

    def _lost(self) -> DataError:
        return DataError(
            self._place, "the scheduler is gone", "Start one, and run the same command again to resume"
        )

    # ------------------------------------------------------------------ jobs

    def _has_room(self) -> bool:
        return len(self._running) < max(1, len(self._workers_here))

    def _start(self, job: Job) -> None:
        record = self._store.record(job.id)
        progress = self._store.partial / job.id / "progress.jsonl"
        offset = progress.stat().st_size if progress.is_file() else 0
        flight = _Flight(job, record.finished if record else "", time.monotonic(), offset)
        self._flights[job.id] = flight
        self._submit(flight)

    def _submit(self, flight: _Flight) -> None:
        job = flight.job
        order = Order(
            job, self._name, self._store.root, self._plugins, self._threads, self._limit(job), self._limits,
            self._again.get(job.id, ""),
        )  # fmt: skip
        flight.future = self._client.submit(
            run_order,
            order,
            key=f"{job.id}-{uuid.uuid4().hex}",
            resources=self._resources(job),
            pure=False,
        )
        flight.future.add_done_callback(self._replies.put)

    def _resources(self, job: Job) -> dict[str, float]:
        """What a job needs of a worker; a worker has one slot, so it runs one job at a time."""
        needs: dict[str, float] = {SLOT: 1}
        if self._threads is not None:
            needs["cores"] = self._threads
        if isinstance(job, MethodJob) and job.device.startswith("cuda"):
            needs["GPU"] = 1
        if self._limits.memory is not None and self._limits.memory < float("inf"):
            needs["memory"] = self._limits.memory
        return needs

    def _endings(self) -> Iterable[Ending]:
        if self._signals > self._stops_sent:
            self._stop()
        endings = []
        try:
            future = self._replies.get(timeout=POLL_SECONDS)
            flight = next((one for one in self._flights.values() if one.future is future), None)
            if flight is not None and (ending := self._reply(flight, future)) is not None:
                endings.append(ending)
        except queue.Empty:
            pass
        if time.monotonic() > self._look_time:
            self._look()
            done = {ending.job.id for ending in endings}
            seen = [self._seen(flight) for name, flight in self._flights.items() if name not in done]
            endings += [ending for ending in seen if ending is not None]
        for ending in endings:
            del self._flights[ending.job.id]
        return endings

    def _reply(self, flight: _Flight, future: Future) -> Ending | None:
        """What a task that has ended says; None: its job goes on elsewhere, or must be submitted again."""
        job = flight.job
        flight.future = None
        if future.status == "error":
            error = future.exception()
            if isinstance(error, DataError):
                raise error
            if isinstance(error, KilledWorker):
                flight.begun += 1  # also where none began it
                return None
            return Ending(job, None, f"not run: {type(error).__name__}: {error}")
        if future.status != "finished":
            if self._signals:
                return Ending(job, None, "stopped")
            raise self._lost()
        reply: Reply = future.result()
        if reply.recorded:
            return Ending(job, visible_record(self._store, job.id), reply.note)
        if self._signals:
            return Ending(job, None, reply.note)
        self._display.state(job, {"stage": reply.note})
        return None

    def _seen(self, flight: _Flight) -> Ending | None:
        """What the store says about a job under way; None: it goes on."""
        job = flight.job
        folder = self._store.partial / job.id
        states, flight.offset = read_progress(folder, flight.offset)
        for state in states:
            flight.begun = 0 if state.get("stored") else flight.begun + (state.get("waiting") is False)
            self._display.state(job, state)
        record = self._store.record(job.id)
        if record is not None and record.finished != flight.before:
            # Of a worker that hangs, or of another run.
            flight.seen = flight.seen or time.monotonic()
            if flight.future is None or time.monotonic() - flight.seen > REPLY_SECONDS:
                return Ending(job, record, "by another run" if flight.future is None else "")
        elif flight.future is None and not self._signals and not self._store.lease(job.id).is_held:
            if flight.begun >= self._most:
                return Ending(job, self._dead(flight))
            self._submit(flight)
        if self._stops_sent and (flight.future is None or time.monotonic() - self._stop_time > GRACE_SECONDS):
            return Ending(job, None, "stopped")
        return None

    def _dead(self, flight: _Flight) -> Record | None:
        """The record of a job that took its workers down."""
        try:
            with self._store.lease(flight.job.id).acquire(timeout=0) as lease:
                seconds = time.monotonic() - flight.start
                reason = f"killed with its worker {self._most} times or more, without a checkpoint between"
                return finish_dead(self._store, flight.job, "failed", reason, seconds, lease)
        except Held:
            return None

    def _stop(self) -> None:
        """Tell the workers of a signal; what none has begun is taken back."""
        self._stops_sent += 1
        self._stop_time = time.monotonic()
        threading.Thread(target=self._tell, daemon=True).start()
        for flight in self._flights.values():
            self._display.state(flight.job, {"stage": "stopping (again to kill)"})
            if flight.future is not None and not self._workers_here:
                flight.future.cancel()

    def _tell(self) -> None:
        """Ask all workers to stop the jobs of this run; one that hangs may not answer in time."""
        with suppress(Exception):
            self._client.run(stop_run, self._name, on_error="ignore")


def _secret() -> Security:
    """A key and a certificate of this run alone: who lacks them can give its workers no orders.

    Other users of a machine reach its ports, and whoever talks to a scheduler runs programs as its owner.

    Raises:
        DataError: the package that makes them is missing.
    """
    try:
        secret: Security = Security.temporary()
        return secret
    except ImportError as error:
        remedy = "pip install 'econgs-bench[cluster]'"
        raise DataError("--executor dask", f"needs the package cryptography ({error})", remedy) from error
