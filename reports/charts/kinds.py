"""The kinds of charts: what :mod:`reports.charts.data` and its neighbours compute, as charts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

from reports.charts import data, features, rate_distortion, training
from reports.charts.chart import (
    GRAY,
    INK,
    MOST_LABELS,
    Axis,
    Bar,
    Chart,
    Panel,
    Series,
    Text,
    linear_axis,
    log_axis,
    room_for,
)
from reports.charts.labels import text_width
from reports.charts.parts import colors
from reports.style import OTHERS, OTHERS_NAME, PALETTE, Look, legend_entries, looks, mib

Panels = Mapping[str, Sequence[training.Curve]]
"""Title -> lines."""
_QUALITY = "PSNR [dB]"
_BARS = 540.0
"""Width of stacked bars with their totals in pixels."""


def tradeoff(panels: Sequence[data.Panel], column: str, names: list[str]) -> Chart:
    """PSNR against a column of :data:`reports.charts.data.AXIS` (log); the dominated region is shaded.

    Args:
        panels: as :func:`reports.charts.data.tradeoff` makes them.
        column: of the horizontal axis.
        names: series of the report.
    """
    parts = []
    for panel in panels:
        x = log_axis(panel.all_x, panel.axis(data.AXIS[column].axis_title))
        y = linear_axis(panel.all_y, _QUALITY, least=2.0)
        series = _dominated(panel.dominated(x.low if panel.better > 0 else x.high, y.low))
        for line, look in panel.looks(names):
            if line.scene_x:
                dot = Look(look.color, "circle", "")
                scenes = Series(line.title, line.scene_x, line.scene_y, dot, mark=5.0, opacity=0.4)
                series.append(replace(scenes, names=line.scenes, keys=line.scene_keys))
            if line.x:
                size = 6.0 if look is OTHERS else 8.5
                means = Series(line.title, line.x, line.y, look._replace(dash="solid"), line=1.6, mark=size)
                texts = ["mean over scenes"] * len(line.x)
                series.append(replace(means, names=texts, keys=line.keys))
        labels = [Text(*label) for label in panel.labels(names)]
        parts.append(Panel(panel.title, x, y, series, labels, panel.to_avoid))
    gray = any(look is OTHERS for panel in panels for _, look in panel.looks(names))
    return Chart(parts, {OTHERS_NAME: OTHERS} if gray else {})


def _dominated(outline: list[tuple[float, float]]) -> list[Series]:
    """The region below the Pareto front, and the front."""
    if not outline:
        return []
    x, y = ([spot[i] for spot in outline] for i in (0, 1))
    look = Look(GRAY, "", "dash")
    return [Series("", x, y, look, fill=True, opacity=0.13), Series("", x[1:-1], y[1:-1], look, line=1.0)]


def rate_curves(panels: Mapping[str, list[rate_distortion.Curve]], names: list[str]) -> Chart:
    """PSNR over size (log) at all rates, a panel per dataset; defaults of other methods are single marks."""
    parts = []
    for title, curves in panels.items():
        x = log_axis([x for curve in curves for x in curve.mebibytes], data.AXIS["size_bytes"].axis_title)
        y = linear_axis([point.psnr for curve in curves for point in curve.points], _QUALITY, least=2.0)
        series = []
        for curve, look in rate_distortion.looks(curves, names):
            heights = [point.psnr for point in curve.points]
            line = look._replace(dash="solid")
            texts = [f"rate {point.rate}" if point.rate else "default" for point in curve.points]
            keys = [[point.key] for point in curve.points]
            series.append(
                Series(curve.title, curve.mebibytes, heights, line, 1.6, 7.0, names=texts, keys=keys)
            )
        ends, along = rate_distortion.labels(curves, names)
        parts.append(Panel(title, x, y, series, [Text(*end) for end in ends], along))
    return Chart(parts)


def anytime(panels: Panels, what: str, names: list[str]) -> Chart:
    """PSNR or estimated size (log) over training seconds per scene (log), a line per method.

    Args:
        panels: as :func:`reports.charts.training.anytime` makes them.
        what: "psnr" or "bytes_estimate".
        names: series of the report.
    """
    return over(
        panels, "training time per scene [s]", training.ANYTIME_AXIS[what], names, log_y=what != "psnr"
    )


def over(panels: Panels, x: str, y: str, names: list[str], *, log_y: bool) -> Chart:
    """Lines over a logarithmic axis, a panel per dataset; ``x`` and ``y`` are the axes' titles."""
    return _lines(panels, partial(log_axis, title=x), _upright(y, log_y), names)


def convergence(panels: Panels, against: str, names: list[str]) -> Chart:
    """PSNR over "train_seconds" or "iteration", a line per fit."""
    x = partial(linear_axis, title=training.CURVE_AXIS[against], start=0.0)
    return _lines(panels, x, _upright(training.ANYTIME_AXIS["psnr"], False), names)


def _upright(title: str, log: bool) -> Callable[[list[float]], Axis]:
    return partial(log_axis, title=title) if log else partial(linear_axis, title=title, least=2.0)


