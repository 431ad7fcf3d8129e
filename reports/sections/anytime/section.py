"""What a method has reached after so many seconds of training."""

from __future__ import annotations

from econgs_bench.reports.charts.levels import by_panel
from econgs_bench.reports.charts.lines import lines
from econgs_bench.reports.sections.anytime.table import LEVELS, anytime, time_to_quality
from econgs_bench.reports.sections.notes import rates_left_out
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING, seconds
from econgs_bench.reports.tables.table import Table

_WORDS = (
    "PSNR of a few held-out views of the measured split, on which no method trains: mean over scenes. A "
    "joint fit of n scenes counts for each with its time / n. The clock stands still while PSNR is "
    "measured."
)
_NOTE = (
    "Seconds of training per scene until the PSNR of these views first reaches the level, linear between "
    f"evaluations; {MISSING}: never."
)


def section(page: Page) -> Section | None:
    """PSNR over training time, and when it reached some levels; None without evaluations."""
    report = page.report
    curve = report.tables["curve"]
    panels = anytime(curve, report.results)
    if not panels:
        return None
    title, quality = "training time per scene [s]", "PSNR of a few held-out views [dB]"
    chart = lines(panels, title, quality, report.models, floors=by_panel(report.results))
    rows = []
    for dataset, own in panels.items():
        for line in own:
            times = [time_to_quality(line, level) for level in LEVELS]
            rows.append([dataset, line.title, *(MISSING if t is None else seconds(t) for t in times)])
    table = Table("Time to a quality", ["Dataset", "Method", *(f"{level:g} dB" for level in LEVELS)], rows)
    words, charts = _WORDS + rates_left_out(curve), {"anytime-psnr": chart}
    return Section("anytime", "Quality over training time", (), words, charts, [table], _NOTE)
