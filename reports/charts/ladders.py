"""How far each method climbs each ladder, and how it breaks: a chart, and its section of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from reports.charts.chart import Axis, Bar, Chart, Panel
from reports.charts.elements import Section, card, legend, table
from reports.schema import COLUMNS
from reports.style import MISSING, PALETTE, Look, absent, label
from reports.tables.ladders import climbed

if TYPE_CHECKING:
    from reports.charts.report import Report

_HELD = "#A8D5C5"
_KINDS = {
    "quality": PALETTE[4], "floaters": PALETTE[5], "vanishing parts": PALETTE[3], "explosion": PALETTE[0],
    "collapse": PALETTE[1],
}  # fmt: skip
_FAILED = PALETTE[7]
_SPAN = 0.9
"""Share of a column's width that a bar takes."""
_COLUMN, _ROW = 100.0, 26.0
_CONDITIONS = ("preset", "split", "requested_views")


def ladder_chart(climbs: Sequence[dict[str, Any]]) -> Chart:
    """A row per ladder and a column per method: the part of the rungs that hold, then the kind of the break.

    Args:
        climbs: as of :func:`reports.tables.ladders.climbed`.
    """
    rows = list(dict.fromkeys(_title(row, climbs) for row in climbs))
    columns = list(dict.fromkeys(label(row["method"], row["variant"]) for row in climbs))
    bars = []
    used = {}
    for row in climbs:
        y = rows.index(_title(row, climbs))
        left = columns.index(label(row["method"], row["variant"])) - 0.5 * _SPAN
        held = left + _SPAN * row["held"] / row["rungs"]
        about = "\n".join([f"{columns[round(left + 0.5 * _SPAN)]}, {rows[y]}", *_words(row)])
        bars.append(Bar(y, left, held, _HELD, about))
        if row["failure"] is not None:
            kind = row["failure"] if row["failure"] in _KINDS else "failed step"
            used[kind] = _KINDS.get(kind, _FAILED)
            bars.append(Bar(y, held, left + _SPAN, used[kind], about))
    x = Axis(
        "", -0.5, len(columns) - 0.5, ticks=tuple((i, name) for i, name in enumerate(columns)), grid=False
    )
    names = tuple((i, name) for i, name in enumerate(rows))
    upright = Axis("", len(rows) - 0.5, -0.5, ticks=names, grid=False)
    width, height = 130.0 + _COLUMN * len(columns), 52.0 + _ROW * len(rows)
    colors = {"holds": _HELD} | {kind: used[kind] for kind in (*_KINDS, "failed step") if kind in used}
    looks = {kind: Look(color, "square", "") for kind, color in colors.items()}
    return Chart([Panel("", x, upright, bars=bars, width=width, height=height)], looks)


def _title(row: dict[str, Any], climbs: Sequence[dict[str, Any]]) -> str:
    """The ladder, with its conditions where there are several."""
    several = [name for name in _CONDITIONS if len({other[name] for other in climbs}) > 1]
    return " ".join([row["ladder"], *(f"{row[name]}" for name in several)])


def _words(row: dict[str, Any]) -> list[str]:
    if row["failure"] is None:
        return [f"holds on {row['measured']} of {row['rungs']} rungs"]
    where = f" on {row['subject']}" if row["subject"] else ""
    return [f"breaks at {row['rung']}{where}: {row['failure']}"]


def ladders_section(report: Report) -> Section | None:
    """The chart, and every first break in a table; None without ladders."""
    climbs = climbed(report.ladders)
    if not climbs:
        return None
    chart = ladder_chart(climbs)
    words = (
        "A ladder leads from the usual run to one that no method may survive. A bar is a ladder's rungs: in "
        "light green those that hold, then, from the first break on, the kind of that break. Of several "
        "scenes the one counts on which the method comes least far. A rung breaks where a step fails or "
        "where, against the usual run, PSNR falls by 3 dB, a fifth of the truth's alpha more is missing or "
        "in excess, or there are more than 5 times the primitives. Where a rung has other test pictures, its "
        "fall is that of the distance to the best method. All rungs: "
        '<a href="ladders.csv">ladders</a>.'
    )
    heads = ["Method", "Ladder", "Holds", "Breaks at", "Scene", "Break", "Change [dB]", "Missing [%]"]
    rows = [
        [
            label(row["method"], row["variant"]),
            _title(row, climbs),
            f"{row['held']} of {row['rungs']}",
            *(row[name] or MISSING for name in ("rung", "subject", "failure")),
            MISSING if absent(row["change"]) else COLUMNS["change"].text(row["change"]),
            MISSING if absent(row["missing"]) else f"{100.0 * row['missing']:.0f}",
        ]
        for row in sorted(climbs, key=lambda row: (row["method"], row["variant"]))
        if row["failure"] is not None
    ]
    found = table("Where each method breaks first", heads, rows) if rows else "<p>Nothing breaks.</p>"
    html = f"<p>{words}</p>{legend(chart.legend)}{card(chart.panels[0], '')}{found}"
    return Section("ladders", "Where methods break", html, {"ladders": chart})
