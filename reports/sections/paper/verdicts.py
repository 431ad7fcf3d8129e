"""The paper's tables and the verdicts on its claims, as HTML and as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.paper.claims import (
    AMONG,
    EXCEEDS,
    NOT_DECIDED,
    SKIPPED,
    UNKNOWN,
    VERDICTS,
    Verdict,
    check,
    outcomes,
    tally,
)
from econgs_bench.reports.sections.paper.documents import to_html as table_html
from econgs_bench.reports.sections.paper.evidence import of_report
from econgs_bench.reports.sections.paper.values import PaperTable
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING, ends
from econgs_bench.reports.tables.documents import to_csv as table_to_csv
from econgs_bench.reports.tables.table import Cell, Table
from econgs_bench.reports.tables.table import to_html as table_to_html

_WORDS = (
    "Each row has the measured values, and below them those of the paper (FPS and times on an RTX 4090, "
    "pictures of 800 \N{MULTIPLICATION SIGN} 800). Quality and FPS are means over scenes; size, time and "
    "anchors are sums. Published values of other data are no goal."
)
_NOTE = (
    f"{EXCEEDS}: by more than the paper states. {AMONG}: a method that the claim does not name is better. "
    f"{NOT_DECIDED}: the 95 % interval (in brackets) contains the bound, or both rows are of one model. "
    "Intervals of quality are of paired differences over views and seeds; those of bytes, times and frame "
    "rates are of ratios over scenes and seeds. Each claim is checked by itself, while leads of this page "
    "are corrected together: a claim may hold where no lead is significant."
)


def section(page: Page) -> Section | None:
    """The paper's tables, and the claims that they and other evidence decide; None without tables."""
    if page.folder is None or not page.paper:
        return None
    html = "\n".join([*map(table_html, page.paper), to_html(checked(page.paper, page.report))])
    return Section("paper", "The paper's tables", words=_WORDS, html=html)


def checked(paper: Iterable[PaperTable], report: Report) -> list[Verdict]:
    """The verdicts on all claims, by the paper's tables and the other evidence of a report."""
    return check([*paper, *of_report(report)], report.views)


def to_html(verdicts: Sequence[Verdict]) -> str:
    """A table of the checked claims, the number of claims without measurement, and those not evaluated."""
    rows: list[list[str | Cell]] = []
    for one in verdicts:
        if one.where:
            remarks = ["" if one.same else "other data", one.why]
            where = " ".join([one.where, *(f"({remark})" for remark in remarks if remark)])
            rows.append([one.text, where, _measured(one), one.bounds, one.verdict])
    if not rows:
        return ""
    missing = sum(one.verdict == UNKNOWN and not one.where for one in verdicts)
    note = f"{_NOTE} {missing} further claims were not measured; `bench report --check-claims` lists them."
    heads = ("Claim", "Dataset", "Measured", "Claimed", "Verdict")
    checks = Table("Claims of the paper and measured values", heads, rows, notes=[note])
    skipped = [[one.text, one.why] for one in verdicts if one.verdict == SKIPPED]
    more = table_to_html(Table("Claims that are not evaluated", ("Claim", "Why"), skipped))
    return (
        f"<h3>The paper's claims</h3>{table_to_html(checks)}"
        f"<details><summary>{len(skipped)} claims are not evaluated</summary>{more}</details>"
    )


def to_text(verdicts: Sequence[Verdict]) -> str:
    """Text for a terminal: a line per claim, then the counts."""
    wide = max(map(len, VERDICTS))
    lines = []
    for one, alike, checks in outcomes(verdicts):
        line = f"{one.verdict:<{wide}} {one.claim:<22} {one.text}"
        if one.measured is not None:
            remarks = ["" if one.same else "other data than the paper's", one.why]
            remarks += [f"so on {alike} of {checks}"] if checks > 1 else []
            where = ", ".join(filter(None, [one.where, *remarks]))
            line += f" [{_measured(one)}, claimed {one.bounds}; {where}]"
        elif one.why:
            line += f" [{'; '.join(filter(None, [one.where, one.why]))}]"
        lines.append(line)
    counts = tally(verdicts)
    return "\n".join([*lines, "", "; ".join(f"{counts[name]} {name}" for name in VERDICTS)]) + "\n"


def to_csv(verdicts: Sequence[Verdict]) -> str:
    """A row per claim and dataset; `low` and `high` bound the 95 % interval."""
    import pandas as pd

    table = pd.DataFrame([
        {
            "claim": one.claim, "text": one.text, "where": one.where,
            "paper's data": "" if not one.where else "yes" if one.same else "no",
            "measured": _rounded(one.measured), "low": _rounded(one.interval and one.interval.low),
            "high": _rounded(one.interval and one.interval.high), "claimed": one.bounds,
            "verdict": one.verdict, "why": one.why,
        }
        for one in verdicts
    ])  # fmt: skip
    return table_to_csv(table.astype(dict.fromkeys(("measured", "low", "high"), float)))


def _rounded(number: float | None) -> float | None:
    """Six digits: the last ones depend on the processor."""
    return None if number is None else float(f"{number:.6g}")


def _measured(one: Verdict) -> str:
    """The measured quantity, with its interval if it has one."""
    if one.measured is None:
        return MISSING
    text = f"{one.measured:.3g}".replace("-", "\N{MINUS SIGN}")
    if one.interval is None or one.interval.low is None:
        return text
    return f"{text} ({ends(one.interval.low, one.interval.high)})"
