"""How busy this machine is, and what holds its processor back: facts for ``bench doctor``."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from econgs_bench.bench.machine.locks import locked
from econgs_bench.bench.machine.timing import lap_seconds
from econgs_bench.reports.clocks import BUSY

IDLE_SECONDS = 1.0
"""Time for which this process sleeps, so that all work is that of others."""
LAP_SECONDS = 2.0
"""Time for which the reference kernel runs again and again."""
LEAST_CORES = 0.05
"""Share of a core from which another process is named."""


@dataclass(frozen=True)
class Load:
    """What others take from this machine.

    Attributes:
        cores: cores that this process may use.
        foreign: how many of them others used while this process slept.
        users: other processes with the cores that each used, the busiest first.
        average: load average of the last minute; None where the system has none.
        laps: seconds of successive runs of the reference kernel; none without the native core.
        locked: whether a timed job of a run holds this machine's lock; then there are no laps either.
    """

    cores: int
    foreign: float
    users: tuple[tuple[str, float], ...] = ()
    average: float | None = None
    laps: tuple[float, ...] = ()
    locked: bool = False

    @property
    def quantiles(self) -> tuple[float, float, float]:
        """Quantiles 5, 50 and 95 % of the laps in seconds; NaN without laps."""
        low, middle, high = np.quantile(self.laps or (math.nan,), (0.05, 0.5, 0.95)).tolist()
        return low, middle, high

    @property
    def slowdown(self) -> float:
        """Time of the kernel here / on the quiet machine, the larger of two estimates.

        One is the ratio of the laps' quantiles 95 % and 5 %. The other recognises a machine that is busy all
        the time: a kernel of one thread per core shares the cores evenly with what others run.
        """
        low, _, high = self.quantiles
        return max(high / low if self.laps else 1.0, 1.0 + self.foreign / self.cores)

    @property
    def busy(self) -> bool:
        """Whether times measured now would be disturbed (:mod:`.reports.clocks`)."""
        return self.locked or self.slowdown > BUSY


def measure_load() -> Load:
    """Sleep, then run the reference kernel, each for a while; timed jobs of runs are not disturbed."""
    from econgs_bench.bench.machine.timing import available_cores

    cores = available_cores()
    foreign, users = _others(cores)
    average = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    try:
        with locked("timing", wait=False):
            return Load(cores, foreign, users, average, _laps())
    except BlockingIOError:
        return Load(cores, foreign, users, average, locked=True)


def _laps() -> tuple[float, ...]:
    laps: list[float] = []
    lap_seconds()  # starts the threads
    end = time.perf_counter() + LAP_SECONDS
    while time.perf_counter() < end:
        seconds = lap_seconds()
        if seconds is None:
            break
        laps.append(seconds)
    return tuple(laps)


def _others(cores: int) -> tuple[float, tuple[tuple[str, float], ...]]:
    """Cores that others use, as the system counts them, and by process as far as they are visible."""
    processes, before = _by_process(), _idle_seconds()
    start = time.perf_counter()
    time.sleep(IDLE_SECONDS)
    seconds = time.perf_counter() - start
    idle = sum(_idle_seconds()) - sum(before)
    now = _by_process()
    used = {
        pid: (name, (time - processes[pid][1]) / seconds)
        for pid, (name, time) in now.items()
        if pid in processes
    }
    users = sorted((user for user in used.values() if user[1] >= LEAST_CORES), key=lambda user: -user[1])
    return min(max(cores - idle / seconds, 0.0), float(cores)), tuple(users)


def _idle_seconds() -> list[float]:
    """Idle time of each core that this process may use."""
    every = psutil.cpu_times(percpu=True)
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(len(every))
    return [core.idle + getattr(core, "iowait", 0.0) for i, core in enumerate(every) if i in usable]


def _by_process() -> dict[int, tuple[str, float]]:
    """Process id -> name and CPU seconds so far, of all others."""
    times: dict[int, tuple[str, float]] = {}
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if process.pid != os.getpid():
                spent = process.cpu_times()
                times[process.pid] = (process.name(), spent.user + spent.system)
    return times


def clock_cap(root: Path = Path("/sys/devices/system/cpu")) -> tuple[float, float] | None:
    """Highest clock that the system permits and that of the processor in Hz, of the slowest core.

    None where the first is not below the second, or the system does not show them.
    """
    caps = []
    for folder in root.glob("cpu[0-9]*/cpufreq"):
        with suppress(OSError, ValueError):
            names = ("scaling_max_freq", "cpuinfo_max_freq")
            permitted, highest = (1e3 * int((folder / name).read_text(encoding="ascii")) for name in names)
            if permitted < highest:
                caps.append((permitted, highest))
    return min(caps, default=None)


def user_text(users: Sequence[tuple[str, float]]) -> str:
    """The three busiest processes: "python 1.9, cc1plus 0.5"."""
    return ", ".join(f"{name} {cores:.1f}" for name, cores in users[:3])
