"""Models under transfer functions that were not trained on: PSNR over distance."""

from __future__ import annotations

from econgs_bench.reports.charts.chart import Axis, Chart
from econgs_bench.reports.charts.tradeoff import Spot, Tradeoff, TradeoffLine, tradeoff_chart
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.sections.unseen.conclusion import (
    HEADS,
    Target,
    band_means,
    conclusion,
    rows,
    targets,
)
from econgs_bench.reports.style import Model
from econgs_bench.reports.tables.table import Table

_WORDS = (
    "Unseen transfer functions have bumps that are moved by shares of their widths, narrowed or widened; "
    "scenes are also blended. Distance 0: the transfer function was trained, at any opacity; 1: no value is "
    "visible in both. Models with fixed colors and opacities cannot follow a bump: they show the trained "
    "scenes that come nearest, at opacities (and palettes, where they can be edited) fitted to the transfer "
    "function. A line joins the means of bands."
)
_NOTE = "Mean PSNR [dB] over the transfer functions that all methods have, at their default rates."


def unseen_chart(found: list[Target], models: list[Model]) -> Chart:
    """PSNR over distance, a panel per dataset: a mark per transfer function, a line through bands' means."""
    ticks = tuple((value, f"{value:g}") for value in (0.0, 0.25, 0.5, 0.75, 1.0))
    x = Axis("distance from the trained transfer function", -0.04, 1.04, ticks=ticks)
    panels = []
    for title in dict.fromkeys(one.panel for one in found):
        lines: dict[Model, TradeoffLine] = {}
        for one in found:
            if one.panel == title:
                line = lines.setdefault(one.model, TradeoffLine(one.model))
                line.scenes.append(Spot(one.distance, one.psnr, one.name))
        for each, own in band_means(found, title).items():
            lines[each].means += [Spot(*spot) for spot in own.values()] if len(own) > 1 else []
        panels.append(Tradeoff(title, x.title, list(lines.values()), better=0, x=x))
    return tradeoff_chart(panels, models)


def section(page: Page) -> Section | None:
    """PSNR by distance; None where no bump was moved."""
    found = targets(page.report.results)
    if not any(one.distance > 0.0 for one in found):
        return None
    chart = unseen_chart(found, page.report.models)
    table = Table("PSNR by distance of the transfer function", HEADS, rows(found))
    charts = {"unseen-psnr": chart}
    return Section("unseen", "Unseen transfer functions", [conclusion(found)], _WORDS, charts, [table], _NOTE)
