"""A report's tables, and what several of its parts show."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from reports.charts import rate_distortion
from reports.conclusions.answers import answers
from reports.conclusions.contest import contests
from reports.statistics import Views
from reports.style import Model, models
from reports.tables import confidence
from reports.tables.means import summary
from reports.tables.protocols import by_protocol
from reports.tables.ranks import ranks

if TYPE_CHECKING:
    import pandas as pd

    from reports.charts.rate_distortion import Curve, Difference
    from reports.conclusions.answers import Answer
    from reports.conclusions.contest import Contest


class Report:
    """What page, files and charts are made from; each value is computed once, when it is first used.

    Args:
        tables: the tables of :mod:`reports.schema`.

    Attributes:
        stored: the tables.
        tables: the same :func:`~reports.tables.protocols.by_protocol`.
    """

    def __init__(self, tables: dict[str, pd.DataFrame]) -> None:
        self.stored = tables
        self.tables = by_protocol(tables)
        self.results = self.tables["results"]
        self.views = Views(tables["views"])

    @cached_property
    def models(self) -> list[Model]:
        """The models that have looks."""
        return models(self.results, self.tables["curve"], self.tables["features"])

    @cached_property
    def means(self) -> pd.DataFrame:
        return summary(self.results)

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
        return answers(self.contests[0], self.results) if self.contests else []

    @cached_property
    def at_shared_seeds(self) -> pd.DataFrame:
        """The results of basic scenes, at the seeds that all points of a curve have."""
        return rate_distortion.with_shared_seeds(self.results[self.results["kind"] == "basic"])

    @cached_property
    def curves(self) -> dict[str, list[Curve]]:
        return rate_distortion.curves(self.at_shared_seeds)

    @cached_property
    def differences(self) -> list[Difference]:
        return rate_distortion.differences(self.curves)
