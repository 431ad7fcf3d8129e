"""The tables of a report, and what several of its questions compute from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, wraps
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from econgs_bench.reports.clocks import Clocks
from econgs_bench.reports.comparability import Remark, compared, judged, remarks
from econgs_bench.reports.curves import curves, with_shared_seeds
from econgs_bench.reports.schema import frame
from econgs_bench.reports.statistics import Views
from econgs_bench.reports.style import Model, absent, models
from econgs_bench.reports.tables.means import summary
from econgs_bench.reports.tables.protocols import by_protocol
from econgs_bench.reports.tables.ranks import ranks

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.curves import Curve

T = TypeVar("T")


def once(compute: Callable[[Report], T]) -> Callable[[Report], T]:
    """A function of a report that computes its value once for each report."""

    @wraps(compute)
    def value(report: Report) -> T:
        if compute not in report.computed:
            report.computed[compute] = compute(report)
        found: T = report.computed[compute]
        return found

    return value


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
        whole: the report that this is a part of.

    Attributes:
        stored: the tables.
        measured: their results :func:`~.reports.tables.protocols.by_protocol`.
        tables: the same of all tables, with what is compared (:func:`.reports.comparability.compared`).
        results: the results among them; their index is that of the same rows of ``measured``.
        whole: the report that this is a part of, or itself. Looks, races and tests are the whole's.
        computed: values of functions (:func:`once`).
    """

    def __init__(self, tables: dict[str, pd.DataFrame], whole: Report | None = None) -> None:
        self.stored = tables
        protocols = by_protocol(tables)
        self.measured = protocols["results"]
        self.tables = compared(protocols)
        self.results = self.tables["results"]
        self.views = Views(tables["views"])
        self.whole = whole or self
        self.computed: dict[Callable[..., Any], Any] = {}

    def table(self, name: str) -> pd.DataFrame:
        """A stored table; without rows where the tables lack it."""
        return self.stored[name] if name in self.stored else frame(name)

    @cached_property
    def clocks(self) -> Clocks:
        """Quiet times of the machines."""
        return Clocks(self.stored["results"])

    @cached_property
    def models(self) -> list[Model]:
        """The models that have looks; those of curves are without their rate knob."""
        if self.whole is not self:
            return self.whole.models
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
        return self._part(lambda model, varied: not varied or model not in default)

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
        results = tables["results"]
        if "differences" in results and len(results) < len(self.stored["results"]):
            # Rows that are no part of it choose no place of its times.
            tables["results"] = judged(results, self.whole.clocks)
        return Report(tables, self.whole)

    @cached_property
    def means(self) -> pd.DataFrame:
        return summary(self.results)

    @cached_property
    def ranks(self) -> dict[tuple[Any, str], int]:
        """Of the rows of :attr:`results`."""
        return ranks(self.results, self.views)

    @cached_property
    def at_shared_seeds(self) -> pd.DataFrame:
        """The results of basic scenes, at the seeds that all points of a curve have."""
        return with_shared_seeds(self.results[self.results["kind"] == "basic"])

    @cached_property
    def curves(self) -> dict[str, list[Curve]]:
        return curves(self.at_shared_seeds)
