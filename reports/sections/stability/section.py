"""Where methods fail, and what they spend on scenes that hold more and more."""

from __future__ import annotations

from dataclasses import replace

from econgs_bench.reports.charts.lines import lines
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.sections.stability import table as stability
from econgs_bench.reports.style import MISSING
from econgs_bench.reports.tables.table import Table

_WORDS = (
    "What did not finish; the largest difference of two seeds on one scene; how far the worst view is "
    "below the median one of its scene; what of the truth's alpha a model lacks (structures that it never "
    "found, or of the background's color; edges alone make a few percent) or has in excess (what would "
    "hide other scenes), in the worst scene and seed."
)
_CHART = " Chart: mean PSNR over scenes and seeds; a mark is missing where any fit failed."
_COMPLEXITY = (
    "What methods spend on datasets whose names differ in a number alone. Where it counts the parts of a "
    "scene, a method that models no more than the scene needs grows with it, and starts small."
)
_HEADS = (
    "Dataset", "Method", "Failed", "Two seeds differ by up to [dB]", "Worst view under the median [dB]",
    "Worst view [dB]", "Missing [%]", "Excess [%]",
)  # fmt: skip


def section(page: Page) -> Section | None:
    """Failures, spread over seeds and worst views; a chart where there are several numbers of views."""
    report = page.report
    records = stability.records(report.results, report.tables["views"])
    curves = stability.few_views(report.results)
    measured = any(record.seed_gap is not None or record.missing is not None for record in records)
    if not curves and not measured and not any(record.failed for record in records):
        return None
    rows = [
        [
            record.dataset,
            record.title,
            _failed(record),
            *(_number(gap, 2) for gap in (record.seed_gap, record.view_gap, record.lowest)),
            *(_number(share, 1, 100.0) for share in (record.missing, record.excess)),
        ]
        for record in records
    ]
    charts = {"few-views": lines(curves, "training views", "PSNR [dB]", report.models)} if curves else {}
    table = Table("Failures, seeds and worst views", _HEADS, rows)
    words = _WORDS + (_CHART if curves else "")
    return Section("stability", "Stability", words=words, charts=charts, tables=[table])


def _number(value: float | None, digits: int, times: float = 1.0) -> str:
    return MISSING if value is None else f"{times * value:.{digits}f}"


def _failed(record: stability.Record) -> str:
    if not record.failed:
        return f"0 of {record.rows}"
    counts = ", ".join(f"{status} {count}" for status, count in record.failed.items())
    return f"{sum(record.failed.values())} of {record.rows}: {counts}"


def complexity(page: Page) -> Section | None:
    """What grows with the number in the names of datasets."""
    charts = {}
    for what, title in stability.COMPLEXITY.items():
        if curves := stability.by_complexity(page.report.results, what):
            chart = lines(curves, "number of parts", title, page.report.models, log_y=what != "psnr")
            charts[f"complexity-{what.split('_')[0]}"] = replace(chart, title=title)
    if not charts:
        return None
    return Section("complexity", "What a scene needs", words=_COMPLEXITY, charts=charts)
