"""Figures of quality against what it costs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from reports.charts import data, rate_distortion
from reports.charts.figures.frame import (
    MARKERS,
    annotate,
    legend_below,
    log_axis,
    new_figure,
    settle,
    style,
    titled,
)
from reports.style import MIB, OTHERS, OTHERS_NAME, linear_range, series

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def tradeoff(results: pd.DataFrame, against: str) -> Figure:
    """PSNR against what it costs (log), one panel per dataset; the dominated region is shaded.

    Args:
        results: the documented table.
        against: a column of :data:`reports.charts.data.AXIS`.
    """
    names = series(results)
    panels = data.tradeoff(results, against)
    with style():
        figure, axes = new_figure(len(panels))
        if not panels:
            axes[0].text(0.5, 0.5, "nothing measured", ha="center", va="center", transform=axes[0].transAxes)
        for axis, panel in zip(axes, panels, strict=False):
            log_axis(axis, panel.all_x)
            axis.set_ylim(*linear_range(panel.all_y, 2.0))
            left, right = axis.get_xlim()
            outline = panel.dominated(left if panel.better > 0 else right, axis.get_ylim()[0])
            if outline:
                axis.fill(*zip(*outline, strict=True), color="#000000", alpha=0.06, linewidth=0)
                axis.plot(*zip(*outline[1:-1], strict=True), "--", color="#777777", linewidth=0.9)
            for line, look in panel.looks(names):
                axis.scatter(line.scene_x, line.scene_y, s=14, color=look.color, alpha=0.35, linewidths=0)
                symbol, size = MARKERS[look.marker], 4.5 if look is OTHERS else 6.5
                axis.plot(
                    line.x, line.y, "-", marker=symbol, color=look.color, markersize=size, linewidth=1.3
                )
            titled(axis, panel.title, panel.axis(data.AXIS[against].axis_title), "PSNR [dB]")
        if any(look is OTHERS for panel in panels for _, look in panel.looks(names)):
            legend_below(figure, {OTHERS_NAME: OTHERS})
        settle(figure)
        for axis, panel in zip(axes, panels, strict=False):
            annotate(axis, panel.labels(names), panel.to_avoid)
    return figure


def rate_curves(results: pd.DataFrame) -> Figure:
    """PSNR over size (log) at all rates, a panel per dataset; defaults of other methods are single marks."""
    names = series(results)
    panels = rate_distortion.drawn(rate_distortion.curves(results))
    with style():
        figure, axes = new_figure(len(panels))
        for axis, (dataset, curves) in zip(axes, panels.items(), strict=False):
            log_axis(axis, [point.bytes / MIB for curve in curves for point in curve.points])
            axis.set_ylim(*linear_range([point.psnr for curve in curves for point in curve.points], 2.0))
            for curve, look in rate_distortion.looks(curves, names):
                x, y = curve.mebibytes, [point.psnr for point in curve.points]
                symbol = MARKERS[look.marker]
                axis.plot(x, y, "-", marker=symbol, color=look.color, markersize=5, linewidth=1.3)
            titled(axis, dataset, data.AXIS["size_bytes"].axis_title, "PSNR [dB]")
        settle(figure)
        for axis, curves in zip(axes, panels.values(), strict=False):
            annotate(axis, *rate_distortion.labels(curves, names))
    return figure
