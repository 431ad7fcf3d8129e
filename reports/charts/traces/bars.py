"""The page's charts of wholes and their parts, and of how attributes are distributed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from reports.charts import data, features
from reports.charts.parts import colors
from reports.charts.traces.frame import MARGIN, Figure, figure
from reports.style import PALETTE, looks, mib

if TYPE_CHECKING:
    import pandas as pd


def ledger(table: pd.DataFrame) -> Figure | None:
    """Share of the bytes by part, a stacked bar per dataset and method with its total; None without data."""
    return _stacked(*data.ledger(table), "share of size [%]", lambda n: f"{mib(n)} MiB ({n:,.0f} B)")


def timing(table: pd.DataFrame) -> Figure | None:
    """Share of a frame's time by part, a stacked bar per dataset and method; None without data."""
    return _stacked(*data.timing(table), "share of frame time [%]", lambda s: f"{1e3 * s:.3g} ms")


def _stacked(bars: list[data.Bar], parts: list[str], x: str, told: Callable[[float], str]) -> Figure | None:
    if not bars:
        return None
    rows = list(range(len(bars)))  # titles may be equal
    traces = [
        {
            "type": "bar",
            "orientation": "h",
            "name": part,
            "marker": {"color": shade},
            "y": rows,
            "x": [bar.percent(part) for bar in bars],
            "text": [bar.title for bar in bars],
            "textposition": "none",
            "customdata": [_told(bar, part, told) for bar in bars],
            "hovertemplate": f"{part}: %{{customdata}}<extra>%{{text}}</extra>",
        }
        for part, shade in colors(parts).items()
    ]
    totals = [
        {
            "x": 100,
            "y": i,
            "text": bar.told,
            "showarrow": False,
            "xanchor": "left",
            "xshift": 6,
            "font": {"size": 12},
        }
        for i, bar in enumerate(bars)
    ]
    titles = {"tickvals": rows, "ticktext": [bar.title for bar in bars], "range": [len(bars) - 0.5, -0.5]}
    return figure(
        traces,
        {"title": {"text": x}, "range": [0, 115], "tickvals": [0, 20, 40, 60, 80, 100]},
        {**titles, "automargin": True, "showline": False, "ticklen": 8, "showgrid": False},
        barmode="stack",
        bargap=0.35,
        height=110 + 34 * len(bars),
        showlegend=True,
        legend={"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0, "traceorder": "normal"},
        margin={**MARGIN, "t": 34},
        annotations=totals,
    )


def _told(bar: data.Bar, family: str, told: Callable[[float], str]) -> str:
    """An amount, and what it is made of if that is more than its name says."""
    text = told(bar.amounts.get(family, 0.0))
    details = bar.details.get(family, {})
    if set(details) <= {family}:
        return text
    return "<br>".join([text, *(f"{part}: {told(amount)}" for part, amount in details.items())])


def histograms(table: pd.DataFrame, names: list[str]) -> list[tuple[features.Histogram, Figure]]:
    """Distribution of each attribute on each dataset, an outline per method."""
    made = []
    for panel in features.histograms(table):
        traces = [
            {
                "type": "scatter",
                "mode": "lines",
                "x": panel.edges,
                "y": [*panel.shares[name], 0.0],
                "line": {"shape": "hv", "color": look.color, "dash": look.dash, "width": 1.5},
                "hovertemplate": f"%{{x:.4~g}}: %{{y:.2f}} %<extra>{name}</extra>",
            }
            for name, look in looks(panel.shares, names).items()
        ]
        x_axis, y_axis = {"title": {"text": panel.attribute}}, {"title": {"text": "samples per bin [%]"}}
        made.append((panel, figure(traces, x_axis, {**y_axis, "rangemode": "tozero"})))
    return made


def feature_maps(panels: list[features.Map]) -> list[tuple[features.Map, Figure]]:
    """Anchors by their features in two dimensions, colored by scene."""
    scenes = list(dict.fromkeys(scene for panel in panels for scene in panel.scenes))
    shades = {scene: PALETTE[i % len(PALETTE)] for i, scene in enumerate(scenes)}
    made = []
    for panel in panels:
        traces = [
            {
                "type": "scatter",
                "mode": "markers",
                "name": scene,
                "x": [round(float(x), 3) for x in spots[:, 0]],
                "y": [round(float(y), 3) for y in spots[:, 1]],
                "marker": {"size": 3, "color": shades[scene], "opacity": 0.5},
                "hovertemplate": f"{scene}<extra></extra>",
            }
            for scene, spots in panel.scenes.items()
        ]
        bare = {"showticklabels": False, "showgrid": False}
        x_axis, y_axis = ({**bare, "title": {"text": f"UMAP {i}"}} for i in (1, 2))
        legend = {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0, "itemsizing": "constant"}
        made.append((panel, figure(traces, x_axis, y_axis, showlegend=True, legend=legend, height=360)))
    return made
