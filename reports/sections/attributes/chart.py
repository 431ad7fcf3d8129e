"""The charts of attributes: histograms, and a map of anchors by their features."""

from __future__ import annotations

from dataclasses import replace

from econgs_bench.reports.charts.chart import Chart, Panel, Series, linear_axis
from econgs_bench.reports.sections.attributes.table import Histogram, Map
from econgs_bench.reports.style import PALETTE, Look, Model, legend_entries, looks


def histogram_chart(panels: list[Histogram], models: list[Model]) -> Chart:
    """Distribution of each attribute on each dataset, an outline per model."""
    parts = []
    for panel in panels:
        heights = [share for shares in panel.shares.values() for share in shares]
        x = linear_axis(panel.edges, panel.attribute)
        y = linear_axis([0.0, *heights], "samples per bin [%]", start=0.0)
        corners = [edge for edge in panel.edges for _ in (0, 1)][1:-1]
        styles = looks(panel.shares, models)
        series = [
            Series(
                each.title, corners, [share for share in panel.shares[each] for _ in (0, 1)], look, line=1.5
            )
            for each, look in styles.items()
        ]
        parts.append(Panel(f"{panel.dataset} \N{MIDDLE DOT} {panel.attribute}", x, y, series))
    entries = legend_entries([panel.shares for panel in panels], models)
    return Chart(parts, {name: look._replace(marker="") for name, look in entries.items()})


def map_chart(panels: list[Map]) -> Chart:
    """Anchors by their features in two dimensions, colored by scene."""
    scenes = list(dict.fromkeys(scene for panel in panels for scene in panel.scenes))
    shades = {scene: Look(PALETTE[i % len(PALETTE)], "circle", "") for i, scene in enumerate(scenes)}
    parts = []
    for panel in panels:
        spots = {scene: (rows[:, 0].tolist(), rows[:, 1].tolist()) for scene, rows in panel.scenes.items()}
        x, y = (
            replace(linear_axis([v for each in spots.values() for v in each[i]], f"UMAP {i + 1}"), ticks=())
            for i in (0, 1)
        )
        series = [Series(scene, *spots[scene], shades[scene], 0.0, 2.5, 0.5) for scene in spots]
        parts.append(Panel(f"{panel.dataset} \N{MIDDLE DOT} {panel.title}", x, y, series, height=360.0))
    return Chart(parts, shades)
