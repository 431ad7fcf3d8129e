"""Races: the best picture of each method at equal training time, equal bytes and equal numbers of Gaussians.

A method enters with its default settings, at every length of its schedule and every rate that was measured.
What it reaches at a limit is read off the front of its models of a scene and seed: linear in the logarithm
of the cost between two models, the best one's picture beyond the largest, and nothing below the smallest.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import fmean, geometric_mean
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from econgs_bench.reports import floors
from econgs_bench.reports.charts.tradeoff import XY
from econgs_bench.reports.effects import LEAST_SHARE, Cells, Effect, at_shared_seeds, leads, mean_of
from econgs_bench.reports.family import Family, largest
from econgs_bench.reports.floors import Floor
from econgs_bench.reports.fronts import interpolated, pareto
from econgs_bench.reports.report import Report, once
from econgs_bench.reports.schema import records
from econgs_bench.reports.style import MIB, MISSING, absent, counted, enumeration, label, mib, seconds, signed
from econgs_bench.reports.tables.protocols import (
    GROUPING,
    comparable,
    contestants,
    drawn_as_means,
    finished,
    without_drawing,
)

if TYPE_CHECKING:
    import pandas as pd

_LENGTH = re.compile(r"(iterations=\d+)?")
"""Options of a fit that races: none, or another length of the schedule."""


class Expense(NamedTuple):
    """What a model took beside what is limited; None: not known.

    Attributes:
        seconds: training time per scene.
        memory: peak host memory, bytes.
    """

    seconds: float | None
    memory: float | None


@dataclass(frozen=True)
class Discipline:
    """What is equal in a race.

    Attributes:
        column: of the results.
        title: of the axis, with the unit.
        noun: what is limited.
        unit: costs of the column / costs as shown.
        limits: as shown, at which leads are told.
    """

    column: str
    title: str
    noun: str
    unit: float
    limits: tuple[float, ...]

    def text(self, limit: float) -> str:
        """A limit with its unit, as "2 min" or "0.25 MiB"."""
        if self.column == "train_seconds":
            return f"{limit:g} s" if limit < 60 else f"{limit / 60:g} min"
        return f"{limit:g} MiB" if self.column == "size_bytes" else f"{limit:,.0f} Gaussians"


DISCIPLINES = (
    Discipline(
        "train_seconds", "training time per scene [s]", "training time", 1.0, (10, 30, 120, 480, 1800)
    ),
    Discipline("size_bytes", "size per scene [MiB]", "size", MIB, (0.05, 0.1, 0.25, 0.5, 1.0, 4.0)),
    Discipline("drawn", "Gaussians drawn in a view", "number of Gaussians", 1.0, (3e3, 1e4, 3e4, 5e4, 1e5)),
)


@dataclass(frozen=True)
class Front:
    """The models of a method on a scene with a seed that none of its others beats, by cost."""

    spots: tuple[XY, ...]

    @classmethod
    def of(cls, spots: Iterable[XY]) -> Front:
        """Of any models, at least one; costs are positive."""
        return cls(tuple(pareto(spots, -1)))

    def at(self, limit: float) -> float | None:
        """PSNR that is reached at a limit; None below the smallest cost."""
        return None if limit < self.spots[0][0] else interpolated(self.spots, limit)


Fronts = dict[str, dict[Any, Front]]
"""Scene -> seed -> front, of one method."""


@dataclass(frozen=True)
class Lead:
    """The method with the best mean at a limit.

    Attributes:
        limit: as shown.
        method, psnr: of the best, dB.
        rivals: each other method with a model within the limit, best first, and how far ahead of it the best
            one is; empty where it runs alone.
        expense: of the best one's largest models within the limit, geometric means over scenes and seeds;
            not known where that of a model is not.
    """

    limit: float
    method: str
    psnr: float
    expense: Expense
    rivals: tuple[tuple[str, Effect], ...]

    @property
    def starters(self) -> int:
        """Number of methods with a model within the limit."""
        return 1 + len(self.rivals)

    @property
    def p(self) -> float | None:
        """Of the lead on all rivals; None where it is not tested."""
        return largest([effect.p for _, effect in self.rivals])

    def nearest(self, family: Family) -> tuple[str, Effect] | None:
        """The best of the rivals on which the lead is not significant, or the next best."""
        near = [one for one in self.rivals if not family.significant(one[1].p)]
        return next(iter(near or self.rivals), None)


@dataclass(frozen=True)
class Race:
    """All methods on a dataset in one discipline.

    Attributes:
        dataset: with preset and split where there are several.
        discipline: what is equal.
        fronts: method -> its models of the scenes that count: those of all methods that have at least half.
        expenses: method, scene, seed and model -> what else it took.
        floors: scene -> noise floor of its truth, where it is known.
        others: methods without models of all these scenes.
    """

    dataset: str
    discipline: Discipline
    fronts: dict[str, Fronts]
    expenses: dict[tuple[str, str, Any, XY], Expense]
    floors: dict[str, Floor | None] = field(default_factory=dict)
    others: tuple[str, ...] = ()

    @property
    def methods(self) -> int:
        """Number of all methods of the dataset."""
        return len(self.fronts) + len(self.others)

    def costs(self, method: str) -> list[float]:
        """Costs of a method's models, from the least at which it has one of every scene and seed."""
        fronts = [front for seeds in self.fronts[method].values() for front in seeds.values()]
        start = max(front.spots[0][0] for front in fronts)
        return sorted({cost for front in fronts for cost, _ in front.spots if cost >= start})

    def seeds(self, method: str) -> list[Any]:
        """Seeds that all scenes have, of those that :meth:`mean` is of."""
        each = [self._compared(scene, seeds) for scene, seeds in self.fronts[method].items()]
        return sorted(set.intersection(*each)) if each else []

    def reached(self, method: str, limit: float) -> dict[str, dict[Any, float]] | None:
        """Scene -> seed -> PSNR at a limit; None where a scene has no model within it."""
        cells = {
            scene: {seed: front.at(limit) for seed, front in seeds.items()}
            for scene, seeds in self.fronts[method].items()
        }
        if any(value is None for seeds in cells.values() for value in seeds.values()):
            return None
        return cells  # type: ignore[return-value]

    def mean(self, method: str, limit: float, seed: Any = None) -> float | None:
        """Mean over scenes of PSNR at a limit: of a seed, or of the means over the seeds of all methods.

        A method that shares no seed with the others has the mean over its own.
        """
        cells = self.reached(method, limit)
        if cells is None:
            return None
        chosen = [
            [seeds[one] for one in ([seed] if seed is not None else self._compared(scene, seeds))]
            for scene, seeds in cells.items()
        ]
        return float(np.mean([np.mean(values) for values in chosen]))

    def _compared(self, scene: str, own: Iterable[Any]) -> set[Any]:
        """Seeds of a scene that all methods have; a method's own where there are none."""
        return self._shared[scene] or set(own)

    @cached_property
    def _shared(self) -> dict[str, set[Any]]:
        """Scene -> seeds that all methods have."""
        scenes = next(iter(self.fronts.values()))
        return {
            scene: set.intersection(*(set(each[scene]) for each in self.fronts.values())) for scene in scenes
        }

    @cached_property
    def leads(self) -> list[Lead]:
        """One per limit that lies within what was measured and that some method holds."""
        spots = [
            cost
            for fronts in self.fronts.values()
            for seeds in fronts.values()
            for front in seeds.values()
            for cost, _ in front.spots
        ]
        limits = [one for one in self.discipline.limits if min(spots) <= one <= max(spots)]
        return [lead for limit in limits if (lead := self._lead(limit)) is not None]

    def _lead(self, limit: float) -> Lead | None:
        cells = {name: {self.dataset: own} for name in self.fronts if (own := self.reached(name, limit))}
        if not cells:
            return None
        shared = at_shared_seeds(cells, ratio=False)
        means = {name: mean_of(own, ratio=False) for name, own in shared.items()}
        order = sorted(means, key=lambda name: -means[name])
        rivals = tuple(zip(order[1:], leads(order, cells, 1, ratio=False)[0], strict=True))
        best = order[0]
        return Lead(limit, best, means[best], self._expense(best, limit), rivals)

    def closeness(self, lead: Lead, family: Family) -> str:
        """Where the leader, or who is next to it, comes near to the noise floor of the truth; "" nowhere."""
        nearest = lead.nearest(family)
        if nearest is None:
            return ""
        pair = [self._cells(name, lead.limit)[self.dataset] for name in (lead.method, nearest[0])]
        return floors.closeness(
            (self.floors.get(scene), max(fmean(one[scene].values()) for one in pair)) for scene in pair[0]
        )

    def _expense(self, method: str, limit: float) -> Expense:
        """Geometric means over a method's largest models within a limit."""
        each = [
            self.expenses[method, scene, seed, max(spot for spot in front.spots if spot[0] <= limit)]
            for scene, seeds in self.fronts[method].items()
            for seed, front in seeds.items()
        ]
        return Expense(
            *(geometric_mean(values) if all(values) else None for values in zip(*each, strict=True))
        )

    def _cells(self, method: str, limit: float) -> Cells:
        reached = self.reached(method, limit)
        assert reached is not None
        return {self.dataset: reached}


