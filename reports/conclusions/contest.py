"""Which rows answer the question "which method?": those that all methods have under the same conditions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from reports.style import absent
from reports.tables.columns import records
from reports.tables.protocols import ORIGIN

if TYPE_CHECKING:
    import pandas as pd

Cells = dict[str, dict[str, dict[Any, float]]]
"""Dataset -> scene -> seed -> value, of one method."""

BUSY = 1.5
"""Time of the reference kernel / its quiet time, from which a machine counts as busy."""
_QUIET = 0.05
"""Quantile of the reference kernel's times on one processor that is its quiet time."""
_LEAST_TIMES = 5
"""Times of the reference kernel from which the quiet one is known."""
_LEAST_SHARE = 0.5
"""Share of the datasets that a method needs to be ranked."""
_CLOCKS = {
    "train_seconds": ("fit_processor", "fit_reference_seconds"),
    "fps": ("processor", "reference_seconds"),
}
"""Column of a speed -> columns of its processor and of the reference kernel's time beside it."""


@dataclass(frozen=True)
class Values:
    """A column's values in a contest.

    Attributes:
        cells: method -> its values.
        busy: number of values that were measured on a busy machine and are left out.
        elsewhere: number of values from other processors, left out.
        processor: that all values are from; "" where it does not matter.
    """

    cells: Mapping[str, Cells]
    busy: int = 0
    elsewhere: int = 0
    processor: str = ""


@dataclass(frozen=True)
class Contest:
    """The default configurations of all methods on all datasets at one preset.

    Attributes:
        preset: the preset.
        rows: finished and failed rows of basic scenes, one per dataset, scene, method and seed; a dataset's
            name includes its number of training views where there are several.
        main: datasets that count for all but robustness: of several numbers of training views the largest.
        quiet: column of the reference kernel's time, processor and threads -> its quiet time, in seconds.
    """

    preset: str
    rows: list[dict[str, Any]]
    main: frozenset[str]
    quiet: Mapping[tuple[Any, ...], float] = field(default_factory=dict)

    @cached_property
    def scenes(self) -> dict[str, set[str]]:
        """Dataset -> scenes."""
        scenes: dict[str, set[str]] = {}
        for row in self.rows:
            scenes.setdefault(row["dataset"], set()).add(row["scene"])
        return scenes

    @cached_property
    def attempts(self) -> dict[str, set[str]]:
        """Method -> datasets that it has rows of, finished or not."""
        attempts: dict[str, set[str]] = {}
        for row in self.rows:
            attempts.setdefault(row["method"], set()).add(row["dataset"])
        return attempts

    @cached_property
    def methods(self) -> list[str]:
        """The methods that are ranked: those with rows of at least half of the datasets."""
        most = max(map(len, self.attempts.values()), default=0)
        return [name for name, own in self.attempts.items() if len(own) >= _LEAST_SHARE * most]

    @cached_property
    def others(self) -> dict[str, int]:
        """Method that is not ranked -> number of its datasets."""
        return {name: len(own) for name, own in self.attempts.items() if name not in self.methods}

    @cached_property
    def failures(self) -> dict[str, int]:
        """Method -> number of its rows that did not finish."""
        failures = dict.fromkeys(self.methods, 0)
        for row in self.rows:
            if row["status"] != "ok" and row["method"] in failures:
                failures[row["method"]] += 1
        return failures

    def values(self, column: str) -> Values:
        """The values of a column on the datasets where all ranked methods have all scenes.

        Speeds are of quiet machines, and of the processor and number of threads with the most datasets.
        """
        rows = [
            row
            for row in self.rows
            if row["dataset"] in self.main
            and row["method"] in self.methods
            and row["status"] == "ok"
            and not absent(row[column])
        ]
        if column not in _CLOCKS:
            return Values(self._common(rows, column))
        processor, reference = _CLOCKS[column]
        quiet = [row for row in rows if not self._busy(row, processor, reference)]
        places: dict[tuple[Any, Any], list[dict[str, Any]]] = {}
        for row in quiet:
            places.setdefault(_place(row, processor), []).append(row)
        if not places:
            return Values({}, busy=len(rows))
        common = {place: self._common(here, column) for place, here in places.items()}
        best = max(places, key=lambda place: (len(next(iter(common[place].values()))), len(places[place])))
        text = f"{best[0]}, {best[1]} thread{'s' if best[1] != 1 else ''}"
        left_out = len(quiet) - len(places[best])
        return Values(common[best], len(rows) - len(quiet), left_out, text)

    def _busy(self, row: Mapping[str, Any], processor: str, reference: str) -> bool:
        quiet = self.quiet.get((reference, *_place(row, processor)))
        return quiet is not None and not absent(row[reference]) and float(row[reference]) > BUSY * quiet

    def _common(self, rows: Iterable[Mapping[str, Any]], column: str) -> dict[str, Cells]:
        cells: dict[str, Cells] = {name: {} for name in self.methods}
        for row in rows:
            scenes = cells[row["method"]].setdefault(row["dataset"], {})
            scenes.setdefault(row["scene"], {})[row["seed"]] = float(row[column])
        whole = [
            dataset
            for dataset, scenes in self.scenes.items()
            if dataset in self.main and all(set(own.get(dataset, ())) == scenes for own in cells.values())
        ]
        return {name: {dataset: own[dataset] for dataset in whole} for name, own in cells.items()}


def contests(results: pd.DataFrame) -> list[Contest]:
    """A contest per preset with at least two methods, the one with the most comparisons first.

    Args:
        results: the table `results` of :func:`reports.tables.protocols.by_protocol`.
    """
    default = (results["kind"] == "basic") & (results["variant"].fillna("") == "") & results["rate"].isna()
    if "scenes_together" in results:
        default &= results["scenes_together"].isna()
    rows = results[default]
    quiet = _quiet_times(results)
    contests = []
    for preset, every in rows.groupby("preset", dropna=False, sort=False):
        # Datasets with one method compare nothing.
        several = every.groupby("dataset")["method"].transform("nunique") > 1
        compared = every[several]
        contest = Contest(str(preset), records(compared), _main(compared), quiet)
        if len(contest.methods) > 1:
            contests.append(contest)
    return sorted(contests, key=lambda each: -sum(len(each.attempts[name]) for name in each.methods))


def _main(rows: pd.DataFrame) -> frozenset[str]:
    """The datasets with the most training views of their kind."""
    whole = rows[ORIGIN].fillna(rows["dataset"]) if ORIGIN in rows else rows["dataset"]
    views = rows["requested_views"].fillna(0)
    most = views.groupby(whole).transform("max")
    return frozenset(rows.loc[views == most, "dataset"])


def _quiet_times(results: pd.DataFrame) -> dict[tuple[Any, ...], float]:
    """Column, processor and threads -> time of the reference kernel on the quiet machine.

    Columns have times of their own: after a fit its library's threads still spin for a moment.
    """
    times: dict[tuple[Any, ...], float] = {}
    for processor, reference in _CLOCKS.values():
        if reference not in results or processor not in results:
            continue
        measured = results.dropna(subset=[processor, reference])
        for (name, threads), rows in measured.groupby([processor, "threads"]):
            if len(rows) >= _LEAST_TIMES:
                times[reference, name, threads] = float(rows[reference].astype(float).quantile(_QUIET))
    return times


def _place(row: Mapping[str, Any], processor: str) -> tuple[Any, Any]:
    return (None if absent(row[processor]) else row[processor]), (
        None if absent(row["threads"]) else row["threads"]
    )
