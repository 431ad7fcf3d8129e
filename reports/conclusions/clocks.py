"""How fast the machine was beside a timing: a fixed kernel beside every job shows it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from reports.schema import COLUMNS
from reports.style import absent

if TYPE_CHECKING:
    import pandas as pd

BUSY = 1.5
"""Time of the reference kernel / its quiet time, from which a machine counts as busy."""
CLOCKS = {
    "train_seconds": ("fit_processor", "fit_reference_seconds"),
    "fps": ("processor", "reference_seconds"),
}
"""Column of a speed -> columns of its processor and of the reference kernel's time beside it."""
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
        """Time of the reference kernel beside a row's job / its quiet time; 1 where either is not known."""
        reference = CLOCKS[column][1]
        quiet, time = self._quiet.get((reference, place(row, column))), row.get(reference)
        return 1.0 if quiet is None or absent(time) else float(time or 0.0) / quiet

    def corrected(self, row: Mapping[str, Any], column: str) -> float:
        """A row's value; a speed's as on a quiet machine: its time / the slowdown, where that is above 1."""
        value = float(row[column])
        if column not in CLOCKS:
            return value
        slowdown = max(1.0, self.slowdown(row, column))
        return value * slowdown if COLUMNS[column].better > 0 else value / slowdown

    def busy(self, row: Mapping[str, Any], column: str) -> bool:
        """Whether the machine was busy when a speed of a row was measured; False for other columns."""
        return column in CLOCKS and self.slowdown(row, column) > BUSY


def place(row: Mapping[str, Any], column: str) -> tuple[Any, Any]:
    """Processor and threads of a speed; None where not known."""
    processor, threads = row.get(CLOCKS[column][0]), row.get("threads")
    return (None if absent(processor) else processor), (None if absent(threads) else threads)
