"""The page's charts of quality against what it costs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from reports.charts import data, rate_distortion
from reports.charts.traces.frame import GREY, Figure, figure, line, log_axis, notes, share
from reports.style import OTHERS, linear_range, series

if TYPE_CHECKING:
    import pandas as pd


def tradeoffs(results: pd.DataFrame, against: str) -> dict[str, Figure]:
    """Dataset -> PSNR against a column of ``data.AXIS`` (log); the dominated region is shaded."""
    names = series(results)
    return {panel.title: _tradeoff(panel, against, names) for panel in data.tradeoff(results, against)}


def _tradeoff(panel: data.Panel, against: str, names: list[str]) -> Figure:
    axis = data.AXIS[against]
    x_axis = log_axis(panel.all_x, panel.axis(axis.axis_title))
    low, high = x_axis["range"]
    y_range = linear_range(panel.all_y, 2.0)
    traces: list[Any] = _dominated(panel, 10 ** (low if panel.better > 0 else high), y_range[0])
    for drawn, look in panel.looks(names):
        hover = f"%{{text}}<br>%{{x:.4~g}} {axis.display_unit}<br>%{{y:.2f}} dB<extra>{drawn.title}</extra>"
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": drawn.scene_x,
                "y": drawn.scene_y,
                "text": drawn.scenes,
                "meta": {"keys": drawn.scene_keys},
                "marker": {"color": look.color, "size": 6, "opacity": 0.4},
                "hovertemplate": hover,
            }
        )
        traces.append(
            line(
                drawn.x,
                drawn.y,
                look.color,
                text=["mean over scenes"] * len(drawn.x),
                meta={"keys": drawn.keys},
                marker={"color": look.color, "size": 7 if look is OTHERS else 10, "symbol": look.marker},
                hovertemplate=hover,
            )
        )

    def place(x: float, y: float) -> tuple[float, float]:
        return share(math.log10(x), (low, high)), share(y, y_range)

    labels = panel.labels(names)
    written = notes(
        [(math.log10(x), y, text, shade) for x, y, text, shade in labels],
        [place(x, y) for x, y, _, _ in labels],
        [place(x, y) for x, y in panel.to_avoid],
    )
    y_axis = {"range": list(y_range), "title": {"text": "PSNR [dB]"}}
    return figure(traces, x_axis, y_axis, annotations=written)


def _dominated(panel: data.Panel, edge: float, bottom: float) -> list[Any]:
    """The region below the Pareto front, and the front."""
    outline = panel.dominated(edge, bottom)
    if not outline:
        return []
    x, y = ([spot[i] for spot in outline] for i in (0, 1))
    common = {"type": "scatter", "mode": "lines", "hoverinfo": "skip"}
    return [
        {
            **common,
            "x": x,
            "y": y,
            "fill": "toself",
            "fillcolor": "rgba(128,128,128,0.13)",
            "line": {"width": 0},
        },
        {**common, "x": x[1:-1], "y": y[1:-1], "line": {"color": GREY, "width": 1, "dash": "dash"}},
    ]


def rate_curves(results: pd.DataFrame) -> dict[str, Figure]:
    """Dataset -> PSNR over size (log) at all rates; defaults of other methods are single marks."""
    names = series(results)
    panels = rate_distortion.drawn(rate_distortion.curves(results))
    return {dataset: _rate_curves(curves, names) for dataset, curves in panels.items()}


def _rate_curves(curves: list[rate_distortion.Curve], names: list[str]) -> Figure:
    x_axis = log_axis([x for curve in curves for x in curve.mebibytes], data.AXIS["size_bytes"].axis_title)
    y_range = linear_range([point.psnr for curve in curves for point in curve.points], 2.0)
    traces = []
    for curve, look in rate_distortion.looks(curves, names):
        traces.append(
            line(
                curve.mebibytes,
                [point.psnr for point in curve.points],
                look.color,
                meta={"keys": [[point.key] for point in curve.points]},
                text=[f"rate {point.rate}" if point.rate else "default" for point in curve.points],
                marker={"color": look.color, "size": 8, "symbol": look.marker},
                hovertemplate=f"%{{text}}<br>%{{x:.4~g}} MiB<br>%{{y:.2f}} dB<extra>{curve.title}</extra>",
            )
        )

    def place(x: float, y: float) -> tuple[float, float]:
        return share(math.log10(x), x_axis["range"]), share(y, y_range)

    ends, along = rate_distortion.labels(curves, names)
    written = notes(
        [(math.log10(x), y, text, shade) for x, y, text, shade in ends],
        [place(x, y) for x, y, _, _ in ends],
        [place(x, y) for x, y in along],
    )
    return figure(
        traces, x_axis, {"range": list(y_range), "title": {"text": "PSNR [dB]"}}, annotations=written
    )
