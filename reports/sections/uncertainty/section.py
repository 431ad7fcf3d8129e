"""How certain PSNR is: intervals of means, and of differences to the best."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from econgs_bench.reports.schema import records
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.sections.uncertainty import table as uncertainty
from econgs_bench.reports.style import MISSING, absent, ends, signed
from econgs_bench.reports.tables.table import Table

if TYPE_CHECKING:
    import pandas as pd

_WORDS = (
    "PSNR is a mean over views, scenes and seeds. Its 95 % interval covers views (circular block bootstrap "
    "with blocks of a sixth of the test path, as neighbouring views are alike) and seeds. A difference is "
    "taken view by view and seed by seed against the method with the highest mean; where its interval "
    "contains zero, the two methods are not ranked."
)


def section(page: Page) -> Section | None:
    """A row per dataset and method; None without values of views."""
    every = (uncertainty.intervals_of(page.report), uncertainty.comparisons_of(page.report))
    intervals, pairs = (table[table["metric"] == "psnr"] for table in every)
    if intervals.empty:
        return None
    several = [axis for axis in ("preset", "split") if intervals[axis].nunique() > 1]
    rows = []
    for _, group in intervals.groupby(["dataset", "preset", "split"], sort=False, dropna=False):
        of_dataset = records(group)
        best = str(max(of_dataset, key=lambda row: row["mean"])["method"])
        for row in of_dataset:
            cells = [row["dataset"], row["method"], *(row[axis] for axis in several), f"{row['mean']:.2f}"]
            rows.append([*cells, ends(row["low"], row["high"]), _seeds(row), *_against(pairs, row, best)])
    heads = ["Dataset", "Method", *(axis.capitalize() for axis in several), "PSNR [dB]", "95 % interval"]
    heads += ["Over seeds", "To the highest [dB]", "95 % of the difference", "Ranking"]
    table = Table("PSNR, its uncertainty, and differences", heads, rows)
    files = {"intervals.csv": "intervals of all metrics"}
    if not every[1].empty:
        files["comparisons.csv"] = "all pairs of methods"
    return Section("confidence", "Uncertainty", words=_WORDS, tables=[table], files=files)


def _seeds(row: dict[str, Any]) -> str:
    if row["seeds"] < 2:
        return "one seed"
    values = ", ".join(f"{float(value):.2f}" for value in row["seed_values"].split("; ") if value)
    return f"± {row['seed_std']:.2f} ({row['seeds']} seeds)" + (f": {values}" if values else "")


def _against(pairs: pd.DataFrame, row: dict[str, Any], best: str) -> list[str]:
    """Difference to the best, its interval, and what follows."""
    if row["method"] == best:
        return ["highest", "", ""]
    axes = ["dataset", "preset", "split"]
    same = (pairs[axes] == [row[axis] for axis in axes]).all(axis=1)
    for sign, mine, other in ((1, "first", "second"), (-1, "second", "first")):
        matches = pairs[same & (pairs[mine] == row["method"]) & (pairs[other] == best)]
        if len(matches):
            pair = matches.iloc[0]
            low, high = (end if absent(end) else sign * end for end in (pair["low"], pair["high"])[::sign])
            ranking = "lower" if pair["apart"] else "not ranked"
            return [signed(sign * pair["difference"]), ends(low, high, sign=True), ranking]
    return [MISSING, MISSING, "other scenes"]
