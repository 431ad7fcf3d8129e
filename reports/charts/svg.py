"""Charts as SVG: panels for the page, whole charts for files."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from functools import cache
from html import escape
from typing import Any

from econgs_bench.reports import markup
from econgs_bench.reports.charts.chart import INK, WIDTH, Axis, Chart, Panel
from econgs_bench.reports.charts.labels import LINE, SIZE, text_width
from econgs_bench.reports.style import DARK, PALETTE, Look
from econgs_bench.reports.text import xml_text

FONT = "Liberation Sans, Arial, Helvetica, sans-serif"
"""Fonts of the same metrics, which label places are computed for."""
_SOFT, _GRID, _PAPER = "#777777", "#dddddd", "#ffffff"
THEME = {
    INK: "var(--fg)", _SOFT: "var(--soft)", _GRID: "var(--grid)", _PAPER: "var(--card)",
    **{light: f"light-dark({light},{dark})" for light, dark in DARK.items()},
}  # fmt: skip
"""Color of an SVG -> its color on the page."""
_DASHES = {"solid": "", "dash": "6 3", "dot": "2 2", "dashdot": "6 2 2 2"}
_CORNERS = {
    "square": ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    "diamond": ((0, -1.25), (1.25, 0), (0, 1.25), (-1.25, 0)),
    "triangle-up": ((0, -1.15), (1.1, 0.85), (-1.1, 0.85)),
    "triangle-down": ((0, 1.15), (-1.1, -0.85), (1.1, -0.85)),
    "star": ((0, -1.35), (0.35, -0.45), (1.28, -0.4), (0.55, 0.2), (0.8, 1.1), (0, 0.57), (-0.8, 1.1),
             (-0.55, 0.2), (-1.28, -0.4), (-0.35, -0.45)),
    "x": ((-1.1, -0.6), (-0.6, -1.1), (0, -0.5), (0.6, -1.1), (1.1, -0.6), (0.5, 0), (1.1, 0.6), (0.6, 1.1),
          (0, 0.5), (-0.6, 1.1), (-1.1, 0.6), (-0.5, 0)),
    "cross": ((-0.35, -1.2), (0.35, -1.2), (0.35, -0.35), (1.2, -0.35), (1.2, 0.35), (0.35, 0.35),
              (0.35, 1.2), (-0.35, 1.2), (-0.35, 0.35), (-1.2, 0.35), (-1.2, -0.35), (-0.35, -0.35)),
}  # fmt: skip
"""Markers around the origin, of radius 1; a circle is drawn as such."""
_COLUMNS = 3
"""Panels of usual width in a row of a chart's file."""
_GAP, _TITLE = 14.0, 15.0
"""Pixels between panels, and of a line of a panel's title."""
_PAGE = _COLUMNS * WIDTH + (_COLUMNS - 1) * _GAP
"""Width of a page of paper in pixels; its height is √2 times as much."""
_TITLE_SIZE = 12.0
_SAMPLE = 26.0
"""Length of the sample of a level beside its name in pixels."""
_LEAST, _MOST = 300.0, 1.5
"""Least width of a panel on the page in pixels, and by how much it may be enlarged."""


def page_panel(panel: Panel) -> str:
    """A panel as an element of the page, and after it, as JSON, the points that its script names."""
    data = markup.data(_points(panel)) if panel.series else ""
    least = min(panel.width, _LEAST)
    size = f' class="chart" style="min-width:{least:.0f}px;max-width:{_MOST * panel.width:.0f}px"'
    return f"{_document(panel.width, panel.height, drawing(panel, links=True), size)}{data}"


def theme() -> str:
    """Style rules: colors of charts and of dots, light and dark, and the shapes of markers for dots."""
    colors = [
        f'.chart [{name}="{color}"], .swatch [{name}="{color}"] {{ {name}: {value}; }}\n'
        for color, value in THEME.items()
        for name in ("fill", "stroke")
    ]
    shapes = []
    for marker, corners in _CORNERS.items():
        reach = max(abs(part) for corner in corners for part in corner)
        outline = ",".join(f"{_n(50 + 50 * x / reach)}% {_n(50 + 50 * y / reach)}%" for x, y in corners)
        shapes.append(f".dot.{marker} {{ border: 0; border-radius: 0; clip-path: polygon({outline}); }}\n")
    dots = [f".dot.c{i} {{ background: {THEME.get(color, color)}; }}\n" for i, color in enumerate(PALETTE)]
    return "".join([*colors, *dots, *shapes])


