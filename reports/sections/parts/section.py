"""What the bytes of a model, and the time of a frame, are made of."""

from __future__ import annotations

from econgs_bench.reports.charts.chart import Chart
from econgs_bench.reports.sections.parts.chart import ledger, ledger_chart, timing, timing_chart
from econgs_bench.reports.sections.section import Page, Section

_TIMING = (
    "Where the time of a frame goes, mean over scenes and seeds. The parts are timed one by one; “other” is "
    "the rest of the frame."
)
_LEDGER = (
    "Bytes of the files that a model is loaded from, by what they hold, over all scenes of a dataset, mean "
    "over seeds. A bar names its parts when pointed at; what is under 1 % of every bar is “other”."
)


def frame_time(page: Page) -> Section | None:
    """The parts of a frame's time; None without any."""
    chart = timing_chart(*timing(page.report.tables["timing"]))
    return _section("timing", "Time of a frame", _TIMING, chart)


def size(page: Page) -> Section | None:
    """The parts of the bytes; None without any."""
    chart = ledger_chart(*ledger(page.report.tables["ledger"]))
    return _section("ledger", "Size ledger", _LEDGER, chart)


def _section(name: str, title: str, words: str, chart: Chart) -> Section | None:
    return Section(name, title, words=words, charts={name: chart}) if chart.legend else None
