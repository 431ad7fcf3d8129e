"""The paper's tables and the verdicts on its claims, as HTML and as text."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from io import StringIO

from econgs_bench.reports.sections.paper.claims import (
    AMONG,
    EXCEEDS,
    NOT_DECIDED,
    SKIPPED,
    UNKNOWN,
    VERDICTS,
    Outcome,
    Verdict,
    check,
    outcomes,
)
from econgs_bench.reports.sections.paper.documents import to_html as table_html
from econgs_bench.reports.sections.paper.evidence import of_report
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING, ends
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

COLUMNS = (
    "claim", "text", "where", "paper's data", "measured", "low", "high", "claimed", "verdict", "why",
)  # fmt: skip
"""Of the file of all checks; low and high bound the 95 % interval."""


def section(page: Page) -> Section | None:
    """The paper's tables, and the claims that they and other evidence decide; None without tables."""
    if page.folder is None or not page.paper:
        return None
    report = page.report
    checked = check([*page.paper, *of_report(report)], report.views)
    html = "\n".join([*map(table_html, page.paper), to_html(checked)])
    return Section("paper", "The paper's tables", words=_WORDS, html=html)


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
    found = outcomes(verdicts)
    lines = []
    for one, alike, checks in found:
        line = f"{one.verdict:<{wide}} {one.claim:<22} {one.text}"
        if one.measured is not None:
            remarks = ["" if one.same else "other data than the paper's", one.why]
            remarks += [f"so on {alike} of {checks}"] if checks > 1 else []
            where = ", ".join(filter(None, [one.where, *remarks]))
            line += f" [{_measured(one)}, claimed {one.bounds}; {where}]"
        elif one.why:
            line += f" [{'; '.join(filter(None, [one.where, one.why]))}]"
        lines.append(line)
    return "\n".join([*lines, "", counted(found)]) + "\n"


def counted(found: Sequence[Outcome]) -> str:
    """How many claims have each verdict."""
    counts = Counter(one.verdict.verdict for one in found)
    return "; ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS)


def to_csv(verdicts: Sequence[Verdict]) -> str:
    """A row per claim and dataset."""
    rows = []
    for one in verdicts:
        limits = (one.interval.low, one.interval.high) if one.interval else (None, None)
        numbers = ["" if number is None else f"{number:.6g}" for number in (one.measured, *limits)]
        own = "" if not one.where else "yes" if one.same else "no"
        rows.append((one.claim, one.text, one.where, own, *numbers, one.bounds, one.verdict, one.why))
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([COLUMNS, *rows])
    return text.getvalue()


def _measured(one: Verdict) -> str:
    """The measured quantity, with its interval if it has one."""
    if one.measured is None:
        return MISSING
    text = f"{one.measured:.3g}".replace("-", "\N{MINUS SIGN}")
    if one.interval is None or one.interval.low is None:
        return text
    return f"{text} ({ends(one.interval.low, one.interval.high)})"
