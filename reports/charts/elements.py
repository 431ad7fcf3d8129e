"""The elements of the page's sections of charts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from html import escape

from econgs_bench.reports import markup
from econgs_bench.reports.charts import svg
from econgs_bench.reports.charts.chart import Chart, Panel
from econgs_bench.reports.style import Look

MOST_PANELS = 16
"""Panels of a section on the page."""
_LONG = 45  # characters of a cell that are not broken


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        anchor: id of its heading.
        title: text of its heading, not escaped.
        html: its content.
        charts: file name -> chart, for the files beside the page.
    """

    anchor: str
    title: str
    html: str
    charts: dict[str, Chart] = field(default_factory=dict)


def annotated(section: Section) -> Section:
    """The section with the remarks of its charts at its end."""
    notes = dict.fromkeys(chart.note for chart in section.charts.values() if chart.note)
    html = "".join(f'<p class="note">{escape(note)}</p>' for note in notes)
    return replace(section, html=section.html + html)


def cards(panels: Iterable[Panel]) -> str:
    """Panels with their titles, side by side, as many as the page has room for."""
    every = list(panels)
    chosen = "".join(card(panel, panel.title) for panel in every[:MOST_PANELS])
    return f'<div class="charts">{chosen}</div>{rest(len(every), MOST_PANELS, "panels")}'


def rest(count: int, most: int, noun: str) -> str:
    """A note on what the page has no room for; "" if it has all."""
    if count <= most:
        return ""
    text = f"The first {most} of {count} {noun}; the files in <code>charts/</code> hold all."
    return f'<p class="note">{text}</p>'


def card(panel: Panel, caption: str) -> str:
    """A panel with a caption."""
    head = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure class="card">{head}{svg.page_panel(panel)}</figure>'


def table(caption: str, heads: Sequence[str], rows: list[list[str]]) -> str:
    """A table whose long cells are broken."""
    return markup.table(caption, heads, ([_cell(text) for text in row] for row in rows))


def _cell(text: str) -> str:
    if len(text) <= _LONG:
        return escape(text)
    return f'<span style="display:block;white-space:normal;min-width:34ch">{escape(text)}</span>'


def legend(entries: dict[str, Look]) -> str:
    """Names of lines, marks and areas with a sample of each; "" for a single one."""
    if len(entries) < 2:
        return ""
    items = " &ensp; ".join(
        '<span style="white-space:nowrap"><svg class="swatch" width="26" height="12" aria-hidden="true">'
        f"{svg.swatch(look)}</svg> {escape(name)}</span>"
        for name, look in entries.items()
    )
    return f'<p class="note">{items}</p>'
