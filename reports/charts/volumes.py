"""Charts of models beside the compressed volume."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from econgs_bench.reports.charts.chart import INK, Chart, Panel, Series, Text, broken_axis, log_axis
from econgs_bench.reports.charts.elements import Section, cards, table
from econgs_bench.reports.charts.levels import with_floor
from econgs_bench.reports.conclusions.volumes import (
    HEADS,
    Verdict,
    conclusion,
    memory_and_times,
    row,
    verdicts,
)
from econgs_bench.reports.curves import floor_of
from econgs_bench.reports.style import MIB, Look, Model, looks

if TYPE_CHECKING:
    from econgs_bench.reports.charts.report import Report
    from econgs_bench.reports.curves import Curve

_WORDS = (
    "Left: mean PSNR of the pictures over size per scene, of models and of the volume itself, compressed; a "
    "black cross stands where a curve of the volume "
    "passes that of a model, which pays at smaller sizes only. Right: time of a view over memory, at all "
    "rates. The volume is drawn by the marcher that drew the ground truth, so its error is that of the "
    "compression alone, which favours it, and it takes every other transfer function without more bytes. "
    "Its size is shared by the scenes of a variable."
)


def volumes_chart(curves: dict[str, list[Curve]], found: Sequence[Verdict], models: list[Model]) -> Chart:
    """Two panels of each dataset with a volume and a model: PSNR over size, time of a view over memory."""
    panels = []
    for dataset in dict.fromkeys(one.dataset for one in found):
        rows = curves[dataset]
        styles = looks([curve.model for curve in rows], models)
        curve_of = {curve.model: curve for curve in rows}
        series, labels = [], []
        for each, look in styles.items():
            curve = curve_of[each]
            across, up = curve.mebibytes, [point.psnr for point in curve.points]
            series.append(Series(curve.title, across, up, look, 1.6, 7.0))
            labels.append(Text(across[-1], up[-1], curve.title, look.color))
        crossings = [one for one in found if one.dataset == dataset and one.meeting is not None]
        for one in crossings:
            assert one.meeting is not None
            name = f"{one.volume.title} passes {one.model.title}"
            spot = [one.meeting[0] / MIB], [one.meeting[1]]
            series.append(Series(name, *spot, Look(INK, "x", ""), mark=9.0, names=[""]))
        x = log_axis([value for one in series for value in one.x], "size per scene [MiB]")
        heights = [[point.psnr for point in curve.points] for curve in rows]
        y = broken_axis(heights, "PSNR [dB]", least=2.0)
        panels.append(with_floor(Panel(dataset, x, y, series, labels, along=True), floor_of(rows)))
        if costs := _costs(dataset, rows, styles):
            panels.append(costs)
    return Chart(panels)


def _costs(dataset: str, rows: Sequence[Curve], styles: dict[Model, Look]) -> Panel | None:
    """Milliseconds of a view over memory, a mark for each rate."""
    series, labels = [], []
    for curve in sorted(rows, key=lambda curve: list(styles).index(curve.model)):
        memory, times = memory_and_times(curve)
        if memory:
            look = styles[curve.model]
            series.append(Series(curve.title, memory, times, look, mark=7.0, names=[""] * len(times)))
            labels.append(Text(memory[-1], times[-1], curve.title, look.color))
    if not series:
        return None
    x = log_axis([value for one in series for value in one.x], "host memory [MiB]")
    y = log_axis([value for one in series for value in one.y], "time of a view [ms]")
    return Panel(f"{dataset}, costs", x, y, series, labels)


def volumes_section(report: Report) -> Section | None:
    """Models beside the compressed volume; None where there are not both."""
    found = verdicts(report.curves)
    if not found:
        return None
    chart = volumes_chart(report.curves, found, report.models)
    html = (
        f"<p><b>{escape(conclusion(found))}</b></p><p>{_WORDS}</p>{cards(chart.panels)}"
        f"{table('Models and the volume at equal PSNR', HEADS, [row(one) for one in found])}"
    )
    return Section("volumes", "When does a model pay", html, {"volumes": chart})
