"""Which times count: a fixed kernel beside every job shows how fast the machine was, frames how evenly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from statistics import median
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.style import absent, enumeration, label

if TYPE_CHECKING:
    import pandas as pd

BUSY = 1.5
"""Time of the reference kernel / its quiet time, above which a time is disturbed."""
SPREAD = 2.0
"""95th / 5th percentile of the frame times, above which FPS is disturbed.

It is 1.05 to 1.6 on a quiet machine, where views differ in what they show, and 2 to 20 on a busy one.
"""
CLOCKS = {
    "train_seconds": ("fit_processor", "fit_reference_seconds"),
    "fps": ("processor", "reference_seconds"),
}
"""Column of a speed -> columns of its processor and of the reference kernel's time beside it."""
WORST = {"train_seconds": "fit_reference_worst", "fps": "reference_worst"}
"""Column of a speed -> column of the longest time of the reference kernel before, amid and after it."""
_QUIET = 0.05
"""Quantile of the reference kernel's times on one processor that is its quiet time."""
_LEAST_TIMES = 5
"""Times of the reference kernel from which the quiet one is known."""


class Clocks:
    """Quiet times of the reference kernel, by kind of job, processor and number of threads.

    Kinds have times of their own: after a fit its library's threads still spin for a moment.

    Args:
        results: the table `results`.
    """

    def __init__(self, results: pd.DataFrame) -> None:
        self._quiet: dict[tuple[Any, ...], float] = {}
        for processor, reference in CLOCKS.values():
            if not {processor, reference, "threads"} <= set(results.columns):
                continue
            measured = results.dropna(subset=[processor, reference])
            for place, rows in measured.groupby([processor, "threads"]):
                if len(rows) >= _LEAST_TIMES:
                    self._quiet[reference, place] = float(rows[reference].astype(float).quantile(_QUIET))

    def slowdown(self, row: Mapping[str, Any], column: str) -> float:
        """Time of the reference kernel beside a row's job / its quiet time; 1 where either is not known.

        The time is the longer one of the mean before and after the job, and of the longest amid it.
        """
        quiet = self._quiet.get((CLOCKS[column][1], place(row, column)))
        times = [row.get(CLOCKS[column][1]), row.get(WORST[column])]
        known = [float(time) for time in times if time is not None and not absent(time)]
        return max(known) / quiet if quiet and known else 1.0

    def disturbed(self, row: Mapping[str, Any], column: str) -> str:
        """Why a row's time takes no part in conclusions on speed: in words, with figures.

        "" for a time that counts, and for columns that are no times.
        """
        if column not in CLOCKS:
            return ""
        reasons = []
        if (slowdown := self.slowdown(row, column)) > BUSY:
            reasons.append(f"the reference kernel took {slowdown:.3g} times its quiet time (limit {BUSY:g})")
        if column == "fps" and (spread := _spread(row)) > SPREAD:
            reasons.append(
                f"the slowest 5 % of the frames took {spread:.3g} times the fastest 5 % (limit {SPREAD:g})"
            )
        return "; ".join(reasons)


def _spread(row: Mapping[str, Any]) -> float:
    """95th / 5th percentile of a row's frame times; 1 where they are not known."""
    fast, slow = row.get("fps_p95"), row.get("fps_p05")
    return 1.0 if absent(fast) or absent(slow) else float(fast or 0.0) / float(slow or 1.0)


def decoding(rows: Iterable[Mapping[str, Any]]) -> str:
    """The condition of a comparison of FPS: whose networks run once and whose in each frame; "" without any.

    Args:
        rows: of `results`, of the methods that are compared.
    """
    kinds: dict[str, list[str]] = {"once": [], "per frame": []}
    shares: dict[str, list[float]] = {}
    for row in rows:
        if absent(kind := row.get("decoding")) or kind not in kinds:
            continue
        if (name := label(row["method"])) not in kinds[str(kind)]:
            kinds[str(kind)].append(name)
        if not absent(each := row.get("fps_decoding")):
            shares.setdefault(name, []).append(float(each or 0.0) / float(row["fps"]))
    parts = []
    if kinds["once"]:
        names = [
            f"{name} ({median(shares[name]):.2f} times the FPS with decoding in each frame)"
            if name in shares
            else name
            for name in kinds["once"]
        ]
        parts.append(f"once, at load: {enumeration(names)}")
    if kinds["per frame"]:
        parts.append(f"in each frame: {enumeration(kinds['per frame'])}")
    return f"Networks run {'; '.join(parts)}." if parts else ""


def place(row: Mapping[str, Any], column: str) -> tuple[Any, Any]:
    """Processor and threads of a speed; None where not known."""
    processor, threads = row.get(CLOCKS[column][0]), row.get("threads")
    return (None if absent(processor) else processor), (None if absent(threads) else threads)
