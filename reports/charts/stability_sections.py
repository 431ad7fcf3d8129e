"""Sections of the page on where methods fail and what they spend."""

from __future__ import annotations

from typing import TYPE_CHECKING

from econgs_bench.reports.charts import kinds, stability
from econgs_bench.reports.charts.elements import Section, card, cards, legend, table
from econgs_bench.reports.style import MISSING, Look

if TYPE_CHECKING:
    from econgs_bench.reports.charts.report import Report


def stability_section(report: Report) -> Section | None:
    """Failures, spread over seeds and worst views; charts where there are several numbers of views."""
    records = stability.records(report.results, report.tables["views"])
    curves = stability.few_views(report.results)
    measured = any(record.seed_gap is not None or record.missing is not None for record in records)
    if not curves and not measured and not any(record.failed for record in records):
        return None
    words = (
        "Where methods fail: what did not finish, how far two seeds lie apart on the same scene, how far the "
        "worst view lies under the median one of its scene, and what of the truth's alpha the model lacks "
        "(structures that it never found, or what has the background's color; edges alone make a few "
        "percent) or has beyond it (what would hide other scenes, or show on another background), in the "
        "scene and seed that are worst off."
    )
    charts = {}
    if curves:
        charts["few-views"] = kinds.lines(curves, "training views", "PSNR [dB]", report.models)
    heads = ["Dataset", "Method", "Failed", "Two seeds differ by up to [dB]"]
    heads += ["Worst view under the median [dB]", "Worst view [dB]", "Missing [%]", "Excess [%]"]
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
    note = (
        '<p class="note">Charts: mean PSNR over scenes and seeds by the number of training views; where any '
        "fit failed, the mark is left out.</p>"
    )
    above = legend(kinds.legend_of(curves, report.models)) + "".join(
        cards(chart.panels) + note for chart in charts.values()
    )
    return Section(
        "stability",
        "Stability",
        f"<p>{words}</p>{above}{table('Failures, seeds and worst views', heads, rows)}",
        charts,
    )


def _number(value: float | None, digits: int, times: float = 1.0) -> str:
    return MISSING if value is None else f"{times * value:.{digits}f}"


def _failed(record: stability.Record) -> str:
    if not record.failed:
        return f"0 of {record.rows}"
    counts = ", ".join(f"{status} {count}" for status, count in record.failed.items())
    return f"{sum(record.failed.values())} of {record.rows}: {counts}"


def complexity_section(report: Report) -> Section | None:
    """What grows with the number in the names of datasets."""
    charts = {}
    panels = []
    entries: dict[str, Look] = {}
    for what, title in stability.COMPLEXITY.items():
        if curves := stability.by_complexity(report.results, what):
            name = f"complexity-{what.split('_')[0]}"
            charts[name] = kinds.lines(curves, "number of parts", title, report.models, log_y=what != "psnr")
            panels += [(f"{panel.title}: {title}", panel) for panel in charts[name].panels]
            entries |= kinds.legend_of(curves, report.models)
    if not charts:
        return None
    words = (
        "What methods spend on scenes that hold more and more: datasets whose names differ in a number, "
        "which counts their parts. A method that models no more than a scene needs grows with it, and starts "
        "small."
    )
    grid = "".join(card(panel, caption) for caption, panel in panels)
    html = f'<p>{words}</p>{legend(entries)}<div class="charts">{grid}</div>'
    return Section("complexity", "What a scene needs", html, charts)
