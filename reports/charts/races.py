"""The charts and the section of the races (:mod:`.reports.conclusions.races`)."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from econgs_bench.reports.charts.chart import Chart, Panel, Series, Text, broken_axis, log_axis, room_for
from econgs_bench.reports.charts.elements import Section, cards, legend, table
from econgs_bench.reports.charts.levels import with_floor
from econgs_bench.reports.conclusions.races import DISCIPLINES, HEADS, Race, conclusion, row
from econgs_bench.reports.floors import mean
from econgs_bench.reports.style import Look, Model, label, look, model_named

if TYPE_CHECKING:
    from econgs_bench.reports.charts.report import Report

_POINTS = 33
"""Costs at which a line is read off, beside those of the models."""
_MOST_NAMES = 7
"""Methods that are named at the ends of their lines; more have a legend."""
_WORDS = (
    "The best picture of each method at a limit: of its models of a scene, at all lengths of its schedule "
    "and all rates, linear in the logarithm of the cost between two on the front, level beyond the largest. "
    "A method starts where it has a model of every scene. "
    "Lines are means over scenes and seeds, bands reach from the lowest seed to the highest. Training times "
    "are of one processor, divided by how much slower than usual it was. Training and memory are of the "
    "leader's largest models within the limit, geometric means per scene. A lead counts where it is "
    "significant on every other method: Student's t over scenes and seeds, with Holm's correction over all "
    "leads of this page; the table has the largest p-value of a lead. An interval is of one lead alone, "
    "without the correction."
)


def race_chart(found: Sequence[Race], models: list[Model]) -> Chart:
    """Best mean PSNR over cost (log), a panel per dataset, a line and a band per method.

    Args:
        found: races of one discipline.
        models: all of the report.
    """
    panels = []
    for race in found:
        last = max(cost for name in race.fronts for cost in race.costs(name))
        series, labels, heights = [], [], []
        for name in race.fronts:
            style = look(model_named(name), models)
            own = _series(race, name, last, style)
            series += own
            heights.append([value for one in own for value in one.y])
            labels.append(Text(own[-2].x[-1], own[-2].y[-1], label(name), style.color))
        few = len(labels) <= _MOST_NAMES
        room = room_for([one.text for one in labels]) if few else 0.0
        x = log_axis([value for one in series for value in one.x], race.discipline.title, room=room)
        y = broken_axis(heights, "PSNR [dB]", least=2.0)
        drawn = Panel(race.dataset, x, y, series, labels if few else ())
        panels.append(with_floor(drawn, mean(race.floors.values())))
    names = dict.fromkeys(name for race in found for name in race.fronts)
    crowded = any(len(race.fronts) > _MOST_NAMES for race in found)
    return Chart(panels, {label(name): look(model_named(name), models) for name in names} if crowded else {})


def _series(race: Race, name: str, last: float, style: Look) -> list[Series]:
    """Band (with several seeds), line and marks of a method, up to a cost."""
    costs = race.costs(name)
    grid = sorted({*costs, *np.geomspace(costs[0], last, _POINTS)[1:].tolist()})
    line = _spots(race, name, grid)
    across = [cost for cost, _ in line]
    found = []
    seeds = race.seeds(name)
    if len(seeds) > 1:
        each = [dict(_spots(race, name, across, seed)) for seed in seeds]
        low, high = ([end(one[cost] for one in each) for cost in across] for end in (min, max))
        outline = [*across, *across[::-1]], [*high, *low[::-1]]
        found.append(Series("", *outline, Look(style.color, "", "solid"), fill=True, opacity=0.15))
    found.append(Series("", across, [psnr for _, psnr in line], style, line=1.6))
    marks = _spots(race, name, costs)
    x, y = [cost for cost, _ in marks], [psnr for _, psnr in marks]
    return [*found, Series(label(name), x, y, style, mark=6.0, names=[""] * len(marks))]


def _spots(race: Race, name: str, costs: Sequence[float], seed: Any = None) -> list[tuple[float, float]]:
    """Mean PSNR at each of these costs, all of which a method holds."""
    means = [(cost, race.mean(name, cost, seed)) for cost in costs]
    return [(cost, mean) for cost, mean in means if mean is not None]


def races_section(report: Report) -> Section | None:
    """Who leads at equal time, bytes and Gaussians; None where no method has several models."""
    found = report.races
    if not found:
        return None
    charts, parts = {}, []
    for discipline in DISCIPLINES:
        own = [race for race in found if race.discipline == discipline]
        if not own:
            continue
        chart = race_chart(own, report.models)
        charts[f"race-{discipline.column.partition('_')[0]}"] = chart
        parts.append(f"<h3>Equal {escape(discipline.noun)}</h3>{legend(chart.legend)}{cards(chart.panels)}")
    lines = [row(race, lead, report.family) for race in found for lead in race.leads]
    html = (
        f"<p><b>{escape(' '.join(conclusion(found, report.family)))}</b></p><p>{_WORDS}</p>{''.join(parts)}"
        f"{table('Who leads at which limit', HEADS, lines)}"
    )
    return Section("races", "Races: quality at equal cost", html, charts)
