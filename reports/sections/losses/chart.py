"""The chart of the parts of the loss."""

from __future__ import annotations

from econgs_bench.reports.charts.chart import Chart, Panel, Series, Text, linear_axis, log_axis, room_for
from econgs_bench.reports.sections.losses.table import Losses
from econgs_bench.reports.style import PALETTE, Look

_MARKED = 16
"""Points up to which a line has marks at them."""


def losses_chart(panels: list[Losses]) -> Chart:
    """Parts of the loss (log) over iterations, a panel per dataset and method.

    A part has the same color in all panels; the whole is black.
    """
    names = list(dict.fromkeys(part.name for panel in panels for part in panel.parts[1:]))
    shades = {name: PALETTE[i % (len(PALETTE) - 1)] for i, name in enumerate(names)}
    parts = []
    for panel in panels:
        room = room_for([part.name for part in panel.parts])
        x = linear_axis([v for part in panel.parts for v in part.x], "iteration", start=0.0, room=room)
        y = log_axis([v for part in panel.parts for v in part.y], "loss")
        series, labels = [], []
        for i, part in enumerate(panel.parts):
            shade = shades[part.name] if i else PALETTE[-1]
            look, width = Look(shade, "circle", "solid"), 2.4 if part.name == "loss" else 1.6
            mark = 0.0 if len(part.x) > _MARKED else 4.0
            series.append(Series(part.name, part.x, part.y, look, width, mark))
            labels.append(Text(part.x[-1], part.y[-1], part.name, shade))
        title = f"{panel.dataset} \N{MIDDLE DOT} {panel.title}"
        parts.append(Panel(title, x, y, series, labels, along=True, stages=panel.marks))
    return Chart(parts)
