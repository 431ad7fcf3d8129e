"""Times of what is compared, as Markdown.

What is compared runs in turns, so that other work on the machine slows all alike.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Time:
    """Milliseconds of some turns: median and shortest, and the least processor time of all threads."""

    median: float
    shortest: float
    cpu: float

    def __str__(self) -> str:
        digits = 2 if self.median < 2 else 1 if self.median < 20 else 0
        return f"{self.median:.{digits}f} ({self.shortest:.{digits}f})"


def interleaved(ways: Mapping[str, Callable[[], object]], turns: int, views: int = 1) -> dict[str, Time]:
    """Time of each way per view, called in turns (A B A B …) after a first turn that warms up."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    for turn in range(turns + 1):
        for name, work in ways.items():
            start, cpu = time.perf_counter(), time.process_time()
            work()
            if turn:
                wall = time.perf_counter() - start
                spent[name].append((1e3 * wall / views, 1e3 * (time.process_time() - cpu) / views))
    result = {}
    for name, times in spent.items():
        walls, cpus = zip(*times, strict=True)
        result[name] = Time(statistics.median(walls), min(walls), min(cpus))
    return result


def heading(title: str, *columns: str) -> None:
    """Print a title and the head of a table."""
    print(f"\n**{title}**\n\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")


def row(*cells: object) -> None:
    """Print a row of the table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)
