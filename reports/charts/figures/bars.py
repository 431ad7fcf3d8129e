"""Figures of wholes and their parts, and of how attributes are distributed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from reports.charts import data, features
from reports.charts.figures.frame import LINES, legend_below, new_figure, settle, style, titled
from reports.charts.parts import colors
from reports.style import PALETTE, Look, legend_entries, looks

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def ledger(table: pd.DataFrame) -> Figure:
    """Share of the bytes by part, a stacked bar per dataset and method with its total."""
    return _stacked(*data.ledger(table), "share of size [%]")


def timing(table: pd.DataFrame) -> Figure:
    """Share of a frame's time by part, a stacked bar per dataset and method with its milliseconds."""
    return _stacked(*data.timing(table), "share of frame time [%]")


def _stacked(bars: list[data.Bar], parts: list[str], x: str) -> Figure:
    with style():
        columns = 4  # of the legend, which stands below the bars
        height = 0.8 + 0.34 * max(1, len(bars)) + 0.22 * -(-len(parts) // columns)
        longest = max((len(bar.title) for bar in bars), default=0)
        figure, (axis,) = new_figure(1, 7.2 + 0.07 * max(0, longest - 45), height)
        rows = range(len(bars))  # titles may be equal
        left = [0.0] * len(bars)
        for part, shade in colors(parts).items():
            widths = [bar.percent(part) for bar in bars]
            axis.barh(rows, widths, left=left, color=shade, label=part, height=0.62)
            left = [a + b for a, b in zip(left, widths, strict=True)]
        for i, bar in enumerate(bars):
            axis.text(101, i, bar.told, va="center", fontsize=8)
        axis.set_yticks(rows, [bar.title for bar in bars])
        axis.set_xlim(0, 118)
        axis.set_xticks(range(0, 101, 20))
        axis.set_ylim(len(bars) - 0.4, -0.6)
        axis.grid(axis="y", visible=False)
        axis.set_xlabel(x)
        if parts:
            figure.legend(loc="outside lower center", ncols=columns)
        settle(figure)
    return figure


def histograms(table: pd.DataFrame, names: list[str]) -> Figure:
    """Distribution of each attribute, a panel per dataset and attribute, an outline per method."""
    panels = features.histograms(table)
    with style():
        figure, axes = new_figure(len(panels), height=2.9)
        for axis, panel in zip(axes, panels, strict=False):
            for name, look in looks(panel.shares, names).items():
                axis.stairs(panel.shares[name], panel.edges, color=look.color, linestyle=LINES[look.dash],
                            linewidth=1.3)  # fmt: skip
            titled(axis, f"{panel.dataset} · {panel.attribute}", panel.attribute, "samples per bin [%]")
        entries = legend_entries([panel.shares for panel in panels], names)
        if len(entries) > 1:
            legend_below(figure, {name: look._replace(marker="") for name, look in entries.items()})
        settle(figure)
    return figure


def feature_maps(panels: list[features.Map]) -> Figure:
    """Anchors by their features in two dimensions, colored by scene."""
    with style():
        figure, axes = new_figure(len(panels), height=4.2)
        scenes = list(dict.fromkeys(scene for panel in panels for scene in panel.scenes))
        shades = {scene: PALETTE[i % len(PALETTE)] for i, scene in enumerate(scenes)}
        for axis, panel in zip(axes, panels, strict=False):
            for scene, spots in panel.scenes.items():
                axis.scatter(spots[:, 0], spots[:, 1], s=4, color=shades[scene], alpha=0.5, linewidths=0)
            titled(axis, f"{panel.dataset} · {panel.title}", "UMAP 1", "UMAP 2")
            axis.set_xticks([])
            axis.set_yticks([])
        legend_below(figure, {scene: Look(shade, "circle", "") for scene, shade in shades.items()})
        settle(figure)
    return figure
