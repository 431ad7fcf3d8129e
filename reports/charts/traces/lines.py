"""The page's charts of training."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from reports.charts import training
from reports.charts.traces.frame import (
    GREY,
    MOST_LABELS,
    Figure,
    figure,
    line,
    log_axis,
    notes,
    room_for,
    share,
)
from reports.style import OTHERS, linear_range, looks

if TYPE_CHECKING:
    import pandas as pd


def convergence(curve: pd.DataFrame, against: str, names: list[str]) -> dict[str, Figure]:
    """Dataset -> PSNR of held-out views over "train_seconds" or "iteration"; ``names``: of the report."""
    title = training.CURVE_AXIS[against]
    made = {}
    for dataset, lines in training.convergence(curve, against).items():
        ends = (0.0, _widened(max(max(row.x) for row in lines), lines))
        x_axis = {"range": list(ends), "title": {"text": title}}
        y_range = linear_range([y for row in lines for y in row.y], 2.0)
        y_axis = {"range": list(y_range), "title": {"text": training.ANYTIME_AXIS["psnr"]}}
        hover = f"{title} %{{x:.5~g}}<br>%{{y:.2f}} dB"
        made[dataset] = _lines(lines, x_axis, y_axis, hover, names)
    return made


def anytime(curve: pd.DataFrame, results: pd.DataFrame, what: str, names: list[str]) -> dict[str, Figure]:
    """Dataset -> PSNR of held-out views or estimated size (log) over training seconds per scene (log)."""
    made = {}
    for dataset, lines in training.anytime(curve, results, what).items():
        room = room_for([row.title for row in lines])
        x_axis = log_axis([x for row in lines for x in row.x], "training time per scene [s]", room)
        values = [y for row in lines for y in row.y]
        if what == "bytes_estimate":
            y_axis = log_axis(values, training.ANYTIME_AXIS[what])
            hover = "%{x:.4~g} s<br>%{y:.4~g} MiB"
        else:
            y_axis = {
                "range": list(linear_range(values, 2.0)),
                "title": {"text": training.ANYTIME_AXIS[what]},
            }
            hover = "%{x:.4~g} s<br>%{y:.2f} dB"
        made[dataset] = _lines(lines, x_axis, y_axis, hover, names)
    return made


def over(
    panels: dict[str, list[training.Curve]], x: str, y: str, names: list[str], *, log_y: bool
) -> dict[str, Figure]:
    """Dataset -> lines over a logarithmic axis; ``x`` and ``y`` are the axes' titles."""
    made = {}
    for dataset, lines in panels.items():
        x_axis = log_axis([v for row in lines for v in row.x], x, room_for([row.title for row in lines]))
        values = [v for row in lines for v in row.y]
        y_axis = (
            log_axis(values, y) if log_y else {"range": list(linear_range(values, 2.0)), "title": {"text": y}}
        )
        made[dataset] = _lines(lines, x_axis, y_axis, f"{x} %{{x:,}}<br>{y} %{{y:.4~g}}", names)
    return made


def _widened(end: float, lines: list[training.Curve]) -> float:
    """Room for the labels at the lines' ends."""
    return (end or 1.0) / (1.0 - room_for([row.title for row in lines]))


def _lines(
    lines: list[training.Curve],
    x_axis: dict[str, Any],
    y_axis: dict[str, Any],
    hover: str,
    names: list[str],
) -> Figure:
    styles = looks([row.name for row in lines], names)
    traces = []
    for row in sorted(lines, key=lambda row: list(styles).index(row.name)):
        look = styles[row.name]
        stroke = {"color": look.color, "width": 0.8 if look is OTHERS else 1.6, "dash": look.dash}
        mark = {"size": 5, "symbol": look.marker}
        extra = f"{hover}<extra>{row.title}</extra>"
        traces.append(line(row.x, row.y, "", marker=mark, hovertemplate=extra) | {"line": stroke})
    written = []
    if len(lines) <= MOST_LABELS:
        labels = [
            (_on(x_axis, row.x[-1]), _on(y_axis, row.y[-1]), row.title, styles[row.name].color)
            for row in lines
        ]

        def place(x: float, y: float) -> tuple[float, float]:
            return share(x, x_axis["range"]), share(y, y_axis["range"])

        along = [
            place(_on(x_axis, x), _on(y_axis, y)) for row in lines for x, y in zip(row.x, row.y, strict=True)
        ]
        written = notes(labels, [place(x, y) for x, y, _, _ in labels], along)
    return figure(traces, x_axis, y_axis, annotations=written)


def _on(axis: dict[str, Any], value: float) -> float:
    """A value in an axis' own coordinates."""
    return math.log10(value) if axis.get("type") == "log" else value


def losses(tables: Mapping[str, pd.DataFrame]) -> list[tuple[training.Losses, Figure]]:
    """Parts of the loss (log) over iterations, a chart per dataset and method."""
    panels = training.losses(tables)
    return [(panel, _losses(panel, training.shades(panel, panels))) for panel in panels]


def _losses(panel: training.Losses, shades: list[str]) -> Figure:
    ends = (0.0, _widened(max(part.x[-1] for part in panel.parts), panel.parts))
    y_axis = log_axis([y for part in panel.parts for y in part.y], "loss")
    traces = [
        line(part.x, part.y, "", marker={"size": 4}, name=part.title, hovertemplate="%{x:,}: %{y:.4~g}")
        | {"line": {"color": shade, "width": 2.4 if part.name == "loss" else 1.6}}
        | ({"mode": "lines"} if len(part.x) > training.MARKED else {})
        for part, shade in zip(panel.parts, shades, strict=True)
    ]
    labels = [
        (part.x[-1], math.log10(part.y[-1]), part.title, shade)
        for part, shade in zip(panel.parts, shades, strict=True)
    ]
    spots = [(share(x, ends), share(y, y_axis["range"])) for x, y, _, _ in labels]
    along = [(share(x, ends), share(math.log10(y), y_axis["range"])) for x, y in training.along(panel)]
    stroke = {"color": GREY, "width": 1, "dash": "dash"}
    upright = {"type": "line", "yref": "paper", "y0": 0, "y1": 1, "line": stroke}
    shapes = [{**upright, "x0": iteration, "x1": iteration} for iteration, _ in panel.marks]
    told = [
        {"x": iteration, "yref": "paper", "y": 0.02, "yanchor": "bottom", "textangle": -90,
         "text": text, "showarrow": False, "xanchor": "left", "font": {"size": 11, "color": GREY}}
        for iteration, text in panel.marks
    ]  # fmt: skip
    x_axis = {"range": list(ends), "title": {"text": "iteration"}}
    return figure(traces, x_axis, y_axis, shapes=shapes, annotations=[*told, *notes(labels, spots, along)])
