"""The charts of the page, as plotly figures in plain JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from reports import data
from reports.style import (
    PARTS,
    color,
    linear_range,
    log_range,
    log_ticks,
    marker,
    mib,
    place_labels,
    series,
)

if TYPE_CHECKING:
    import pandas as pd

Figure = dict[str, Any]
_MARGIN = {"l": 54, "r": 14, "t": 12, "b": 46}
# Label places are worked out for this size of the drawing area; the page gives charts about as much.
_WIDTH, _HEIGHT = 330.0, 252.0


def _figure(traces: list[Any], x: dict[str, Any], y: dict[str, Any], **layout: Any) -> Figure:
    """Colors of text and grid are set by the page's script, which knows light from dark."""
    return {
        "data": traces,
        "layout": {
            "height": 310,
            "margin": _MARGIN,
            "showlegend": False,
            "hovermode": "closest",
            "xaxis": {"zeroline": False, "showline": True, **x},
            "yaxis": {"zeroline": False, "showline": True, **y},
            **layout,
        },
    }


def tradeoffs(results: pd.DataFrame, against: str) -> dict[str, Figure]:
    """Dataset -> PSNR against "size_bytes", "fps" or "train_seconds" (log)."""
    names = series(results)
    return {panel.dataset: _tradeoff(panel, against, names) for panel in data.tradeoff(results, against)}


def _tradeoff(panel: data.Panel, against: str, names: list[str]) -> Figure:
    low, high = log_range(panel.all_x)
    bottom, top = linear_range(panel.all_y, 2.0)
    traces: list[Any] = []
    short = {"size_bytes": "MiB", "fps": "FPS", "train_seconds": "s"}[against]
    for line in panel.lines:
        shade, symbol = color(line.name, names), marker(line.name, names)
        hover = f"%{{text}}<br>%{{x:.4~g}} {short}<br>%{{y:.2f}} dB<extra>{line.title}</extra>"
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": line.scene_x,
                "y": line.scene_y,
                "text": line.scenes,
                "marker": {"color": shade, "size": 6, "opacity": 0.4},
                "hovertemplate": hover,
            }
        )
        traces.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "x": line.x,
                "y": line.y,
                "text": ["mean over scenes"] * len(line.x),
                "marker": {"color": shade, "size": 10, "symbol": symbol},
                "line": {"color": shade, "width": 1.5},
                "hovertemplate": hover,
            }
        )
    import math

    def place(x: float, y: float) -> tuple[float, float]:
        return (math.log10(x) - low) / (high - low) * _WIDTH, (y - bottom) / (top - bottom) * _HEIGHT

    labels = panel.labels()
    notes = _notes(
        [(math.log10(x), y, text, name) for x, y, text, name in labels],
        [place(x, y) for x, y, _, _ in labels],
        [place(x, y) for x, y in zip(panel.all_x, panel.all_y, strict=True)],
        names,
    )
    ticks = log_ticks(low, high)
    x_axis = {
        "type": "log",
        "range": [low, high],
        "title": {"text": data.AXIS[against].title},
        "tickvals": [value for value, _ in ticks],
        "ticktext": [text for _, text in ticks],
    }
    y_axis = {"range": [bottom, top], "title": {"text": "PSNR [dB]"}}
    return _figure(traces, x_axis, y_axis, annotations=notes)


def _notes(
    labels: list[tuple[float, float, str, str]],
    spots: list[tuple[float, float]],
    avoid: list[tuple[float, float]],
    names: list[str],
) -> list[Any]:
    """Direct labels: (x, y in axis coordinates, text, series)."""
    texts = [text for _, _, text, _ in labels]
    places = place_labels(spots, texts, _WIDTH, _HEIGHT, avoid=avoid)
    return [
        {
            "x": x,
            "y": y,
            "text": text,
            "showarrow": False,
            "xanchor": spot.anchor,
            "yanchor": "middle",
            "xshift": spot.dx,
            "yshift": spot.dy,
            "font": {"size": 12, "color": color(name, names)},
        }
        for (x, y, text, name), spot in zip(labels, places, strict=True)
    ]


def convergence(curve: pd.DataFrame, against: str, names: list[str]) -> dict[str, Figure]:
    """Dataset -> validation PSNR over "train_seconds" or "iteration"; ``names``: the report's series."""
    figures = {}
    for dataset, lines in data.convergence(curve, against).items():
        end = max(max(line.x) for line in lines) or 1.0
        low, high = linear_range([y for line in lines for y in line.y], 2.0)
        longest = max(len(line.title) for line in lines)
        wide = end / max(0.4, 1.0 - (7.0 * longest + 16.0) / _WIDTH)  # room for the labels at the ends
        title = data.CURVE_AXIS[against]
        hover = f"{title} %{{x:.5~g}}<br>%{{y:.2f}} dB"
        traces = [
            {
                "type": "scatter",
                "mode": "lines+markers",
                "x": line.x,
                "y": line.y,
                "line": {"color": color(line.name, names), "width": 1.6},
                "marker": {"size": 4},
                "hovertemplate": f"{hover}<extra>{line.title}</extra>",
            }
            for line in lines
        ]
        spots = [(line.x[-1] / wide * _WIDTH, (line.y[-1] - low) / (high - low) * _HEIGHT) for line in lines]
        notes = _notes([(line.x[-1], line.y[-1], line.title, line.name) for line in lines], spots, [], names)
        figures[dataset] = _figure(
            traces,
            {"range": [0, wide], "title": {"text": title}},
            {"range": [low, high], "title": {"text": "validation PSNR [dB]"}},
            annotations=notes if len(notes) <= 12 else [],
        )
    return figures


def ledger(table: pd.DataFrame) -> Figure | None:
    """Share of the bytes by part, a stacked bar per dataset and method with its total; None without data."""
    bars, parts = data.ledger(table)
    if not bars:
        return None
    traces = [
        {
            "type": "bar",
            "orientation": "h",
            "name": part,
            "marker": {"color": PARTS[i % len(PARTS)]},
            "y": [bar.title for bar in bars],
            "x": [bar.percent(part) for bar in bars],
            "customdata": [
                f"{mib(bar.bytes.get(part, 0))} MiB ({bar.bytes.get(part, 0):,} B)" for bar in bars
            ],
            "hovertemplate": f"{part}: %{{customdata}}<extra>%{{y}}</extra>",
        }
        for i, part in enumerate(parts)
    ]
    totals = [
        {
            "x": 100,
            "y": bar.title,
            "text": f"{mib(bar.total)} MiB",
            "showarrow": False,
            "xanchor": "left",
            "xshift": 6,
            "font": {"size": 12},
        }
        for bar in bars
    ]
    return _figure(
        traces,
        {"title": {"text": "share of size [%]"}, "range": [0, 115], "tickvals": [0, 20, 40, 60, 80, 100]},
        {"autorange": "reversed", "automargin": True, "showline": False, "ticklen": 8},
        barmode="stack",
        bargap=0.35,
        height=110 + 34 * len(bars),
        showlegend=True,
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0, "traceorder": "normal"},
        margin={**_MARGIN, "t": 34},
        annotations=totals,
    )
