"""Which rows answer the question "which method?": those that all methods have under the same conditions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import median
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.clocks import CLOCKS
from econgs_bench.reports.comparability import (
    DATASET,
    DISTURBED,
    UNKNOWN,
    Place,
    compared,
    judged,
    kind_of,
    reason,
    root,
    usual_place,
)
from econgs_bench.reports.effects import LEAST_SHARE, Cells, at_shared_seeds
from econgs_bench.reports.floors import Floor, by_scene
from econgs_bench.reports.report import Report, once
from econgs_bench.reports.schema import records
from econgs_bench.reports.style import absent
from econgs_bench.reports.tables.protocols import (
    GROUPING,
    ORIGIN,
    contestants,
    drawn_as_means,
    finished,
    without_drawing,
)

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Values:
    """A column's values in a contest.

    Attributes:
        own: method -> its values of all its seeds; all methods have the same scenes.
        ratio: values are compared by quotient.
        left_out: why values were left out, as "from other processors" -> how many.
        processor: that all values are from; "" where it does not matter.
        paces: of times, method -> median time of the reference kernel beside them, in seconds, where known.
    """

    own: Mapping[str, Cells]
    ratio: bool
    left_out: Mapping[str, int] = field(default_factory=dict)
    processor: str = ""
    paces: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def cells(self) -> Mapping[str, Cells]:
        """Method -> its values of the seeds that all methods share."""
        return at_shared_seeds(self.own, self.ratio)


@dataclass(frozen=True)
class Contest:
    """The default configurations of all methods on all datasets at one preset.

    Attributes:
        preset: the preset.
        split: the measured views.
        rows: finished and failed rows of basic scenes, one per dataset, scene, method and seed; a dataset's
            name includes its number of training views where there are several. ``finished``: whether the
            method failed with no seed of the scene.
        main: datasets that count for all but robustness: of several numbers of training views the largest, of
            several versions of one dataset one.
    """

    preset: str
    split: str
    rows: list[dict[str, Any]]
    main: frozenset[str]

    @property
    def protocol(self) -> str:
        """Preset, where it is known, and the split where it is not that of the test views, for people."""
        preset = "" if self.preset in ("", "None", "nan", "<NA>") else f"preset {self.preset}"
        return ", ".join(filter(None, (preset, f"split {self.split}" if self.split == "val" else "")))

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
    def attempted(self) -> list[dict[str, Any]]:
        """The rows of ranked methods, of the scenes and seeds that all of them tried, finished or not.

        Where they share no seed of any scene, of the scenes that all of them tried.
        """
        rows = [row for row in self.rows if row["method"] in self.methods]
        for keys in (("dataset", "scene", "seed"), ("dataset", "scene")):
            own: dict[str, set[tuple[Any, ...]]] = {}
            for row in rows:
                own.setdefault(row["method"], set()).add(tuple(row[key] for key in keys))
            if common := set.intersection(*own.values()):
                return [row for row in rows if tuple(row[key] for key in keys) in common]
        return []

    @cached_property
    def attempts(self) -> dict[str, set[str]]:
        """Method -> main datasets of which it has rows, finished or not, of at least half of the scenes."""
        most: dict[str, int] = {}
        for own in self._tried.values():
            for dataset in self.main & own.keys():
                most[dataset] = max(most.get(dataset, 0), len(own[dataset]))
        return {
            name: {
                dataset
                for dataset in self.main & own.keys()
                if len(own[dataset]) >= LEAST_SHARE * most[dataset]
            }
            for name, own in self._tried.items()
        }

    @cached_property
    def methods(self) -> list[str]:
        """The methods that are ranked: those with rows of at least half of the datasets.

        If these share none, those with the dataset that most of them have.
        """
        most = max(map(len, self.attempts.values()), default=0)
        names = [name for name, own in self.attempts.items() if len(own) >= LEAST_SHARE * most]
        counts = Counter(
            dataset
            for dataset in dict.fromkeys(row["dataset"] for row in self.rows)
            for name in names
            if dataset in self.attempts[name]
        )
        ((dataset, _),) = counts.most_common(1) or [("", 0)]
        shared = counts[dataset] == len(names)
        return [name for name in names if shared or dataset in self.attempts[name]]

    @cached_property
    def others(self) -> dict[str, int]:
        """Method that is not ranked -> number of its datasets."""
        return {name: len(own) for name, own in self.attempts.items() if name not in self.methods}

    @cached_property
    def failures(self) -> dict[str, int]:
        """Method -> number of its rows that did not finish, of what all ranked methods tried."""
        failures = dict.fromkeys(self.methods, 0)
        for row in self.attempted:
            failures[row["method"]] += row["status"] != "ok"
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

    @cached_property
    def _values(self) -> dict[str, Values]:
        return {}

    def values(self, column: str) -> Values:
        """The values of a column on the datasets where all ranked methods finished the scenes that all tried.

        Speeds are of the place with the most methods, then datasets, and of the scenes that those methods
        have there, at least half. Methods with the fewest values are left out where no dataset is common.
        """
        if column not in self._values:
            self._values[column] = self._compared(column)
        return self._values[column]

    def _compared(self, column: str) -> Values:
        rows = [
            row
            for row in self.rows
            if row["dataset"] in self.main
            and row["method"] in self.methods
            and row["finished"]
            and not absent(row[column])
            and (column == "psnr" or float(row[column]) > 0)  # all else is compared by ratio
        ]
        ratio = column != "psnr"
        if column not in CLOCKS:
            return Values(self._most(rows, column), ratio)
        ranked = [row for row in self.rows if row["method"] in self.methods]
        left_out = Counter(_why(text) for row in ranked if (text := reason(row, column)))
        placed = [(row, Place.of(row, column)) for row in rows]
        common = {
            at: self._most([row for row, place in placed if place.agrees(at)], column)
            for at in {place for _, place in placed}
        }
        if not common:
            return Values({}, ratio, left_out)
        usual = usual_place(placed)

        def weight(at: Place) -> tuple[int, int, bool, str]:
            cells = common[at]
            return len(cells), len(next(iter(cells.values()), ())), at == usual, str(at)

        best = max(common, key=weight)
        for row, place in placed:
            if not place.agrees(best):
                left_out[_why(place.difference(best))] += 1
            elif row["method"] not in common[best]:
                left_out["of methods with few times"] += 1
        paces: dict[str, list[float]] = {}
        for row, place in placed:
            time = row.get(CLOCKS[column][1])
            if place.agrees(best) and time is not None and not absent(time):
                paces.setdefault(row["method"], []).append(float(time))
        medians = {name: median(times) for name, times in paces.items()}
        return Values(common[best], ratio, left_out, best.text, medians)

    def _most(self, rows: Sequence[Mapping[str, Any]], column: str) -> dict[str, Cells]:
        """Values of as many methods as have a dataset in common, without those with the fewest rows."""
        counts = Counter(row["method"] for row in rows)
        methods = [name for name in self.methods if counts[name]]
        while len(methods) > 1:
            cells = self._common([row for row in rows if row["method"] in methods], column, methods)
            if any(cells.values()):
                return cells
            methods.remove(min(reversed(methods), key=lambda name: counts[name]))
        return {}

    def _common(
        self, rows: Iterable[Mapping[str, Any]], column: str, methods: Iterable[str]
    ) -> dict[str, Cells]:
        cells: dict[str, Cells] = {name: {} for name in methods}
        for row in rows:
            scenes = cells[row["method"]].setdefault(row["dataset"], {})
            scenes.setdefault(row["scene"], {})[row["seed"]] = float(row[column])
        common = {
            dataset: scenes.intersection(*(own.get(dataset, ()) for own in cells.values()))
            for dataset, scenes in self.scenes.items()
            if dataset in self.main
        }
        # A disturbed time leaves out its scene; a scene that somebody did not finish, the dataset.
        least = LEAST_SHARE if column in CLOCKS else 1.0
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
    """The contests of a report. Rows that do not compete choose no version and no place of those that do."""
    rows = by_default(report.measured, "basic")
    if "differences" in rows:
        rows = compared({"results": judged(rows, report.whole.clocks)})["results"]
    return _contests(rows)


def contests(results: pd.DataFrame) -> list[Contest]:
    """A contest per preset and split with at least two methods, the one with the most comparisons first.

    Those of test views precede those of validation views, which chose options.

    Args:
        results: the table `results` of :func:`.reports.tables.protocols.by_protocol`.
    """
    return _contests(by_default(results, "basic"))


def _contests(rows: pd.DataFrame) -> list[Contest]:
    rows = rows.assign(finished=finished(rows))
    contests = []
    for (preset, split), every in rows.groupby(["preset", "split"], dropna=False, sort=False):
        # Datasets with one method compare nothing.
        several = every.groupby("dataset")["method"].transform("nunique") > 1
        own = every[several]
        contest = Contest(str(preset), str(split), records(own), _main(own))
        if len(contest.methods) > 1:
            contests.append(contest)

    def order(contest: Contest) -> tuple[bool, int]:
        return contest.split == "val", -sum(len(contest.attempts[name]) for name in contest.methods)

    return sorted(contests, key=order)


def by_default(results: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Rows of default options, of a kind, with the names of contestants and a known truth."""
    own = results["variant"].fillna("").map(without_drawing) == results.get(GROUPING, "")
    known = results["rate"].isna() & ~results["dataset"].str.endswith(UNKNOWN)
    return contestants(drawn_as_means(results[(results["kind"] == kind) & own & known]))


