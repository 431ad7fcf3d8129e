"""How far each method climbs each ladder, and how it breaks: a heat map, and its section of the page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from econgs_bench.reports.charts.chart import Axis, Bar, Chart, Panel
from econgs_bench.reports.charts.labels import text_width
from econgs_bench.reports.sections.ladders.conclusion import title, words
from econgs_bench.reports.sections.ladders.table import held
from econgs_bench.reports.style import BLACK, BLUE, ORANGE, PINK, SKY, VERMILLION, Look, label
from econgs_bench.reports.text import short_name

KINDS = {
    "quality": SKY, "floaters": ORANGE, "vanishing parts": PINK, "explosion": BLUE,
    "collapse": VERMILLION, "failed step": BLACK,
}  # fmt: skip
"""Kind of break -> its color; all kinds of failed steps have one."""
_COLORS = {"holds": "#A8D5C5", **KINDS, "not measured": "#dddddd"}
_SPAN = 0.92
"""Share of a column's width that a ladder's rungs take."""
_GAP = 0.012
"""Half of the gap between two rungs, in columns."""
_COLUMN, _ROW = 104.0, 25.0
_WIDEST = 880.0
"""Width of a panel's columns in pixels."""


def kind_of(failure: str) -> str:
    """The key of :data:`KINDS` of a kind of break."""
    return failure if failure in KINDS else "failed step"


def anchor(prefix: str, name: str) -> str:
    """Id of a place on the page, of a ladder or method."""
    return short_name(f"{prefix}-{re.sub('[^a-z0-9]+', '-', name.lower()).strip('-')}")


def ladder_chart(climbs: Sequence[dict[str, Any]]) -> Chart:
    """A row per ladder and a column per method: a field for each rung above the usual run.

    Panels hold as many methods as can be read side by side, and the ladders that these were asked to climb.

    Args:
        climbs: as of :func:`.reports.sections.ladders.table.climbed`.
    """
    columns: list[list[str]] = [[]]
    for pair in sorted({(row["method"], row["variant"]) for row in climbs}):
        name = label(*pair)
        if columns[-1] and (len(columns[-1]) + 1) * _width([*columns[-1], name]) > _WIDEST:
            columns.append([])
        columns[-1].append(name)
    titles = [title(row, climbs) for row in climbs]
    panels = [
        _panel(names, [pair for pair in zip(climbs, titles, strict=True) if _method(pair[0]) in names])
        for names in columns
    ]
    used = {bar.color for panel in panels for bar in panel.bars}
    looks = {kind: Look(color, "square", "") for kind, color in _COLORS.items() if color in used}
    return Chart(panels, looks)


def _width(columns: Sequence[str]) -> float:
    """Pixels of a column."""
    return max(_COLUMN, *(text_width(name) + 14.0 for name in columns))


def _method(row: dict[str, Any]) -> str:
    return label(row["method"], row["variant"])


def _panel(columns: Sequence[str], climbs: Sequence[tuple[dict[str, Any], str]]) -> Panel:
    """The climbs of some methods, with the titles of their ladders."""
    rows = list(dict.fromkeys(name for _, name in climbs))
    bars = []
    for row, ladder in climbs:
        method = _method(row)
        about = "\n".join([f"{method}, {ladder}: {row['purpose']}", _outcome(row)])
        left, width = columns.index(method) - 0.5 * _SPAN, _SPAN / (row["rungs"] - 1)
        for place in range(1, row["rungs"]):
            failure = row["outcomes"].get(place)
            kind = kind_of(failure) if failure else "holds" if place in row["outcomes"] else "not measured"
            start = left + width * (place - 1)
            bars.append(Bar(rows.index(ladder), start + _GAP, start + width - _GAP, _COLORS[kind], about))
    x = Axis(
        "", -0.5, len(columns) - 0.5, ticks=tuple(enumerate(columns)), grid=False, above=True,
        links={name: anchor("method", name) for name in columns},
    )  # fmt: skip
    y = Axis(
        "", len(rows) - 0.5, -0.5, ticks=tuple(enumerate(rows)), grid=False,
        links={name: anchor("ladder", row["ladder"]) for row, name in climbs},
    )  # fmt: skip
    heads = 20.0 + max(map(text_width, rows))
    width, height = heads + _width(columns) * len(columns), 32.0 + _ROW * len(rows)
    return Panel("", x, y, bars=bars, width=width, height=height)


def _outcome(row: dict[str, Any]) -> str:
    if row["failure"] is not None:
        return f"first breaks at {words(row)}"
    if len(row["outcomes"]) == row["rungs"]:
        return "holds on all rungs"
    return f"holds on the {held(row)} measured of {row['rungs'] - 1} rungs"