@once
def of_report(report: Report) -> list[Race]:
    """The races of a whole report, whichever part of it asks: other lengths of a schedule race."""
    return races(report.results) if report.whole is report else of_report(report.whole)


def races(results: pd.DataFrame) -> list[Race]:
    """A race per discipline and dataset on which a method has several models, disciplines first.

    Lengths and rates that were not measured with all seeds of a method take no part.

    Args:
        results: the table of that name, with what is compared (:func:`.reports.comparability.compared`).
    """
    rows = results[results["kind"] == "basic"]
    rows = rows.assign(finished=finished(rows) & rows["psnr"].notna())
    rows = rows[rows["iterations"].notna() & (rows["iterations"] > 1)]  # volumes and meshes train nothing
    if rows.empty:
        return []
    words = rows[GROUPING] if GROUPING in rows else [""] * len(rows)
    bases = [
        without_drawing(str(base or "").removesuffix(text).removesuffix(","))
        for base, text in zip(rows["base"].fillna(""), words, strict=True)
    ]
    rows = contestants(drawn_as_means(rows[[_LENGTH.fullmatch(base) is not None for base in bases]]))
    datasets = [(title, records(group)) for title, group in comparable(rows)]
    found = []
    for discipline in DISCIPLINES:
        for title, group in datasets:
            race = _race(title, discipline, group)
            if race is not None:
                found.append(race)
    return found


