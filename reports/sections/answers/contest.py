"""Which rows answer the question "which method?": those that all methods have under the same conditions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.clocks import CLOCKS
from econgs_bench.reports.comparability import (
    DATASET,
    DISTURBED,
    UNKNOWN,
    Place,
    kind_of,
    usual_place,
)
from econgs_bench.reports.effects import Cells
from econgs_bench.reports.floors import Floor, by_scene
from econgs_bench.reports.report import Report, once
from econgs_bench.reports.schema import records
from econgs_bench.reports.style import absent
from econgs_bench.reports.tables.protocols import (
    GROUPING,
    ORIGIN,
    contestants,
    drawn_as_means,
    without_drawing,
)

if TYPE_CHECKING:
    import pandas as pd

_LEAST_SHARE = 0.5
"""Share of the datasets, and of the scenes of each, that a method needs to be ranked."""


@dataclass(frozen=True)
class Values:
    """A column's values in a contest.

    Attributes:
        cells: method -> its values.
        elsewhere: number of values from other places, by other rulers or of other versions, left out.
        disturbed: number of disturbed times, left out.
        processor: that all values are from; "" where it does not matter.
    """

    cells: Mapping[str, Cells]
    elsewhere: int = 0
    disturbed: int = 0
    processor: str = ""


@dataclass(frozen=True)
class Contest:
    """The default configurations of all methods on all datasets at one preset.

    Attributes:
        preset: the preset.
        split: the measured views.
        rows: finished and failed rows of basic scenes, one per dataset, scene, method and seed; a dataset's
            name includes its number of training views where there are several.
        main: datasets that count for all but robustness: of several numbers of training views the largest.
        clocks: which speeds were disturbed.
    """

    preset: str
    split: str
    rows: list[dict[str, Any]]
    main: frozenset[str]

    @property
    def protocol(self) -> str:
        """Preset, and the split where it is not that of the test views, for people."""
        return f"preset {self.preset}" + (f", split {self.split}" if self.split == "val" else "")

    @cached_property
    def scenes(self) -> dict[str, set[str]]:
        """Dataset -> the scenes of which all ranked methods that tried it have rows, finished or not."""
        scenes: dict[str, set[str]] = {}
        for method in self.methods:
            for dataset, own in self._tried[method].items():
                scenes[dataset] = scenes.get(dataset, own) & own
        return {dataset: common for dataset, common in scenes.items() if common}

    @cached_property
    def _tried(self) -> dict[str, dict[str, set[str]]]:
        """Method -> dataset -> scenes that it has rows of, finished or not."""
        tried: dict[str, dict[str, set[str]]] = {}
        for row in self.rows:
            tried.setdefault(row["method"], {}).setdefault(row["dataset"], set()).add(row["scene"])
        return tried

    @cached_property
    def attempts(self) -> dict[str, set[str]]:
        """Method -> datasets of which it has rows, finished or not, of at least half of the scenes."""
        most: dict[str, int] = {}
        for own in self._tried.values():
            for dataset, scenes in own.items():
                most[dataset] = max(most.get(dataset, 0), len(scenes))
        return {
            name: {dataset for dataset, scenes in own.items() if len(scenes) >= _LEAST_SHARE * most[dataset]}
            for name, own in self._tried.items()
        }

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

    @cached_property
    def stale(self) -> dict[str, int]:
        """Method -> number of its rows that its present version, options or data would change."""
        counts: dict[str, int] = {}
        for row in self.rows:
            if row["method"] in self.methods and not absent(row["stale"]) and row["stale"]:
                counts[row["method"]] = counts.get(row["method"], 0) + 1
        return counts

    @cached_property
    def floors(self) -> dict[str, dict[str, Floor | None]]:
        """Dataset -> scene -> noise floor of its truth."""
        rows: dict[str, list[dict[str, Any]]] = {}
        for row in self.rows:
            rows.setdefault(row["dataset"], []).append(row)
        return {dataset: by_scene(own) for dataset, own in rows.items()}

    def values(self, column: str) -> Values:
        """The values of a column on the datasets where all ranked methods have the scenes that all tried.

        Speeds are of the place with the most datasets, and of the scenes that all have, at least half.
        """
        rows = [
            row
            for row in self.rows
            if row["dataset"] in self.main
            and row["method"] in self.methods
            and row["status"] == "ok"
            and not absent(row[column])
            and (column == "psnr" or float(row[column]) > 0)  # all else is compared by ratio
        ]
        if column not in CLOCKS:
            return Values(self._common(rows, column))
        kinds = Counter(kind for row in self.rows if (kind := kind_of(row, column)))
        disturbed, elsewhere = kinds.pop(DISTURBED, 0), kinds.total()
        placed = [(row, Place.of(row, column)) for row in rows]
        common = {
            at: (self._common([row for row, place in placed if place.agrees(at)], column), at)
            for at in {place for _, place in placed}
        }
        if not common:
            return Values({}, elsewhere, disturbed)
        datasets = {at: len(next(iter(cells.values()))) for at, (cells, _) in common.items()}
        usual = usual_place(placed)
        best = max(common, key=lambda at: (datasets[at], at == usual, str(at)))
        others = sum(not place.agrees(best) for _, place in placed)
        return Values(common[best][0], elsewhere + others, disturbed, best.text)

    def _common(self, rows: Iterable[Mapping[str, Any]], column: str) -> dict[str, Cells]:
        cells: dict[str, Cells] = {name: {} for name in self.methods}
        for row in rows:
            scenes = cells[row["method"]].setdefault(row["dataset"], {})
            scenes.setdefault(row["scene"], {})[row["seed"]] = float(row[column])
        common = {
            dataset: scenes.intersection(*(own.get(dataset, ()) for own in cells.values()))
            for dataset, scenes in self.scenes.items()
            if dataset in self.main
        }
        # A disturbed time leaves out its scene; a scene that somebody did not finish, the dataset.
        least = _LEAST_SHARE if column in CLOCKS else 1.0
        enough = {
            dataset: sorted(scenes)
            for dataset, scenes in common.items()
            if scenes and len(scenes) >= least * len(self.scenes[dataset])
        }
        return {
            name: {
                dataset: {scene: own[dataset][scene] for scene in scenes}
                for dataset, scenes in enough.items()
            }
            for name, own in cells.items()
        }


@once
def of_report(report: Report) -> list[Contest]:
    """The contests of a report."""
    return contests(report.results)


def contests(results: pd.DataFrame) -> list[Contest]:
    """A contest per preset and split with at least two methods, the one with the most comparisons first.

    Args:
        results: the table `results` of :func:`.reports.tables.protocols.by_protocol`.
    """
    grouping = results.get(GROUPING, "")
    default = (results["kind"] == "basic") & (results["variant"].fillna("").map(without_drawing) == grouping)
    rows = results[default & results["rate"].isna() & ~results["dataset"].str.endswith(UNKNOWN)]
    rows = contestants(drawn_as_means(rows))
    contests = []
    for (preset, split), every in rows.groupby(["preset", "split"], dropna=False, sort=False):
        # Datasets with one method compare nothing.
        several = every.groupby("dataset")["method"].transform("nunique") > 1
        compared = every[several]
        contest = Contest(str(preset), str(split), records(compared), _main(compared))
        if len(contest.methods) > 1:
            contests.append(contest)
    return sorted(contests, key=lambda each: -sum(len(each.attempts[name]) for name in each.methods))


def _main(rows: pd.DataFrame) -> frozenset[str]:
    """The datasets with the most training views of their kind; those set apart where there are no others."""
    apart = [kind_of(row, DATASET) != "" for row in records(rows)]
    if not all(apart):
        rows = rows[[not one for one in apart]]
    whole = rows[ORIGIN].fillna(rows["dataset"]) if ORIGIN in rows else rows["dataset"]
    views = rows["requested_views"].fillna(0)
    most = views.groupby(whole).transform("max")
    return frozenset(rows.loc[views == most, "dataset"])
