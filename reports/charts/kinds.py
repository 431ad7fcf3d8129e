"""The kinds of charts: what :mod:`.reports.charts.data` and its neighbours compute, as charts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

from econgs_bench.reports.charts import data, features, training
from econgs_bench.reports.charts.chart import (
    GRAY,
    INK,
    Axis,
    Bar,
    Chart,
    Panel,
    Series,
    Text,
    broken_axis,
    linear_axis,
    log_axis,
    room_for,
)
from econgs_bench.reports.charts.labels import text_width
from econgs_bench.reports.charts.levels import with_floor
from econgs_bench.reports.charts.parts import colors
from econgs_bench.reports.conclusions import economy
from econgs_bench.reports.curves import Curve, floor_of
from econgs_bench.reports.floors import Floor
from econgs_bench.reports.schema import PRUNED
from econgs_bench.reports.style import OTHERS, OTHERS_NAME, PALETTE, Look, Model, legend_entries, looks, mib

Panels = Mapping[str, Sequence[training.Curve]]
"""Title -> lines."""
_QUALITY = "PSNR [dB]"
_MOST_ENDS = 6
"""Lines that are named at their ends; more of them crowd where they meet."""
_BARS = 540.0
"""Width of stacked bars with their totals in pixels."""
_MOST_BARS = 36
"""Stacked bars of a panel: as many as a page of paper holds."""


def tradeoff(panels: Sequence[data.Panel], column: str, models: list[Model]) -> Chart:
    """PSNR against a column of :data:`.reports.charts.data.AXIS` (log); the dominated region is shaded.

    Args:
        panels: as :func:`.reports.charts.data.tradeoff` makes them.
        column: of the horizontal axis.
        models: all of the report.
    """
    parts = []
    gray = False
    for panel in panels:
        title = data.AXIS[column].axis_title
        x = log_axis([x for x, _ in panel.spots], title)
        heights = [[spot.y for spot in (*line.means, *line.scenes)] for line in panel.lines]
        y = broken_axis(heights, _QUALITY, least=2.0)
        series = _dominated(panel.dominated(x.low if panel.better > 0 else x.high, y.low))
        for line, look in panel.looks(models):
            gray |= look is OTHERS
            if line.scenes:
                dot = Look(look.color, "circle", "")
                series.append(
                    _spots(line.scenes, Series(line.model.title, (), (), dot, mark=5.0, opacity=0.4))
                )
            if line.means:
                size = 6.0 if look is OTHERS else 8.5
                series.append(_spots(line.means, Series(line.model.title, (), (), look, line=1.6, mark=size)))
        labels = [Text(*label) for label in panel.labels(models)]
        drawn = Panel(panel.title, x, y, series, labels, panel.to_avoid)
        parts.append(with_floor(drawn, panel.floor))
    return Chart(parts, {OTHERS_NAME: OTHERS} if gray else {})


def _spots(spots: Sequence[data.Spot], series: Series) -> Series:
    """A series with these points."""
    x, y, _, names, keys = zip(*spots, strict=True)
    return replace(series, x=x, y=y, names=names, keys=keys)


def _dominated(outline: list[tuple[float, float]]) -> list[Series]:
    """The region below the Pareto front, and the front."""
    if not outline:
        return []
    x, y = ([spot[i] for spot in outline] for i in (0, 1))
    look = Look(GRAY, "", "dash")
    return [Series("", x, y, look, fill=True, opacity=0.13), Series("", x[1:-1], y[1:-1], look, line=1.0)]


def rate_curves(panels: Mapping[str, list[Curve]], models: list[Model]) -> Chart:
    """PSNR over size (log) at all rates, a panel per dataset; defaults of other methods are single marks."""
    parts = []
    for title, curves in panels.items():
        x = log_axis([x for curve in curves for x in curve.mebibytes], data.AXIS["size_bytes"].axis_title)
        y = broken_axis([[point.psnr for point in curve.points] for curve in curves], _QUALITY, least=2.0)
        styles = looks([curve.model for curve in curves], models)
        series, labels = [], []
        for curve in sorted(curves, key=lambda curve: list(styles).index(curve.model)):
            look, size, heights = styles[curve.model], curve.mebibytes, [point.psnr for point in curve.points]
            texts = [f"rate {point.rate}" if point.rate else "default" for point in curve.points]
            keys = [[point.key] for point in curve.points]
            series.append(Series(curve.title, size, heights, look, 1.6, 7.0, names=texts, keys=keys))
            if look is not OTHERS:
                labels.append(Text(size[-1], heights[-1], curve.title, look.color))
        parts.append(with_floor(Panel(title, x, y, series, labels, along=True), floor_of(curves)))
    return Chart(parts)


def lines(
    panels: Panels,
    x: str,
    y: str,
    models: list[Model],
    *,
    log_x: bool = True,
    log_y: bool = False,
    floors: Mapping[str, Floor | None] = MappingProxyType({}),
) -> Chart:
    """Lines named at their ends, a panel per dataset; where there are too many a legend names them.

    Args:
        panels: dataset -> lines.
        x: title of the horizontal axis.
        y: title of the vertical axis.
        models: all of the report.
        log_x: whether x is logarithmic; a linear axis begins at 0.
        log_y: whether y is logarithmic.
        floors: panel -> noise floor of its truth, where y is PSNR.
    """
    across = partial(log_axis, title=x) if log_x else partial(linear_axis, title=x, start=0.0)
    parts = []
    for title, curves in panels.items():
        styles = looks([curve.model for curve in curves], models)
        few = len(curves) <= _MOST_ENDS
        names = [curve.title for curve in curves] if few else []
        series = []
        for curve in sorted(curves, key=lambda curve: list(styles).index(curve.model)):
            look = styles[curve.model]
            line, mark = (0.8, 3.0) if look is OTHERS else (1.6, 4.5)
            series.append(Series(curve.title, curve.x, curve.y, look, line=line, mark=mark))
        drawn = Panel(
            title,
            across([v for curve in curves for v in curve.x], room=room_for(names)),
            log_axis([v for curve in curves for v in curve.y], y)
            if log_y
            else broken_axis([curve.y for curve in curves], y, least=2.0),
            series,
            [Text(c.x[-1], c.y[-1], c.title, styles[c.model].color) for c in curves] if few else [],
            [spot for c in curves for spot in zip(c.x, c.y, strict=True)] if few else [],
        )
        parts.append(with_floor(drawn, floors.get(title)))
    crowded = any(len(curves) > _MOST_ENDS for curves in panels.values())
    return Chart(parts, legend_of(panels, models) if crowded else {})


def needs(rows: Sequence[economy.Economy], models: list[Model]) -> Chart:
    """Bytes of a model for a quality over those of the volume without loss (log), a panel per quality.

    A mark is a scene, and faint where the smallest size is above the quality. A line is the growth of bytes
    (:func:`.reports.conclusions.economy.growth`); on the gray one a model takes as many as the volume.
    """
    panels = []
    for level in economy.LEVELS:
        title = f"{level:g} dB"
        own = [
            (one, need.bytes / economy.KIB, need.bound)
            for one in rows
            if (need := one.needs[level]) is not None
        ]
        lines = {
            each: [(across / economy.KIB, up / economy.KIB) for across, up in ends]
            for each, (_, ends) in economy.growth(rows, level).items()
        }
        panels += _over_volume(own, title, f"model for {title} [KiB]", models, lines=lines, log_y=True)
    return Chart(panels, _legend_of_economies(rows, models))


def prunable(rows: Sequence[economy.Economy], models: list[Model]) -> Chart:
    """Share of Gaussians that could go over the bytes of the volume without loss (log)."""
    column = economy.DROP
    own = [(one, 100.0 * one.prunable[column], False) for one in rows if column in one.prunable]
    title = f"Gaussians that could go at {PRUNED[column]:g} dB"
    return Chart(_over_volume(own, title, "share [%]", models), _legend_of_economies(rows, models))


def _over_volume(
    spots: Sequence[tuple[economy.Economy, float, bool]],
    title: str,
    y: str,
    models: list[Model],
    *,
    lines: Mapping[Model, list[tuple[float, float]]] | None = None,
    log_y: bool = False,
) -> list[Panel]:
    """A panel of values, which may be bounds, over the bytes of volumes; none without any.

    Scenes are different things, so no line joins them.
    """
    known = [(one, one.volume / economy.KIB, value, bound) for one, value, bound in spots if one.volume]
    if not known:
        return []
    known.sort(key=lambda spot: spot[1])
    styles = looks([one.model for one, *_ in known], models)
    series = []
    for each, look in styles.items():
        every = [spot for spot in known if spot[0].model == each]
        if lines and each in lines:
            across, up = zip(*lines[each], strict=True)
            series.append(Series("", across, up, look, line=1.6))
        for bound in (False, True):
            if own := [spot for spot in every if spot[3] == bound]:
                scenes, across, up, _ = zip(*own, strict=True)
                names = [one.scene + (", at most" if bound else "") for one in scenes]
                opacity = 0.35 if bound else 1.0
                series.append(Series(each.title, across, up, look, mark=7.0, opacity=opacity, names=names))
    values = [value for _, _, value, _ in known]
    upright = log_axis(values, y) if log_y else linear_axis(values, y, start=0.0)
    x = log_axis([volume for _, volume, *_ in known], "classified volume without loss [KiB]")
    equal = _equal(x, upright)
    labels = [Text(line.x[-1], line.y[-1], "as many as the volume", GRAY) for line in equal]
    return [Panel(title, x, upright, [*equal, *series], labels, [spot[1:3] for spot in known])]


def _equal(x: Axis, y: Axis) -> list[Series]:
    """The line on which two axes of one unit have the same values, where both hold some."""
    low, high = max(x.low, y.low), min(x.high, y.high)
    if x.unit != y.unit or x.log != y.log or low >= high:
        return []
    return [Series("", [low, high], [low, high], Look(GRAY, "", "dash"), line=1.0)]


def _legend_of_economies(rows: Sequence[economy.Economy], models: list[Model]) -> dict[str, Look]:
    """A name for each model, in the order of the report."""
    styles = looks([one.model for one in rows], models)
    return {each.title: styles[each] for each in dict.fromkeys([*models, *styles]) if each in styles}


def legend_of(panels: Panels, models: list[Model]) -> dict[str, Look]:
    """The legend of the charts of these lines."""
    return legend_entries([[curve.model for curve in curves] for curves in panels.values()], models)


def losses(panels: list[training.Losses]) -> Chart:
    """Parts of the loss (log) over iterations, a panel per dataset and method.

    A part has the same color in all panels; the whole is black.
    """
    names = list(dict.fromkeys(part.name for panel in panels for part in panel.parts[1:]))
    shades = {name: PALETTE[i % (len(PALETTE) - 1)] for i, name in enumerate(names)}
    parts = []
    for panel in panels:
        room = room_for([part.name for part in panel.parts])
        x = linear_axis([v for part in panel.parts for v in part.x], "iteration", start=0.0, room=room)
        y = log_axis([v for part in panel.parts for v in part.y], "loss")
        series, labels = [], []
        for i, part in enumerate(panel.parts):
            shade = shades[part.name] if i else PALETTE[-1]
            look, width = Look(shade, "circle", "solid"), 2.4 if part.name == "loss" else 1.6
            mark = 0.0 if len(part.x) > training.MARKED else 4.0
            series.append(Series(part.name, part.x, part.y, look, width, mark))
            labels.append(Text(part.x[-1], part.y[-1], part.name, shade))
        title = f"{panel.dataset} \N{MIDDLE DOT} {panel.title}"
        parts.append(Panel(title, x, y, series, labels, along=True, stages=panel.marks))
    return Chart(parts)


def _stacked(bars: list[data.Bar], families: list[str], title: str, amount: Callable[[float], str]) -> Chart:
    """Shares of wholes by part, a bar per dataset and method with its total; panels of :data:`_MOST_BARS`."""
    shades = colors(families)
    room = (max((text_width(bar.total_text) for bar in bars), default=0.0) + 12.0) / _BARS
    ticks = tuple((value, str(value)) for value in range(0, 101, 20))
    x = Axis(title, 0.0, 100.0 / (1.0 - room), ticks=ticks)
    width = _BARS + 20.0 + max((text_width(bar.title) for bar in bars), default=0.0)
    panels = []
    for first in range(0, max(1, len(bars)), _MOST_BARS):
        part, boxes = bars[first : first + _MOST_BARS], []
        for row, bar in enumerate(part):
            start = 0.0
            for family in families:
                if share := bar.percent(family):
                    about = "\n".join([bar.title, f"{family}: {_amounts(bar, family, amount)}"])
                    boxes.append(Bar(row, start, start + share, shades[family], about))
                    start += share
        names = tuple((row, bar.title) for row, bar in enumerate(part))
        y = Axis("", len(part) - 0.5, -0.5, ticks=names, grid=False)
        totals = [Text(100.0, row, bar.total_text, INK) for row, bar in enumerate(part)]
        height = 52.0 + 26.0 * len(part)
        panels.append(Panel("", x, y, labels=totals, bars=boxes, width=width, height=height))
    return Chart(panels, {family: Look(shade, "square", "") for family, shade in shades.items()})


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


def histograms(panels: list[features.Histogram], models: list[Model]) -> Chart:
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
