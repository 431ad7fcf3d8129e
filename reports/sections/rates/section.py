"""Which method takes the fewest bytes: average differences of rate-distortion curves."""

from __future__ import annotations

from econgs_bench.reports.curves import LEAST_POINTS
from econgs_bench.reports.sections.rates.conclusion import HEADS, INTERPOLATION, conclusion, of_report, row
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.tables.table import Table

_NOTE = (
    "BD-rate: bytes at equal PSNR against those of the other method. BD-PSNR: dB at equal bytes. "
    f"{INTERPOLATION} splines over the logarithm of the size, averaged over the PSNR or the sizes that both "
    "curves share. An interval covers test views and seeds, of one pair. A lead is significant by Holm's "
    "correction over all leads of this page. Models that another of the same method beats in both are left "
    f"out; a pair is refused with fewer than {LEAST_POINTS} others, and without overlap."
)


def section(page: Page) -> Section | None:
    """Who takes the fewest bytes, and every pair; None where no two methods have several rates."""
    differences = of_report(page.report)
    if not differences:
        return None
    table = Table("Average differences", HEADS, [row(each) for each in differences])
    return Section(
        "rate-distortion",
        "Rate and distortion",
        [conclusion(differences, page.family)],
        "Curves are drawn with the trade-offs, PSNR over size.",
        tables=[table],
        note=_NOTE,
        files={"curves/": "one JSON file per method and dataset"},
    )