def file(chart: Chart) -> str:
    """A chart with the titles of its panels and its legend as an SVG document."""
    parts = []
    right = top = 0.0
    for row in _rows(chart.panels):
        titles = [_lines(panel.title, panel.width) for panel in row]
        head = _head(row)
        left = 0.0
        for panel, title in zip(row, titles, strict=True):
            for i, line in enumerate(title):
                parts.append(text(left + 8, top + _TITLE * (i + 1) - 3, line, size=_TITLE_SIZE, bold=True))
            parts.append(f'<g transform="translate({_n(left)} {_n(top + head)})">{drawing(panel)}</g>')
            left += panel.width + _GAP
        right = max(right, left - _GAP)
        top += head + max(panel.height for panel in row) + _GAP
    entries, height = _legend(chart.legend, right)
    parts.append(f'<g transform="translate(0 {_n(top)})">{entries}</g>')
    top += height
    for line in _lines(chart.note, right, SIZE):
        parts.append(text(8, top + LINE - 3, line, color=_SOFT))
        top += LINE
    top += 4.0 if chart.note else 0.0
    return _document(right, top, "".join(parts), f' style="background:{_PAPER}"')


def pages(panels: Sequence[Panel]) -> list[list[Panel]]:
    """The panels of each file of a chart: as many rows as a page of paper holds, at least one."""
    every: list[list[Panel]] = [[]]
    most = 2**0.5 * _PAGE
    left = most
    for row in _rows(panels):
        tall = _head(row) + max(panel.height for panel in row) + _GAP
        if every[-1] and tall > left:
            every.append([])
            left = most
        every[-1] += row
        left -= tall
    return every


def _rows(panels: Sequence[Panel]) -> list[list[Panel]]:
    """Panels side by side where a page has room."""
    rows: list[list[Panel]] = []
    left = 0.0
    for panel in panels:
        if not rows or panel.width > left:
            rows.append([])
            left = _PAGE
        rows[-1].append(panel)
        left -= panel.width + _GAP
    return rows


def _head(row: Sequence[Panel]) -> float:
    """Height of the titles of a row."""
    return max(len(_lines(panel.title, panel.width)) for panel in row) * _TITLE + 4.0


def _document(width: float, height: float, content: str, attributes: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_n(width)}" height="{_n(height)}"'
        f' viewBox="0 0 {_n(width)} {_n(height)}" font-family="{FONT}" font-size="{_n(SIZE)}"{attributes}>'
        f"{xml_text(content)}</svg>"
    )


def drawing(panel: Panel, *, links: bool = False) -> str:
    """The markup of a panel, its upper left corner at the origin; with the links of its axes if asked for."""
    series = f'<g class="series">{"".join(_series(panel))}</g>'
    below = (*_axes(panel, links), *_bars(panel), *_levels(panel), *_stages(panel), *_bends(panel))
    return "".join((*below, series, *_labels(panel)))


def _axes(panel: Panel, links: bool) -> Iterator[str]:
    left, top, width, height = panel.box
    bottom = top + height
    columns = [(left + width * panel.x.share(value), text) for value, text in panel.x.ticks]
    rows = [(bottom - height * panel.y.share(value), text) for value, text in panel.y.ticks]
    grid = [f"M{_n(x)} {_n(top)}v{_n(height)}" for x, _ in columns if panel.x.grid]
    grid += [f"M{_n(left)} {_n(y)}h{_n(width)}" for y, _ in rows if panel.y.grid]
    yield f'<path d="{"".join(grid)}" stroke="{_GRID}" fill="none"/>'
    if not panel.x.above:
        yield f'<path d="M{_n(left)} {_n(top)}v{_n(height)}h{_n(width)}" stroke="{_SOFT}" fill="none"/>'
    for x, word in columns:
        y = top - 6 if panel.x.above else bottom + 14
        yield _tick(panel.x, links, text(x, y, word, "middle"), word)
    for y, word in rows:
        yield _tick(panel.y, links, text(left - 5, y + 4, word, "end"), word)
    yield text(left + width / 2, bottom + 32, panel.x.title, "middle", size=SIZE + 1)
    if panel.y.title:
        yield text(12, top + height / 2, panel.y.title, "middle", size=SIZE + 1, turned=True)


