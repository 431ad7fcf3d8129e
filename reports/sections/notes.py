"""What charts leave out, in a note below their panels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.charts.chart import Chart
from econgs_bench.reports.comparability import PARTS, Remark, begins, concerning, fixed_rays, sentences
from econgs_bench.reports.curves import at_default_rates
from econgs_bench.reports.schema import records
from econgs_bench.reports.sections.section import Section
from econgs_bench.reports.style import MOST_NAMED, counted, models
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.report import Report

_MOST = 3
_CLOCKS = {
    "fps": ("fps",), "time": ("train_seconds",), "train": ("train_seconds",), "anytime": ("train_seconds",),
    "frame": ("fps", PARTS), "timing": ("fps", PARTS),
}  # fmt: skip
"""Part of a chart's name -> the clocks that it draws."""


def rates_left_out(table: pd.DataFrame) -> str:
    """What to say of fits that charts of training and of attributes do not draw; "" if they draw all."""
    fewer = len(at_default_rates(table)) < len(table)
    return " Of fits that differ only in a rate knob, the default's is shown." if fewer else ""


def variants_left_out(table: pd.DataFrame) -> str:
    """What to say of variants that are not named (:func:`.reports.style.named`); "" if all are."""
    many = any(len(models(rows)) > MOST_NAMED for _, rows in comparable(table))
    return f" Of more than {MOST_NAMED} variants each method's default is shown alone." if many else ""


def noted(section: Section, report: Report) -> Section:
    """A section whose charts have the remarks."""
    return replace(section, charts=with_notes(section.charts, report))


def with_notes(charts: Mapping[str, Chart], report: Report) -> dict[str, Chart]:
    """Charts by file name, each with the remarks on its datasets and on what it draws.

    A chart whose panels bear no names of datasets is of all datasets.
    """
    known = [name for name in ("dataset", "samples") if name in report.measured]
    rows = records(report.measured[known].drop_duplicates())
    return {
        name: replace(chart, note=_note(name, chart, report.remarks, rows)) for name, chart in charts.items()
    }


def _note(name: str, chart: Chart, remarks: Sequence[Remark], rows: Sequence[Mapping[str, Any]]) -> str:
    clocks = {clock for part, own in _CLOCKS.items() if part in name for clock in own}
    titles = [panel.title for panel in chart.panels]
    datasets = {str(row["dataset"]) for row in rows}
    drawn = {one for one in datasets if any(begins(title, one) for title in titles)}
    rays = fixed_rays(row for row in rows if not drawn or row["dataset"] in drawn)
    found = concerning(remarks, titles if drawn else None, ("psnr", *clocks))
    texts = sentences(found)
    more = [f"The page has {counted(len(texts) - _MOST, 'more remark')}."] if len(texts) > _MOST else []
    parts = [chart.note, rays and f"Ground truth: {rays}.", *texts[:_MOST], *more]
    return " ".join(filter(None, parts))
