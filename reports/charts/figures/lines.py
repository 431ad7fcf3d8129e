"""Figures of training: convergence, anytime curves, parts of the loss."""

from __future__ import annotations

from typing import TYPE_CHECKING

from reports.charts import training
from reports.charts.figures.frame import (
    LINES,
    MARKERS,
    MOST_LABELS,
    annotate,
    legend_below,
    log_axis,
    new_figure,
    room_for,
    settle,
    style,
    titled,
)
from reports.style import OTHERS, legend_entries, linear_range, looks, series

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def convergence(
    curve: pd.DataFrame, against: str = "train_seconds", names: list[str] | None = None
) -> Figure:
    """PSNR of held-out views over training seconds or iterations; a panel per dataset, a line per fit."""
    panels = training.convergence(curve, against)
    x, y = training.CURVE_AXIS[against], training.ANYTIME_AXIS["psnr"]
    return _lines(panels, x, y, names or series(curve))


def anytime(curve: pd.DataFrame, results: pd.DataFrame, what: str, names: list[str]) -> Figure:
    """PSNR of held-out views or estimated size over training seconds per scene (log), a line per method."""
    panels = training.anytime(curve, results, what)
    x = "training time per scene [s]"
    return _lines(panels, x, training.ANYTIME_AXIS[what], names, log=True, log_y=what == "bytes_estimate")


def over(panels: dict[str, list[training.Curve]], x: str, y: str, names: list[str], *, log_y: bool) -> Figure:
    """Lines over a logarithmic axis, a panel per dataset; ``x`` and ``y`` are the axes' titles."""
    return _lines(panels, x, y, names, log=True, log_y=log_y)


def _lines(
    panels: dict[str, list[training.Curve]],
    x: str,
    y: str,
    names: list[str],
    log: bool = False,
    log_y: bool = False,
) -> Figure:
    with style():
        figure, axes = new_figure(len(panels))
        crowded = any(len(lines) > MOST_LABELS for lines in panels.values())
        for axis, (dataset, lines) in zip(axes, panels.items(), strict=False):
            for name, look in looks([line.name for line in lines], names).items():
                width = 0.6 if look is OTHERS else 1.2
                for line in (line for line in lines if line.name == name):
                    axis.plot(line.x, line.y, LINES[look.dash], marker=MARKERS[look.marker],
                              color=look.color, markersize=2.5 * width, linewidth=width)  # fmt: skip
            axis.margins(x=0.02)
            heights = [value for line in lines for value in line.y]
            if log_y:
                log_axis(axis, heights, "y")
            else:
                axis.set_ylim(*linear_range(heights, 2.0))
            room = 0.0 if crowded else room_for([line.title for line in lines])
            if log:
                log_axis(axis, [value for line in lines for value in line.x], room=room)
            else:
                left, right = axis.get_xlim()
                axis.set_xlim(left, left + (right - left) / (1.0 - room))
            titled(axis, dataset, x, y)
        if crowded:
            drawn = [[line.name for line in lines] for lines in panels.values()]
            legend_below(figure, legend_entries(drawn, names))
        settle(figure)
        for axis, lines in zip(axes, panels.values(), strict=False):
            if not crowded:
                shades = looks([line.name for line in lines], names)
                ends = [(line.x[-1], line.y[-1], line.title, shades[line.name].color) for line in lines]
                annotate(axis, ends, [at for line in lines for at in zip(line.x, line.y, strict=True)])
    return figure


def losses(panels: list[training.Losses]) -> Figure:
    """Parts of the loss (log) over iterations, mean over fits; a panel per dataset and method."""
    with style():
        figure, axes = new_figure(len(panels))
        for axis, panel in zip(axes, panels, strict=False):
            for part, shade in zip(panel.parts, training.shades(panel, panels), strict=True):
                width = 2.0 if part.name == "loss" else 1.3
                style_of = "-o" if len(part.x) <= training.MARKED else "-"
                axis.plot(part.x, part.y, style_of, color=shade, markersize=2.5, linewidth=width)
            for iteration, text in panel.marks:
                axis.axvline(iteration, color="#777777", linestyle="--", linewidth=0.9)
                axis.annotate(text, (iteration, 0.02), (3, 0), textcoords="offset points",
                              xycoords=("data", "axes fraction"), ha="left", va="bottom", rotation=90,
                              fontsize=8, color="#555555")  # fmt: skip
            log_axis(axis, [value for part in panel.parts for value in part.y], "y")
            left, right = axis.get_xlim()
            axis.set_xlim(left, right + 0.22 * (right - left))  # room for the labels at the ends
            titled(axis, f"{panel.dataset} · {panel.title}", "iteration", "loss")
        settle(figure)
        for axis, panel in zip(axes, panels, strict=False):
            shades = training.shades(panel, panels)
            ends = [
                (part.x[-1], part.y[-1], part.title, shade)
                for part, shade in zip(panel.parts, shades, strict=True)
            ]
            annotate(axis, ends, training.along(panel))
    return figure