def _why(text: str) -> str:
    """Why a time is left out, in words for a number of rows."""
    return {
        DISTURBED: "with a disturbed time", "elsewhere": "from other processors",
        "other threads": "with other threads", "another clock": "timed by other programs",
        "another ruler": "timed by other versions of the harness", "another version": "of another version",
    }[text.partition(": ")[0]]  # fmt: skip


def _main(rows: pd.DataFrame) -> frozenset[str]:
    """The datasets with the most training views of their kind.

    One that is set apart counts where there is no other: of several that with the most methods and scenes.
    """
    import pandas as pd

    whole = rows[ORIGIN].fillna(rows["dataset"]) if ORIGIN in rows else rows["dataset"]
    apart = pd.Series([kind_of(row, DATASET) != "" for row in records(rows)], rows.index, dtype=bool)
    roots = whole.map(root)
    models = rows[apart].groupby(whole[apart])[["method", "scene"]].value_counts().groupby(level=0).size()
    versions: dict[str, str] = {}
    for name in sorted(models.index, key=lambda name: (-models[name], name)):
        versions.setdefault(root(name), name)
    counts = ~apart | (~roots.isin(roots[~apart]) & whole.isin(versions.values()))
    rows, whole = rows[counts], whole[counts]
    views = rows["requested_views"].fillna(0)
    most = views.groupby(whole).transform("max")
    return frozenset(rows.loc[views == most, "dataset"])
