"""How long a job may take and how much memory it may hold before it is ended.

The defaults end what hangs or fills the machine, never what is slow.

Time: :data:`TIMES` the median of jobs like it that finished here, at least :data:`LEAST_SECONDS`. Jobs like
it have its options. Of the committed records none takes 7 times what jobs like it take (tests hold that), and
a busy machine took 8 times as long as a quiet one. Without such jobs: a cap by preset, at least 50 times its
longest committed record.

Memory: :data:`SHARE` of the machine or control group, against what a job holds and the system cannot drop.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import psutil

from econgs_bench.bench.jobs.method import MethodJob
from econgs_bench.bench.machine.control_groups import memory_limit
from econgs_bench.bench.machine.provenance import machine_name
from econgs_bench.bench.plan.estimates import Past
from econgs_bench.bench.run.display import span
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store
from econgs_bench.methods.interface import MethodSpec

TIMES = 60.0
LEAST_SECONDS = 1800.0
HOUR = 3600.0
CAPS = {"quick": 8 * HOUR, "standard": 48 * HOUR}
LONGEST_CAP = 192 * HOUR
"""Of the preset paper, and of a suite's own presets."""
CAP_PIXELS = 256 * 256
SHARE = 0.95


@dataclass(frozen=True)
class Limit:
    """A limit of one job, in seconds or bytes, and where it comes from, for people."""

    amount: float
    origin: str


@dataclass(frozen=True)
class Limits:
    """What the command line says: None for the defaults, infinity for no limit.

    Attributes:
        seconds: of a job, without waiting for the machine.
        memory: bytes of a job with all its processes.
    """

    seconds: float | None = None
    memory: float | None = None

    def time(self, job: Job, past: Past, spec: MethodSpec | None) -> Limit:
        """The limit of a job's time."""
        if self.seconds is not None:
            return Limit(self.seconds, "--time-limit")
        # Views that the cache holds take no time: they say nothing about those that must be rendered.
        estimate = past.estimate(job, close=True) if job.kind != "views" else None
        if estimate is not None:
            seconds = TIMES * max(estimate.seconds, estimate.seconds_for(job))
            if seconds < LEAST_SECONDS:
                return Limit(LEAST_SECONDS, "the least default; --time-limit none lifts it")
            origin = f"{TIMES:g} times what jobs like it took here; --time-limit none lifts it"
            return Limit(seconds, origin)
        usual = spec.iterations.get(job.preset) if spec is not None else None
        iterations = job.iterations if isinstance(job, MethodJob) else None
        budgets = (iterations or 0) / usual if usual else 1.0
        larger = job.request.width * job.request.height / CAP_PIXELS
        cap = CAPS.get(job.preset, LONGEST_CAP) * max(len(job.scenes), budgets) * max(1.0, larger)
        return Limit(cap, f"the default of preset {job.preset}; --time-limit none lifts it")

    def bytes(self, granted: float | None = None) -> Limit:
        """The limit of any job's memory.

        Args:
            granted: bytes that the worker of a cluster may use; default: those of this machine.
        """
        if self.memory is not None:
            return Limit(self.memory, "--memory-limit")
        whose = "this machine's" if granted is None else "its Dask worker's"
        origin = f"{SHARE:.0%} of {whose} memory; --memory-limit none lifts it"
        return Limit(SHARE * (available_memory() if granted is None else granted), origin)


def finished_here(store: Store) -> Past:
    """The finished jobs of a store that ran on this machine."""

    def here(record: Record) -> bool:
        return record.provenance is not None and record.provenance.machine == machine_name()

    return Past([store], here)


def time_reason(limit: Limit) -> str:
    """Why a job was ended for its time."""
    return f"killed after its time limit of {span(limit.amount)} ({limit.origin})"


def memory_reason(limit: Limit, used: int) -> str:
    """Why a job was ended for its memory."""
    mib = 2**20
    return (
        f"killed over its memory limit: {used / mib:.0f} MiB of {limit.amount / mib:.0f} MiB ({limit.origin})"
    )


def used_memory(pid: int, limit: float) -> int:
    """Memory of a process and its descendants, in bytes; 0 once it is gone.

    Exact over ``limit`` only: there, shared pages count once, swapped pages count, and pages of files, which
    the system can drop, do not.
    """
    try:
        process = psutil.Process(pid)
        processes = [process, *process.children(recursive=True)]
        resident = sum(one.memory_info().rss for one in processes)
    except psutil.Error:
        return 0
    if resident <= limit:
        return resident
    exact = [_held(one.pid) for one in processes]
    return resident if None in exact else sum(filter(None, exact))


def _held(pid: int) -> int | None:
    """Bytes of a process that are neither another's nor a file's; None where the system does not say."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()[1:]
    except ProcessLookupError:  # it has ended, and waits for its parent to look
        return 0
    except OSError:
        return None if Path(f"/proc/{pid}").exists() else 0
    sizes = {name: int(rest.split()[0]) * 1024 for name, _, rest in (line.partition(":") for line in lines)}
    names = ("Pss_Anon", "Pss_Shmem", "SwapPss")
    return sum(sizes[name] for name in names) if all(name in sizes for name in names) else None


def available_memory() -> int:
    """Memory and swap of this machine, or what its control groups leave of them, in bytes."""
    memory, swap = psutil.virtual_memory().total, psutil.swap_memory().total
    granted = memory_limit()
    return memory + swap if granted is None else min(memory, granted) + swap
