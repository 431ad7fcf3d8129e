"""What all figures of the page share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from reports.style import FAR, Label, log_range, log_ticks, place_labels

Figure = dict[str, Any]
MARGIN = {"l": 54, "r": 14, "t": 12, "b": 46}
# Label places are worked out for this size of the drawing area; the page gives charts about as much.
WIDTH, HEIGHT = 330.0, 252.0
MOST_LABELS = 10
"""More lines than this are named by the page's legend and when pointed at."""
_MOST_ROOM = 0.35
_LINE = 14.0  # height of a label in pixels
_CHARACTER = 7.0  # width of a label's character in pixels
GREY = "#888888"
"""Reads on light and on dark."""


def figure(traces: list[Any], x: dict[str, Any], y: dict[str, Any], **layout: Any) -> Figure:
    """Colors of text and grid are set by the page's script, which knows light from dark."""
    return {
        "data": traces,
        "layout": {
            "height": 310,
            "margin": MARGIN,
            "showlegend": False,
            "hovermode": "closest",
            "xaxis": {"zeroline": False, "showline": True, **x},
            "yaxis": {"zeroline": False, "showline": True, "automargin": True, **y},
            **layout,
        },
    }


def room_for(titles: Sequence[str]) -> float:
    """Share of the width for labels to the right of their points: not all of a long one's, none if many."""
    longest = max(map(len, titles)) if 0 < len(titles) <= MOST_LABELS else 0
    return min(_MOST_ROOM, (_CHARACTER * longest + 16.0) / WIDTH)


def log_axis(values: Sequence[float], title: str, room: float = 0.0) -> dict[str, Any]:
    """A logarithmic axis with ticks that read as numbers.

    Args:
        values: what it shall show.
        title: of the axis.
        room: share at the upper end to be kept free for labels, if that is more than the usual margin.
    """
    low, high = log_range(values)
    high = max(high, low + (math.log10(max(values)) - low) / (1.0 - room))
    ticks = log_ticks(low, high)
    return {
        "type": "log",
        "range": [low, high],
        "title": {"text": title},
        "tickangle": 0,
        "tickvals": [value for value, _ in ticks],
        "ticktext": [text for _, text in ticks],
    }


def line(x: list[float], y: list[float], shade: str, **more: Any) -> dict[str, Any]:
    """A trace of a line with marks."""
    return {"type": "scatter", "mode": "lines+markers", "x": x, "y": y, "line": {"color": shade}, **more}


def notes(
    labels: list[tuple[float, float, str, str]],
    spots: list[tuple[float, float]],
    avoid: list[tuple[float, float]],
) -> list[Any]:
    """Direct labels.

    Args:
        labels: (x, y in axis coordinates, text, color).
        spots: where they are, in shares of the drawing area.
        avoid: further points, in shares of the drawing area.
    """
    texts = [text for _, _, text, _ in labels]
    places = place_labels(
        _scaled(spots), texts, WIDTH, HEIGHT, avoid=_scaled(avoid), char=_CHARACTER, line=_LINE
    )
    return [
        {
            "x": x,
            "y": y,
            "text": spot.text.replace("\n", "<br>"),
            "align": spot.anchor,
            "xanchor": spot.anchor,
            "yanchor": "middle",
            "font": {"size": 12, "color": shade},
            **_offset(spot, shade),
        }
        for (x, y, _, shade), spot in zip(labels, places, strict=True)
    ]


def _offset(spot: Label, shade: str) -> dict[str, Any]:
    """Where a label stands; far from its point it has a line to it."""
    if abs(spot.dy) <= FAR * _LINE:
        return {"showarrow": False, "xshift": spot.dx, "yshift": spot.dy}
    return {"ax": spot.dx, "ay": -spot.dy, "arrowhead": 0, "arrowwidth": 0.7, "arrowcolor": shade,
            "standoff": 4}  # fmt: skip


def _scaled(spots: list[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(x * WIDTH, y * HEIGHT) for x, y in spots]


def share(value: float, ends: Sequence[float]) -> float:
    """Where a value lies on an axis, from 0 to 1."""
    return (value - ends[0]) / (ends[1] - ends[0])
