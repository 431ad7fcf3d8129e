"""What runs in a Dask worker: it runs one job at a time, in a process of its own, on cores of its own.

A worker takes as many cores as it has threads, and pins its jobs to them. Where its machine has fewer left,
it runs on all of them, and its timed jobs take turns with those of others.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from distributed import Worker, WorkerPlugin, get_worker

from econgs_bench.bench.machine.cores import claim_cores
from econgs_bench.bench.machine.timing import available_cores
from econgs_bench.bench.run.limits import Limit, Limits
from econgs_bench.bench.run.runner import Runner
from econgs_bench.bench.store.leases import Held
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError
from econgs_bench.methods.registry import Registry

SLOT = "bench"
"""Resource of which every worker has one, and every job takes one."""
VISIBLE_SECONDS = 90.0
"""How long a network file system may hide from one node what another one has written."""
_POLL_SECONDS = 0.2


@dataclass(frozen=True)
class Order:
    """A job, and how to run it.

    Attributes:
        run: name of the run that wants it.
        root: folder of the store.
        threads: most threads.
        limit: of its time.
        limits: of the run.
        replaces: when the record ended that the job is to replace; "" for none.
    """

    job: Job
    run: str
    root: Path
    plugins: tuple[str, ...]
    threads: int | None
    limit: Limit
    limits: Limits
    replaces: str


@dataclass(frozen=True)
class Reply:
    """How an order ended.

    Attributes:
        recorded: the job has a record.
        note: why there is no record, or what is to be said about it.
    """

    recorded: bool
    note: str


class Node(WorkerPlugin):
    """Makes a Dask worker run jobs; there is one in each process.

    It declares resources, as far as the worker does not: a slot, the cores that it has as threads, the memory
    of its limit. A GPU is declared by whoever starts the worker.
    """

    name = "econgs-bench"

    async def setup(self, worker: Worker) -> None:
        """Take cores and declare resources; called again for every run."""
        global _state
        if _state is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the run, which stops the jobs
            _forget_nanny()
            _state = _State(worker.state.nthreads, worker.memory_manager.memory_limit)
        declared = {SLOT: 1.0, "cores": float(worker.state.nthreads)}
        if _state.memory is not None:
            declared["memory"] = float(_state.memory)
        await worker.set_resources(**{**declared, **worker.state.total_resources, SLOT: 1.0})


class _State:
    """What a worker holds from one order to the next.

    Attributes:
        memory: its limit in bytes; None: that of the machine.
        cores: to which its jobs are pinned; None: it found too few.
        stops: run -> how often it was asked to stop.
    """

    def __init__(self, threads: int, memory: int | None) -> None:
        self._stack = ExitStack()
        self._turn = threading.Lock()
        self._runner: Runner | None = None
        self._kind: tuple[Any, ...] = ()
        self.memory = memory
        self.cores = claim_cores(threads, self._stack)
        self.stops: Counter[str] = Counter()

    def run(self, order: Order) -> Reply:
        with self._turn:
            if self.stops[order.run]:
                return Reply(False, "stopped")
            if not (order.root / "store.json").is_file():
                where = f"a worker on {os.uname().nodename}"
                raise DataError(
                    order.root, f"is not seen by {where}", "Give --out a folder that all nodes share"
                )
            store = Store(order.root, checked=True)
            for need in order.job.needs:
                visible_record(store, need)
            if self.cores is not None:
                os.sched_setaffinity(0, self.cores)  # of this thread, and of what it starts
            try:
                record, note = self._runner_of(order, store).run(order.job, order.limit, order.replaces)
            except Held:
                return Reply(False, "another run works on it")
            return Reply(record is not None, note)

    def _runner_of(self, order: Order, store: Store) -> Runner:
        """The runner of a run: that of the order before, if it is of the same one."""
        kind = (order.run, order.root, order.plugins, order.threads, order.limits)
        if self._runner is None or kind != self._kind:
            if self._runner is not None:
                self._runner.__exit__()
            self._runner = Runner(
                store,
                Registry(order.plugins),
                order.limits.bytes(self.memory),
                plugins=order.plugins,
                threads=min(available_cores(), order.threads or available_cores()),
                alone=self.cores is None,
                stops=lambda: self.stops[order.run],
                show=lambda job, state: None,
            ).__enter__()
            self._kind = kind
        return self._runner


_state: _State | None = None


def run_order(order: Order) -> Reply:
    """Run a job in this Dask worker.

    Raises:
        DataError: the worker does not see the store.
    """
    if _state is None:
        raise RuntimeError(f"worker {get_worker().name} has not been set up")
    return _state.run(order)


def stop_run(run: str) -> None:
    """Ask the job of a run to stop: once, to checkpoint; twice, it is killed."""
    if _state is not None:
        _state.stops[run] += 1


def visible_record(store: Store, job: str) -> Record | None:
    """The record of a job that another node has finished, as soon as it is seen here; else None."""
    end = time.monotonic() + VISIBLE_SECONDS
    while (record := store.record(job)) is None and time.monotonic() < end:
        with suppress(OSError):
            os.listdir(store.jobs)  # has the folder looked at anew
        time.sleep(_POLL_SECONDS)
    return record


def _forget_nanny() -> None:
    """Drop variables that Dask sets for its own memory and that would change how jobs run."""
    own = {name: str(value) for name, value in dask.config.get("distributed.nanny.pre-spawn-environ").items()}
    for name, value in (own | {"PYTHONHASHSEED": "6640"}).items():
        if os.environ.get(name) == value:
            del os.environ[name]
