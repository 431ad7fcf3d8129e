"""How models do under transfer functions that nobody trained on: PSNR over distance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from econgs_bench.reports.charts.chart import Axis, Chart, Panel, Series, broken_axis
from econgs_bench.reports.charts.elements import Section, cards, legend, table
from econgs_bench.reports.conclusions.unseen import HEADS, Target, band_means, conclusion, rows, targets
from econgs_bench.reports.style import Model, legend_entries, looks

if TYPE_CHECKING:
    from econgs_bench.reports.charts.report import Report

_WORDS = (
    "Transfer functions between and beyond those that were trained on: their bumps are moved by shares of "
    "their widths, narrowed and widened, and scenes are blended. Distance is 0 where the transfer function "
    "is one of the training, at any opacity, and 1 where no value is visible in both. A method whose models "
    "hold their colors and opacities cannot follow a bump: it is given the trained scenes that come "
    "nearest, at opacities (and palettes, where it edits them) fitted to the transfer function."
)


def unseen_chart(found: list[Target], models: list[Model]) -> Chart:
    """PSNR over distance, a panel per dataset: a mark per transfer function, a line through bands' means."""
    panels = []
    for panel in dict.fromkeys(one.panel for one in found):
        own = [one for one in found if one.panel == panel]
        means = band_means(found, panel)
        styles = looks([one.model for one in own], models)
        series = []
        for each, look in styles.items():
            spots = [one for one in own if one.model == each]
            x, y = [one.distance for one in spots], [one.psnr for one in spots]
            names = [one.name for one in spots]
            series.append(Series(each.title, x, y, look, mark=4.5, opacity=0.45, names=names))
            if len(line := list(means.get(each, {}).values())) > 1:
                across, up = zip(*line, strict=True)
                series.append(Series(each.title, across, up, look, line=1.8, mark=8.0))
        ticks = tuple((value, f"{value:g}") for value in (0.0, 0.25, 0.5, 0.75, 1.0))
        x_axis = Axis("distance from the trained transfer function", -0.04, 1.04, ticks=ticks)
        heights = [[one.psnr for one in own if one.model == each] for each in styles]
        y_axis = broken_axis(heights, "PSNR [dB]", least=2.0)
        panels.append(Panel(panel, x_axis, y_axis, series))
    return Chart(panels, legend_entries([[one.model for one in found]], models))


def unseen_section(report: Report) -> Section | None:
    """The section of the page; None where no bump was moved."""
    found = targets(report.results)
    if not any(one.distance > 0.0 for one in found):
        return None
    chart = unseen_chart(found, report.models)
    note = "Mean PSNR [dB] over the transfer functions that all methods have, at their default rates."
    html = (
        f"<p><b>{conclusion(found)}</b></p><p>{_WORDS}</p>{legend(chart.legend)}{cards(chart.panels)}"
        f'{table("PSNR by distance of the transfer function", HEADS, rows(found))}<p class="note">{note}</p>'
    )
    return Section("unseen", "Unseen transfer functions", html, {"unseen-psnr": chart})