_Models = dict[Any, dict[Any, XY]]
"""Length and rate -> seed -> model, of a method on a scene."""


def _of_all_seeds(models: _Models) -> dict[Any, list[XY]]:
    """Seed -> models. One that a seed lacks is left out, if no seed lacks some other: seeds are compared."""
    seeds = {seed for own in models.values() for seed in own}
    whole = [own for own in models.values() if own.keys() == seeds] or list(models.values())
    return {seed: [own[seed] for own in whole if seed in own] for seed in seeds}


def _race(dataset: str, discipline: Discipline, rows: Sequence[dict[str, Any]]) -> Race | None:
    column = discipline.column
    here = [row for row in rows if row["finished"] and not absent(row.get(column)) and float(row[column]) > 0]
    entered: dict[str, dict[str, _Models]] = {}
    expenses: dict[tuple[str, str, Any, XY], Expense] = {}
    for row in here:
        cost = float(row[column]) / discipline.unit
        own = entered.setdefault(str(row["method"]), {}).setdefault(str(row["scene"]), {})
        settings = (row["variant"], "" if absent(row["rate"]) else row["rate"])
        spot = (cost, float(row["psnr"]))
        own.setdefault(settings, {})[row["seed"]] = spot
        time = None if absent(row["train_seconds"]) else float(row["train_seconds"])
        memory = None if absent(row["peak_host_bytes"]) else float(row["peak_host_bytes"])
        expenses[str(row["method"]), str(row["scene"]), row["seed"], spot] = Expense(time, memory)
    spots = {
        name: {scene: _of_all_seeds(models) for scene, models in own.items()} for name, own in entered.items()
    }
    least = LEAST_SHARE * max((len(own) for own in spots.values()), default=0)
    enough = {name: own for name, own in spots.items() if len(own) >= least}
    scenes = set.intersection(*(set(own) for own in enough.values())) if enough else set()
    fronts = {
        name: {
            scene: {seed: Front.of(every) for seed, every in own[scene].items()} for scene in sorted(scenes)
        }
        for name, own in enough.items()
        if scenes
    }
    others = tuple(dict.fromkeys(str(row["method"]) for row in rows if str(row["method"]) not in fronts))
    several = any(
        len(every) > 1 for own in spots.values() for seeds in own.values() for every in seeds.values()
    )
    if len(fronts) < 2 or not several:
        return None
    return Race(dataset, discipline, fronts, expenses, floors.by_scene(rows), others)


