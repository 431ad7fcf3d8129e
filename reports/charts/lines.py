"""Charts of lines that are named at their ends or by a legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from econgs_bench.reports.charts.chart import Chart, Panel, Series, Text, broken_axis, log_axis, room_for
from econgs_bench.reports.charts.levels import with_floor
from econgs_bench.reports.floors import Floor
from econgs_bench.reports.style import OTHERS, Look, Model, legend_entries, looks


@dataclass(frozen=True)
class Line:
    """A line of a chart.

    Attributes:
        model: whose, which decides the color.
        title: its label.
        x: ascending.
        y: one per x.
    """

    model: Model
    title: str
    x: list[float]
    y: list[float]


Panels = Mapping[str, Sequence[Line]]
"""Title -> lines."""
_MOST_POINTS = 40
"""Points of a drawn line."""
_MOST_ENDS = 6
"""Lines that are named at their ends; more of them crowd where they meet."""


def lines(
    panels: Panels,
    x: str,
    y: str,
    models: list[Model],
    *,
    log_y: bool = False,
    floors: Mapping[str, Floor | None] = MappingProxyType({}),
) -> Chart:
    """Lines named at their ends, a panel per dataset; where there are too many a legend names them.

    Args:
        panels: dataset -> lines.
        x: title of the horizontal axis, which is logarithmic.
        y: title of the vertical axis.
        models: all of the report.
        log_y: whether y is logarithmic.
        floors: panel -> noise floor of its truth, where y is PSNR.
    """
    parts = []
    for title, curves in panels.items():
        styles = looks([curve.model for curve in curves], models)
        few = len(curves) <= _MOST_ENDS
        names = [curve.title for curve in curves] if few else []
        series = []
        for curve in map(_thinned, sorted(curves, key=lambda curve: list(styles).index(curve.model))):
            look = styles[curve.model]
            line, mark = (0.8, 3.0) if look is OTHERS else (1.6, 4.5)
            series.append(Series(curve.title, curve.x, curve.y, look, line=line, mark=mark))
        drawn = Panel(
            title,
            log_axis([v for curve in curves for v in curve.x], x, room=room_for(names)),
            log_axis([v for curve in curves for v in curve.y], y)
            if log_y
            else broken_axis([curve.y for curve in curves], y, least=2.0),
            series,
            [Text(c.x[-1], c.y[-1], c.title, styles[c.model].color) for c in curves] if few else [],
            [spot for c in curves for spot in zip(c.x, c.y, strict=True)] if few else [],
        )
        parts.append(with_floor(drawn, floors.get(title)))
    crowded = any(len(curves) > _MOST_ENDS for curves in panels.values())
    return Chart(parts, legend_of(panels, models) if crowded else {})


def _thinned(line: Line) -> Line:
    """A line with at most :data:`_MOST_POINTS` points, spread evenly over the axis, the ends among them."""
    if len(line.x) <= _MOST_POINTS:
        return line
    places = np.searchsorted(line.x, np.geomspace(max(line.x[0], 1e-9), line.x[-1], _MOST_POINTS))
    chosen = np.unique(np.clip([0, *places], 0, len(line.x) - 1)).tolist()
    return replace(line, x=[line.x[i] for i in chosen], y=[line.y[i] for i in chosen])


def legend_of(panels: Panels, models: list[Model]) -> dict[str, Look]:
    """The legend of the charts of these lines."""
    return legend_entries([[curve.model for curve in curves] for curves in panels.values()], models)
