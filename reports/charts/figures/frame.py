"""What all figures share: style, axes side by side, labels beside points."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

from reports.style import FAR, Look, log_range, log_ticks, place_labels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "triangle-down": "v",
    "star": "*",
    "x": "X",
    "cross": "P",
    "": "",
}
LINES: dict[str, Any] = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-.", "": ""}
COLUMNS = 3
"""Panels in a row."""
MOST_LABELS = 10
"""More lines than this are named in a legend."""
_CHARACTER = 4.9  # width of a label's character in points
_TITLE = 42  # characters of a line
_MOST_ROOM = 0.35
_LINE = 11.0  # height of a label in points
_PANEL = 270.0  # width of a panel's drawing area in points
_RC: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.edgecolor": "#666666",
    "pdf.fonttype": 42,
    "savefig.dpi": 150,
    "figure.dpi": 100,
    "legend.frameon": False,
    "legend.fontsize": 8,
}


@contextmanager
def style() -> Iterator[None]:
    """One look for all figures; also needed when saving, for resolution and fonts are decided then."""
    import matplotlib

    with matplotlib.rc_context(_RC):
        yield


def new_figure(panels: int, width: float = 4.6, height: float = 3.6) -> tuple[Figure, list[Axes]]:
    """Axes in rows of :data:`COLUMNS`; no pyplot, so nothing global is touched and no display is needed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = max(1, panels)
    columns = min(COLUMNS, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]


def settle(figure: Figure) -> None:
    """Lay the axes out once; with a layout engine, even an idle one, saving draws everything twice."""
    figure.draw_without_rendering()
    figure.set_layout_engine(None)


def room_for(titles: Sequence[str]) -> float:
    """Share of a panel's width that labels to the right of their points take; of a long one's not all."""
    longest = max(map(len, titles), default=0)
    return min(_MOST_ROOM, (_CHARACTER * longest + 12.0) / _PANEL)


def log_axis(axis: Axes, values: Sequence[float], which: Literal["x", "y"] = "x", room: float = 0.0) -> None:
    """Make an axis logarithmic, with ticks that read as numbers.

    Args:
        axis: the axes.
        values: what it shall show.
        which: of its two.
        room: share at the upper end to be kept free for labels, if that is more than the usual margin.
    """
    import matplotlib.ticker as ticker

    low, high = log_range(values)
    high = max(high, low + (math.log10(max(values)) - low) / (1.0 - room))
    ticks = log_ticks(low, high)
    positions, texts = [value for value, _ in ticks], [text for _, text in ticks]
    if which == "x":
        axis.set_xscale("log")
        axis.set_xlim(10**low, 10**high)
        axis.set_xticks(positions, texts)
        axis.xaxis.set_minor_locator(ticker.NullLocator())
    else:
        axis.set_yscale("log")
        axis.set_ylim(10**low, 10**high)
        axis.set_yticks(positions, texts)
        axis.yaxis.set_minor_locator(ticker.NullLocator())


def titled(axis: Axes, title: str, x: str, y: str) -> None:
    """Title, in lines that its panel has room for, and axis labels."""
    axis.set_title(textwrap.fill(title, _TITLE, break_long_words=False), loc="left", fontweight="bold")
    axis.set_xlabel(x)
    axis.set_ylabel(y)


def annotate(
    axis: Axes,
    labels: list[tuple[float, float, str, str]],
    avoid: list[tuple[float, float]],
) -> None:
    """Write each text (x, y, text, color) beside its point, in points of 1/72 inch."""
    from matplotlib.patheffects import withStroke

    scale = 72.0 / axis.figure.dpi
    box = axis.get_window_extent()
    halo = [withStroke(linewidth=2.0, foreground="white")]  # lines run behind texts, not through them

    def place(x: float, y: float) -> tuple[float, float]:
        px, py = axis.transData.transform((x, y))
        return (px - box.x0) * scale, (py - box.y0) * scale

    spots = [place(x, y) for x, y, _, _ in labels]
    texts = [text for _, _, text, _ in labels]
    around = [place(x, y) for x, y in avoid]
    size = (box.width * scale, box.height * scale)
    places = place_labels(spots, texts, *size, avoid=around, char=_CHARACTER, line=_LINE)
    for (x, y, _, shade), spot in zip(labels, places, strict=True):
        far = abs(spot.dy) > FAR * _LINE
        axis.annotate(
            spot.text,
            (x, y),
            (spot.dx * 0.8, spot.dy),
            textcoords="offset points",
            ha=spot.anchor,
            ma=spot.anchor,
            va="center",
            color=shade,
            fontsize=8,
            path_effects=halo,
            arrowprops={"arrowstyle": "-", "color": shade, "linewidth": 0.5, "shrinkB": 2} if far else None,
        )


def legend_below(figure: Figure, entries: dict[str, Look]) -> None:
    """Text -> its look, in a legend below the panels."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=look.color, linestyle=LINES[look.dash], marker=MARKERS[look.marker],
               markersize=5, linewidth=1.5, label=text)
        for text, look in entries.items()
    ]  # fmt: skip
    longest = max(map(len, entries), default=1)
    columns = max(1, min(len(handles), int(figure.get_figwidth() * 14 // (longest + 8))))
    # Handles must be long enough to show what is dashed.
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, handlelength=3.2)