def _limit(race: Race, lead: Lead, family: Family) -> str:
    """A limit: how many methods have a model within it where not all have, a single seed, a near floor."""
    remarks = []
    if lead.starters < race.methods:
        remarks.append(f"{lead.starters} of {race.methods} methods")
    if lead.rivals and (most := max(ahead.seeds[1] for _, ahead in lead.rivals)) < 2:
        remarks.append("one seed" if most else "no common seed")
    if near := race.closeness(lead, family):
        remarks.append(near)
    return race.discipline.text(lead.limit) + (f" [{', '.join(remarks)}]" if remarks else "")


def conclusion(found: Sequence[Race], family: Family) -> list[str]:
    """Who leads significantly, and where: a sentence per discipline.

    Args:
        found: the races.
        family: all leads of the page.
    """
    sentences = []
    for discipline in DISCIPLINES:
        own = [race for race in found if race.discipline == discipline]
        leads = [(race, lead) for race in own for lead in race.leads if lead.starters > 1]
        if not leads:
            continue
        won: dict[str, dict[str, list[str]]] = {}
        for race, lead in leads:
            if family.significant(lead.p):
                where = won.setdefault(lead.method, {}).setdefault(race.dataset, [])
                where.append(_limit(race, lead, family))
        parts: list[str] = []
        for name in sorted(won, key=lambda name: (-sum(map(len, won[name].values())), name)):
            places = (f"{dataset} ({', '.join(at)})" for dataset, at in won[name].items())
            parts.append(f"{label(name)}{'' if parts else ' leads significantly'} on {', '.join(places)}")
        undecided = sum(not family.significant(lead.p) for _, lead in leads)
        limits = counted(len(leads), "limit")
        datasets = counted(len({race.dataset for race, _ in leads}), "dataset")
        if not parts:
            parts.append(f"no lead is significant at {limits} on {datasets}")
        elif undecided:
            parts.append(f"{undecided} of {limits} on {datasets} are not significant")
        lacking = list(dict.fromkeys(label(name) for race, _ in leads for name in race.others))
        parts += (
            [f"without {enumeration(lacking)}, not finished or measured on all scenes"] if lacking else []
        )
        sentences.append(f"At equal {discipline.noun}, {'; '.join(parts)} ({family.size}).")
    return sentences


HEADS = (
    "Equal", "Dataset", "Limit", "Leader", "PSNR [dB]", "Training", "Memory [MiB]", "Ahead of", "By [dB]",
    "95 %", "p (corrected)", "Seeds", "Methods",
)  # fmt: skip
"""Of :func:`row`."""


def row(race: Race, lead: Lead, family: Family) -> list[str]:
    """A line of the table of leads.

    Args:
        race: of the lead.
        lead: at a limit.
        family: all leads of the page.
    """
    name = label(lead.method)
    cells = [race.discipline.noun, race.dataset, race.discipline.text(lead.limit)]
    nearest = lead.nearest(family)
    decided = nearest is None or family.significant(lead.p)
    cells += [name if decided else f"not significant ({name})", f"{lead.psnr:.2f}"]
    time, memory = lead.expense
    cells += [MISSING if time is None else seconds(time), MISSING if memory is None else mib(memory)]
    starters = f"{lead.starters} of {race.methods}"
    if nearest is None:
        return [*cells, "alone", "", "", "", "", starters]
    rival, ahead = nearest
    low_high = ahead.ends
    ends = "" if low_high is None else " to ".join(map(signed, low_high))
    least, most = ahead.seeds
    seeds = str(least) if least == most else f"{least} to {most}"
    gap = ", ".join(filter(None, [f"{ahead.mean:.2f}", race.closeness(lead, family)]))
    return [*cells, label(rival), gap, ends, family.text(lead.p), seeds, starters]
