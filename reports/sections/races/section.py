"""Races: the charts and the table of leads (:mod:`.reports.sections.races.conclusion`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from econgs_bench.reports.charts.chart import Chart
from econgs_bench.reports.charts.tradeoff import XY, Spot, Tradeoff, TradeoffLine, tradeoff_chart
from econgs_bench.reports.floors import mean
from econgs_bench.reports.sections.races.conclusion import (
    DISCIPLINES,
    HEADS,
    Race,
    conclusion,
    of_report,
    row,
)
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import Model, label, model_named
from econgs_bench.reports.tables.table import Table

_POINTS = 33
"""Costs at which a line is read off, beside those of the models."""
_WORDS = (
    "The best picture of each method within a limit, over all lengths of its schedule and all rates: linear "
    "in the logarithm of the cost between two models on the front, level beyond the largest. A line starts "
    "where its method has a model of every scene. Lines are means over scenes and seeds; bands reach from "
    "the lowest seed to the highest. Training times are of one processor."
)
_NOTE = (
    "Training and memory are of the leader's largest models within the limit, geometric means per scene. A "
    "lead counts if it is significant on every other method: Student's t over scenes and seeds, with "
    "Holm's correction over all leads of this page; the p-value is the largest of a lead. An interval is "
    "of one lead alone, without the correction."
)


def section(page: Page) -> Section | None:
    """Who leads at equal time, bytes and Gaussians; None where no method has several models."""
    found = of_report(page.report)
    if not found:
        return None
    charts = {}
    for discipline in DISCIPLINES:
        if own := [race for race in found if race.discipline == discipline]:
            chart = race_chart(own, page.report.models)
            name = f"race-{discipline.column.partition('_')[0]}"
            charts[name] = replace(chart, title=f"Equal {discipline.noun}")
    lines = [row(race, lead, page.family) for race in found for lead in race.leads]
    table = Table("Who leads at which limit", HEADS, lines)
    answer = conclusion(found, page.family)
    return Section("races", "Races: quality at equal cost", answer, _WORDS, charts, [table], _NOTE)


def race_chart(found: Sequence[Race], models: list[Model]) -> Chart:
    """Best mean PSNR over cost (log), a panel per dataset, a line and a band per method.

    Args:
        found: races of one discipline.
        models: all of the report.
    """
    panels = []
    for race in found:
        last = max(cost for name in race.fronts for cost in race.costs(name))
        lines = [_line(race, name, last) for name in race.fronts]
        floor = mean(race.floors.values())
        panels.append(Tradeoff(race.dataset, race.discipline.title, lines, better=0, floor=floor))
    return tradeoff_chart(panels, models)


def _line(race: Race, name: str, last: float) -> TradeoffLine:
    """Band (with several seeds), line and marks of a method, up to a cost."""
    costs = race.costs(name)
    grid = sorted({*costs, *np.geomspace(costs[0], last, _POINTS)[1:].tolist()})
    path = _points(race, name, grid)
    band: list[XY] = []
    seeds = race.seeds(name)
    if len(seeds) > 1:
        across = [cost for cost, _ in path]
        each = [dict(_points(race, name, across, seed)) for seed in seeds]
        low, high = ([(cost, end(one[cost] for one in each)) for cost in across] for end in (min, max))
        band = [*high, *low[::-1]]
    marks = [Spot(*point) for point in _points(race, name, costs)]
    return TradeoffLine(model_named(name), marks, path=path, band=band, title=label(name))


def _points(race: Race, name: str, costs: Sequence[float], seed: Any = None) -> list[XY]:
    """Mean PSNR at each of these costs, all of which a method holds."""
    means = [(cost, race.mean(name, cost, seed)) for cost in costs]
    return [(cost, mean) for cost, mean in means if mean is not None]
