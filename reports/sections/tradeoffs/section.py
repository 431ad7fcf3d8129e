"""PSNR against size, speed, training time and memory, by dataset."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from econgs_bench.reports.charts.chart import Chart
from econgs_bench.reports.charts.tradeoff import tradeoff_chart
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.sections.tradeoffs.table import AXES, tradeoffs
from econgs_bench.reports.style import MOST_NAMED, models
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    from econgs_bench.reports.report import Report

_WORDS = (
    "Large marks: means over the scenes of a dataset; a line joins the rates of a method. Small marks: "
    "single scenes. Horizontal axes are logarithmic. Dashed: the Pareto front of the means; what is shaded "
    "is worse than some method in both."
)
_SEEDS = " Several rates of a method are compared on the seeds that all of them have."
_GRAY = (
    f" A chart with more than {MOST_NAMED} variants names each method's default and what is on the front; "
    "the others are gray, without their scenes, and named when pointed at."
)
_VARIANTS = (
    "PSNR over size of methods with other options than their defaults. All other charts leave them out; the "
    "paper's tables and the table of results list them."
)


def section(page: Page) -> Section | None:
    """A chart per axis; None where one setting of one method trades nothing."""
    report = page.report
    charts: dict[str, Chart] = {}
    for name, (title, column) in AXES.items():
        panels = tradeoffs(report.at_shared_seeds, column)
        if panels := [panel for panel in panels if len(panel.lines) > 1 or len(panel.lines[0].means) > 1]:
            chart = tradeoff_chart(panels, report.models)
            charts[f"psnr-{name}"] = replace(chart, title=f"PSNR and {title}", legend={})
    if not charts:
        return None
    words = _WORDS + seeds_left_out(report)
    if any(len(models(rows)) > MOST_NAMED for _, rows in comparable(report.results)):
        words += _GRAY
    return Section("tradeoffs", "Trade-offs", words=words, charts=charts)


def seeds_left_out(report: Report) -> str:
    """What to say of seeds that some rates of a method were not measured with."""
    return _SEEDS if len(report.at_shared_seeds) < (report.results["kind"] == "basic").sum() else ""


def variants(page: Page) -> Section | None:
    """PSNR over size of variants of options, beside their defaults."""
    report = page.report.whole.of_variants
    panels = tradeoffs(report.at_shared_seeds, "size_bytes") if report is not None else []
    if not panels:
        return None
    chart = tradeoff_chart(panels, page.report.models)
    return Section(
        "variants", "Variants of options", words=_VARIANTS, charts={"variants": replace(chart, legend={})}
    )
