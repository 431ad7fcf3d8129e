"""What the page's sections of charts are made of."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape

from reports.charts import plots
from reports.page import markup
from reports.style import DARK, Look

_LONG = 45  # characters of a cell that are not broken


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        anchor: id of its heading.
        title: text of its heading, not escaped.
        html: what stands under the heading.
    """

    anchor: str
    title: str
    html: str


def charts(figures: Iterable[tuple[str, plots.Figure]]) -> str:
    """Charts with their captions, side by side."""
    return "".join(chart(figure, caption) for caption, figure in figures)


def chart(figure: plots.Figure, caption: str) -> str:
    """A chart: the element that the page's script draws it into, and after it its JSON."""
    text = json.dumps(figure, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    head = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    height = figure["layout"]["height"]
    return (
        f'<figure class="card">{head}<div data-figure style="height:{height}px"></div>'
        f'<script type="application/json">{text}</script></figure>'
    )


def table(caption: str, heads: list[str], rows: list[list[str]]) -> str:
    """A table whose long cells are broken."""
    return markup.table(caption, heads, ([_cell(text) for text in row] for row in rows))


def _cell(text: str) -> str:
    if len(text) <= _LONG:
        return escape(text)
    return f'<span style="display:block;white-space:normal;min-width:34ch">{escape(text)}</span>'


_STROKES = {"solid": "", "dash": "6 3", "dot": "2 2", "dashdot": "6 2 2 2"}
_SHAPES = {
    "circle": "M9 6a4 4 0 1 0 8 0a4 4 0 1 0-8 0z",
    "square": "M9.5 2.5h7v7h-7z",
    "diamond": "M13 1l5 5-5 5-5-5z",
    "triangle-up": "M13 1.5l4.5 8h-9z",
    "triangle-down": "M13 10.5l4.5-8h-9z",
    "star": "M13 .5l1.5 3.6 3.9.3-3 2.5 1 3.8-3.4-2.1-3.4 2.1 1-3.8-3-2.5 3.9-.3z",
    "x": "M9 3.5L10.5 2 13 4.5 15.5 2 17 3.5 14.5 6 17 8.5 15.5 10 13 7.5 10.5 10 9 8.5 11.5 6z",
    "cross": "M11.7 1.5h2.6v3.2h3.2v2.6h-3.2v3.2h-2.6v-3.2H8.5V4.7h3.2z",
}
"""Markers by plotly's names, around (13, 6)."""


def legend(entries: dict[str, Look]) -> str:
    """Which line is which method, where charts have too many to name each: as they are drawn."""
    if len(entries) < 2:
        return ""
    items = " &ensp; ".join(
        f'<span style="white-space:nowrap">{_swatch(look)} {escape(name)}</span>'
        for name, look in entries.items()
    )
    return f'<p class="note">{items}</p>'


def _swatch(look: Look) -> str:
    dashes = f' stroke-dasharray="{_STROKES[look.dash]}"' if _STROKES[look.dash] else ""
    mark = f'<path d="{_SHAPES[look.marker]}" fill="currentColor"/>' if look.marker else ""
    shade = f"light-dark({look.color},{DARK.get(look.color, look.color)})"
    return (
        f'<svg class="swatch" width="26" height="12" style="color:{shade}" aria-hidden="true">'
        f'<path d="M0 6h26" stroke="currentColor" stroke-width="2"{dashes}/>{mark}</svg>'
    )