def _tick(axis: Axis, links: bool, markup: str, text: str) -> str:
    anchor = axis.links.get(text) if links else None
    return f'<a href="#{escape(anchor)}">{markup}</a>' if anchor else markup


def _bars(panel: Panel) -> Iterator[str]:
    for bar in panel.bars:
        x, y = panel.place(bar.start, bar.y - 0.31)
        end, low = panel.place(bar.end, bar.y + 0.31)
        yield (
            f'<rect x="{_n(x)}" y="{_n(y)}" width="{end - x:.2f}" height="{_n(low - y)}" fill="{bar.color}"'
            f' data-about="{escape(bar.about)}"/>'
        )


def _levels(panel: Panel) -> Iterator[str]:
    """Lines across the panel, and above it a sample of each with its name."""
    left, _, width, _ = panel.box
    for middle, level, words in panel.level_texts:
        style = f'stroke="{INK}" stroke-width="{_n(level.width)}" stroke-dasharray="{_DASHES[level.dash]}"'
        if panel.y.holds(level.value):
            height = panel.place(panel.x.low, level.value)[1]
            yield f'<path d="M{_n(left)} {_n(height)}h{_n(width)}" {style} fill="none"/>'
            yield f'<path d="M{_n(left)} {_n(middle)}h{_n(_SAMPLE)}" {style} fill="none"/>'
        yield text(left + _SAMPLE + 6, middle + 4, words, color=_SOFT)


def _stages(panel: Panel) -> Iterator[str]:
    _, top, _, height = panel.box
    for x, _ in panel.stages:
        across = panel.place(x, panel.y.low)[0]
        dash = f'stroke-dasharray="{_DASHES["dash"]}"'
        yield f'<path d="M{_n(across)} {_n(top)}v{_n(height)}" stroke="{_SOFT}" {dash} fill="none"/>'


