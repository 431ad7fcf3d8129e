"""What the page's sections of charts are made of."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape

from reports import markup, plots
from reports.style import color

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


def legend(shown: list[str], names: list[str]) -> str:
    """Which color is which method, where charts have too many lines to name each."""
    if len(shown) < 2:
        return ""
    entries = " &ensp; ".join(
        f'<span style="white-space:nowrap"><span class="dot" style="background:{color(name, names)}"></span>'
        f"{escape(name)}</span>"
        for name in shown
    )
    return f'<p class="note">{entries}</p>'
