"""A report's tables, and what several of its parts show."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from econgs_bench.reports.comparability import Remark, compared, remarks
from econgs_bench.reports.conclusions.answers import CRITERIA, answers, compare
from econgs_bench.reports.conclusions.contest import contests
from econgs_bench.reports.conclusions.economy import economies
from econgs_bench.reports.conclusions.family import Family
from econgs_bench.reports.conclusions.races import races
from econgs_bench.reports.conclusions.rates import differences, p_values
from econgs_bench.reports.curves import curves, with_shared_seeds
from econgs_bench.reports.schema import frame
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.style import Model, absent, models
from econgs_bench.reports.tables import confidence
from econgs_bench.reports.tables.ladders import ladders
from econgs_bench.reports.tables.means import summary
from econgs_bench.reports.tables.protocols import by_protocol
from econgs_bench.reports.tables.ranks import ranks

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.conclusions.answers import Answer
    from econgs_bench.reports.conclusions.contest import Contest
    from econgs_bench.reports.conclusions.economy import Economy
    from econgs_bench.reports.conclusions.races import Race
    from econgs_bench.reports.conclusions.rates import Difference
    from econgs_bench.reports.curves import Curve


def _cells(table: pd.DataFrame) -> Iterator[tuple[tuple[Any, ...], bool]]:
    """Dataset, preset and method of each row, and whether it is of a variant of options."""
    columns = (table[name].tolist() for name in ("dataset", "preset", "method", "base"))
    for *model, base in zip(*columns, strict=True):
        yield tuple(model), not absent(base) and base != ""


def _models(results: pd.DataFrame, *, varied: bool) -> set[tuple[Any, ...]]:
    return {model for model, variant in _cells(results) if variant == varied}


class Report:
    """What page, files and charts are made from; each value is computed once, when it is first used.

    Args:
        tables: the tables of :mod:`.reports.schema`.

    Attributes:
        stored: the tables.
        measured: their results :func:`~.reports.tables.protocols.by_protocol`.
        tables: the same of all tables, with what is compared (:func:`.reports.comparability.compared`).
        results: the results among them; their index is that of the same rows of ``measured``.
    """

    def __init__(self, tables: dict[str, pd.DataFrame]) -> None:
        self.stored = tables
        protocols = by_protocol(tables)
        self.measured = protocols["results"]
        self.tables = compared(protocols)
        self.results = self.tables["results"]
        self.views = Views(tables["views"])
        self._whole = self

    @cached_property
    def models(self) -> list[Model]:
        """The models that have looks; those of curves are without their rate knob."""
        rows = models(self.results, self.tables["curve"], self.tables["features"])
        return list(dict.fromkeys([*rows, *models(self.results, column="base")]))

    @cached_property
    def remarks(self) -> list[Remark]:
        """What is not compared, and why."""
        return remarks(self.measured, self.stored.get("superseded"))

    @cached_property
    def of_defaults(self) -> Report:
        """The same without variants of options, where a method has its default as well.

        Values of a rate knob are no variants: they are points of one curve.
        """
        default = _models(self.stored["results"], varied=False)
        part = self._part(lambda model, varied: not varied or model not in default)
        part.races = self.races  # other lengths of a schedule race
        return part

    @cached_property
    def of_variants(self) -> Report | None:
        """The methods with variants of options, on the datasets that have them; None without any."""
        varied = _models(self.stored["results"], varied=True)
        return self._part(lambda model, _: model in varied) if varied else None

    def _part(self, chosen: Callable[[tuple[Any, ...], bool], bool]) -> Report:
        """The rows whose dataset, preset and method, and whether they are of a variant, are chosen."""
        tables = {
            name: table[np.array([chosen(*row) for row in _cells(table)], bool)] if "base" in table else table
            for name, table in self.stored.items()
        }
        part = Report(tables)
        part.models = self.models  # a model has one look in all parts of the page
        part._whole = self._whole
        return part

    @cached_property
    def means(self) -> pd.DataFrame:
        return summary(self.results)

    @cached_property
    def ladders(self) -> pd.DataFrame:
        """Rungs with their breaks."""
        return ladders(self.stored["rungs"] if "rungs" in self.stored else frame("rungs"))

    @property
    def rung_views(self) -> pd.DataFrame:
        """Views of rungs."""
        return self.stored["rung_views"] if "rung_views" in self.stored else frame("rung_views")

    @cached_property
    def ranks(self) -> dict[tuple[Any, str], int]:
        """Of the rows of :attr:`results`."""
        return ranks(self.results, self.views)

    @cached_property
    def intervals(self) -> pd.DataFrame:
        return confidence.intervals(self.results, self.means, self.views)

    @cached_property
    def comparisons(self) -> pd.DataFrame:
        return confidence.comparisons(self.means, self.views)

    @cached_property
    def contests(self) -> list[Contest]:
        """The one with the most comparisons first."""
        return contests(self.results)

    @cached_property
    def answers(self) -> list[Answer]:
        """Of the first contest; empty without one."""
        if not self.contests:
            return []
        return answers(self.contests[0], self.results, self.ladders, self.family)

    @property
    def family(self) -> Family:
        """All leads of the page, whichever part of it asks."""
        return self._whole._family

    @cached_property
    def _family(self) -> Family:
        compared = [compare(each, contest) for contest in self.contests[:1] for each in CRITERIA]
        of_answers = [one.p for one in compared if one is not None]
        of_races = [lead.p for race in self.races for lead in race.leads]
        return Family.of([*of_answers, *of_races, *p_values(self.of_defaults.differences)])

    @cached_property
    def races(self) -> list[Race]:
        """Of all disciplines and datasets."""
        return races(self.results)

    @cached_property
    def at_shared_seeds(self) -> pd.DataFrame:
        """The results of basic scenes, at the seeds that all points of a curve have."""
        return with_shared_seeds(self.results[self.results["kind"] == "basic"])

    @cached_property
    def curves(self) -> dict[str, list[Curve]]:
        return curves(self.at_shared_seeds)

    @cached_property
    def economies(self) -> list[Economy]:
        complexity = self.stored["complexity"] if "complexity" in self.stored else frame("complexity")
        return economies(self.at_shared_seeds, complexity)

    @cached_property
    def differences(self) -> list[Difference]:
        return differences(self.curves, self.views, self.at_shared_seeds)