def _lines(
    panels: Panels, x: Callable[..., Axis], y: Callable[[list[float]], Axis], names: list[str]
) -> Chart:
    """Lines named at their ends; where there are too many a legend names them."""
    parts = []
    for title, curves in panels.items():
        styles = looks([curve.name for curve in curves], names)
        few = len(curves) <= MOST_LABELS
        room = room_for([curve.title for curve in curves])
        series = []
        for curve in sorted(curves, key=lambda curve: list(styles).index(curve.name)):
            look = styles[curve.name]
            line, mark = (0.8, 3.0) if look is OTHERS else (1.6, 4.5)
            series.append(Series(curve.title, curve.x, curve.y, look, line=line, mark=mark))
        parts.append(
            Panel(
                title,
                x([value for curve in curves for value in curve.x], room=room),
                y([value for curve in curves for value in curve.y]),
                series,
                [Text(c.x[-1], c.y[-1], c.title, styles[c.name].color) for c in curves] if few else [],
                [spot for c in curves for spot in zip(c.x, c.y, strict=True)] if few else [],
            )
        )
    crowded = any(len(curves) > MOST_LABELS for curves in panels.values())
    series_names = [[curve.name for curve in curves] for curves in panels.values()]
    return Chart(parts, legend_entries(series_names, names) if crowded else {})


def losses(panels: list[training.Losses]) -> Chart:
    """Parts of the loss (log) over iterations, a panel per dataset and method."""
    parts = []
    for panel in panels:
        shades = training.shades(panel, panels)
        room = room_for([part.title for part in panel.parts])
        x = linear_axis([v for part in panel.parts for v in part.x], "iteration", start=0.0, room=room)
        y = log_axis([v for part in panel.parts for v in part.y], "loss")
        series, labels = [], []
        for part, shade in zip(panel.parts, shades, strict=True):
            look, width = Look(shade, "circle", "solid"), 2.4 if part.name == "loss" else 1.6
            mark = 0.0 if len(part.x) > training.MARKED else 4.0
            series.append(Series(part.title, part.x, part.y, look, width, mark))
            labels.append(Text(part.x[-1], part.y[-1], part.title, shade))
        title = f"{panel.dataset} \N{MIDDLE DOT} {panel.title}"
        parts.append(Panel(title, x, y, series, labels, training.along(panel), panel.marks))
    return Chart(parts)


def _stacked(bars: list[data.Bar], families: list[str], title: str, amount: Callable[[float], str]) -> Chart:
    """Shares of wholes by part, a bar per dataset and method with its total."""
    boxes = []
    shades = colors(families)
    for row, bar in enumerate(bars):
        start = 0.0
        for family in families:
            if share := bar.percent(family):
                about = "\n".join([bar.title, f"{family}: {_amounts(bar, family, amount)}"])
                boxes.append(Bar(row, start, start + share, shades[family], about))
                start += share
    room = (max((text_width(bar.total_text) for bar in bars), default=0.0) + 12.0) / _BARS
    ticks = tuple((value, str(value)) for value in range(0, 101, 20))
    x = Axis(title, 0.0, 100.0 / (1.0 - room), ticks=ticks)
    y = Axis("", len(bars) - 0.5, -0.5, ticks=tuple((i, bar.title) for i, bar in enumerate(bars)), grid=False)
    totals = [Text(100.0, row, bar.total_text, INK) for row, bar in enumerate(bars)]
    width = _BARS + 20.0 + max((text_width(bar.title) for bar in bars), default=0.0)
    panel = Panel("", x, y, labels=totals, bars=boxes, width=width, height=52.0 + 26.0 * len(bars))
    return Chart([panel], {family: Look(shade, "square", "") for family, shade in shades.items()})


def ledger(bars: list[data.Bar], families: list[str]) -> Chart:
    """Share of the bytes by part."""
    return _stacked(bars, families, "share of size [%]", lambda count: f"{mib(count)} MiB ({count:,.0f} B)")


def timing(bars: list[data.Bar], families: list[str]) -> Chart:
    """Share of a frame's time by part."""
    return _stacked(bars, families, "share of frame time [%]", lambda clock: f"{1e3 * clock:.3g} ms")


def _amounts(bar: data.Bar, family: str, amount: Callable[[float], str]) -> str:
    """An amount, and its parts where its name is not the only one."""
    text = amount(bar.amounts.get(family, 0.0))
    details = bar.details.get(family, {})
    if set(details) <= {family}:
        return text
    return "\n".join([text, *(f"{part}: {amount(value)}" for part, value in details.items())])


def histograms(panels: list[features.Histogram], names: list[str]) -> Chart:
    """Distribution of each attribute on each dataset, an outline per method."""
    parts = []
    for panel in panels:
        heights = [share for shares in panel.shares.values() for share in shares]
        x = linear_axis(panel.edges, panel.attribute)
        y = linear_axis([0.0, *heights], "samples per bin [%]", start=0.0)
        corners = [edge for edge in panel.edges for _ in (0, 1)][1:-1]
        series = [
            Series(name, corners, [share for share in panel.shares[name] for _ in (0, 1)], look, line=1.5)
            for name, look in looks(panel.shares, names).items()
        ]
        parts.append(Panel(f"{panel.dataset} \N{MIDDLE DOT} {panel.attribute}", x, y, series))
    entries = legend_entries([panel.shares for panel in panels], names)
    return Chart(parts, {name: look._replace(marker="") for name, look in entries.items()})


def feature_maps(panels: list[features.Map]) -> Chart:
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