def _bends(panel: Panel) -> Iterator[str]:
    """A zigzag across the panel where the scale of its vertical axis changes, and by how much."""
    left, _, width, _ = panel.box
    for start, middle, bend, words in panel.remarks:
        zigzag = f"M{_n(left)} {_n(bend)}l2 -2" + "l4 4l4 -4" * int(width // 8 - 1) + "l4 4l2 -2"
        yield f'<path d="{zigzag}" stroke="{_SOFT}" stroke-width="0.8" fill="none"/>'
        yield text(start, middle + 4, words, color=_SOFT, halo=True)


def _series(panel: Panel) -> Iterator[str]:
    for series in panel.series:
        spots = [panel.place(x, y) for x, y in zip(series.x, series.y, strict=True)]
        color = series.look.color
        ring = 1 if series.fill else 0
        path = panel.path([*series.x, *series.x[:ring]], [*series.y, *series.y[:ring]])
        line = "M" + "L".join(f"{_n(x)} {_n(y)}" for x, y in path)
        if series.fill:
            yield f'<path d="{line}z" fill="{color}" opacity="{_n(series.opacity)}"/>'
        elif series.line and len(spots) > 1:
            yield (
                f'<path d="{line}" stroke="{color}" stroke-width="{_n(series.line)}" fill="none"'
                f' stroke-linejoin="round"{_dashes(series.look)}/>'
            )
        if series.mark and spots:
            glyph = _glyph(series.look.marker, series.mark / 2)
            marks = "".join(f"M{_n(x)} {_n(y)}{glyph}" for x, y in spots)
            faint = f' opacity="{_n(series.opacity)}"' if series.opacity < 1 else ""
            yield f'<path d="{marks}" fill="{color}"{faint}/>'


def _labels(panel: Panel) -> Iterator[str]:
    _, top, _, height = panel.box
    for x, words in panel.stages:
        across = panel.place(x, panel.y.low)[0]
        yield text(across + 11, top + height - 5, words, color=_SOFT, turned=True, halo=True)
    for label, place in panel.placed:
        if place.far:
            x, y = panel.place(label.x, label.y)
            edge = min(max(x, place.box[0]), place.box[2])
            near = place.box[3] if place.y < y else place.box[1]
            yield (
                f'<path d="M{_n(x)} {_n(y)}L{_n(edge)} {_n(near)}" stroke="{label.color}"'
                ' stroke-width="0.6" fill="none"/>'
            )
        first = place.y - LINE * (len(place.lines) - 1) / 2 + 4
        for i, line in enumerate(place.lines):
            yield text(place.x, first + LINE * i, line, place.anchor, color=label.color, halo=True)


def text(
    x: float, y: float, words: str, anchor: str = "start", *, size: float = SIZE, color: str = INK,
    bold: bool = False, turned: bool = False, halo: bool = False,
) -> str:  # fmt: skip
    """A text element; ``x`` and ``y`` are the start, middle or end of its base line in pixels."""
    place = f'x="{_n(x)}" y="{_n(y)}"'
    if turned:
        place = f'transform="translate({_n(x)} {_n(y)}) rotate(-90)"'
    more = "" if anchor == "start" else f' text-anchor="{anchor}"'
    more += "" if size == SIZE else f' font-size="{_n(size)}"'
    # A bold face would be a second font, and the order of fonts in a PDF file is not always the same.
    more += f' stroke="{INK}" stroke-width="0.4"' if bold else ""
    # Lines run behind labels, not through them.
    more += (
        f' paint-order="stroke" stroke="{_PAPER}" stroke-width="3" stroke-linejoin="round"' if halo else ""
    )
    return f'<text {place} fill="{color}"{more}>{escape(words, quote=False)}</text>'


def swatch(look: Look) -> str:
    """Line and marker of a look, 26 × 12 pixels, as they are drawn."""
    line = ""
    if look.dash:
        line = f'<path d="M0 6h26" stroke="{look.color}" stroke-width="2" fill="none"{_dashes(look)}/>'
    mark = f'<path d="M13 6{_glyph(look.marker, 4)}" fill="{look.color}"/>' if look.marker else ""
    return line + mark


def _legend(entries: dict[str, Look], width: float) -> tuple[str, float]:
    """Markup and height of a legend's lines."""
    parts = []
    x, y = 8.0, 0.0
    for name, look in entries.items():
        long = 34.0 + text_width(name) + 16.0
        if x > 8.0 and x + long > width:
            x, y = 8.0, y + 18.0
        parts.append(f'<g transform="translate({_n(x)} {_n(y)})">{swatch(look)}{text(32, 10, name)}</g>')
        x += long
    return "".join(parts), y + 22.0 if entries else 0.0


def _lines(text: str, width: float, size: float = _TITLE_SIZE) -> list[str]:
    characters = int((width - 16) / (0.56 * size))
    return textwrap.wrap(text, characters, break_long_words=False)


def _dashes(look: Look) -> str:
    return f' stroke-dasharray="{_DASHES[look.dash]}"' if _DASHES[look.dash] else ""


@cache
def _glyph(marker: str, radius: float) -> str:
    """A marker's outline, relative to its middle."""
    if marker == "circle":
        around = f"a{_n(radius)} {_n(radius)} 0 1 0"
        return f"m{_n(-radius)} 0{around} {_n(2 * radius)} 0{around} {_n(-2 * radius)} 0z"
    corners = [(radius * x, radius * y) for x, y in _CORNERS[marker]]
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in zip([(0.0, 0.0), *corners], corners, strict=False)]
    return "m" + "l".join(f"{_n(x)} {_n(y)}" for x, y in steps) + "z"


def _points(panel: Panel) -> dict[str, Any]:
    """What the page's script needs to name points: box, axes and series with values, names and keys."""
    series = [
        {
            "title": each.title, "color": each.look.color,
            "x": [_rounded(value) for value in each.x], "y": [_rounded(value) for value in each.y],
            **({"names": list(each.names)} if each.names else {}),
            **({"keys": [list(keys) for keys in each.keys]} if each.keys else {}),
        }
        for each in panel.series
        if each.title
    ]  # fmt: skip
    return {
        "box": [round(value, 1) for value in panel.box],
        "x": _axis(panel.x),
        "y": _axis(panel.y),
        "series": series,
    }


def _axis(axis: Axis) -> dict[str, Any]:
    text = f"{{}} {axis.unit}" if axis.unit else f"{axis.title} {{}}"
    return {
        "low": axis.low, "high": axis.high, "log": axis.log, "text": text if axis.ticks else "",
        "digits": 2 if axis.unit in ("dB", "%") else None,
        **({"bends": axis.bends} if axis.bends else {}),
    }  # fmt: skip


def _rounded(value: float) -> float | int:
    near = float(f"{value:.5g}")
    return int(near) if near.is_integer() else near


def _n(value: float) -> str:
    """A coordinate to a tenth of a pixel."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text
