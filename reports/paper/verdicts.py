"""The paper's tables and the verdicts on its claims, as HTML and as text."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from econgs_bench.reports import markup
from econgs_bench.reports.paper.claims import (
    AMONG,
    EXCEEDS,
    HOLDS,
    NOT_DECIDED,
    SKIPPED,
    UNKNOWN,
    VERDICTS,
    Verdict,
    check,
)
from econgs_bench.reports.paper.documents import to_html as table_html
from econgs_bench.reports.style import MISSING
from econgs_bench.reports.tables.confidence import ends

if TYPE_CHECKING:
    from econgs_bench.reports.paper.values import PaperTable
    from econgs_bench.reports.statistics import Views

_TAGS = dict.fromkeys((HOLDS, EXCEEDS), "ok") | dict.fromkeys((AMONG, NOT_DECIDED, UNKNOWN), "stale")


def section(tables: Sequence[PaperTable], evidence: Sequence[PaperTable], views: Views) -> str:
    """HTML of the paper's tables and of the claims that they and other evidence decide; "" without tables."""
    if not tables:
        return ""
    note = (
        "<p>Each row has the measured values, and below them the values of the paper (FPS and times on an "
        "RTX 4090, pictures of 800 \N{MULTIPLICATION SIGN} 800). Quality and FPS are means over scenes; "
        "size, time and anchors are sums. Published values of other data are no goal.</p>"
    )
    return (
        note + "\n".join(table_html(table) for table in tables) + to_html(check([*tables, *evidence], views))
    )


def to_html(verdicts: Sequence[Verdict]) -> str:
    """A table of the checked claims, the number of claims without measurement, and those not evaluated."""
    lines = [
        [
            escape(verdict.text),
            escape(verdict.where) + _soft("" if verdict.same else "other data") + _soft(verdict.why),
            escape(_measured(verdict)),
            escape(verdict.bounds),
            f'<span class="tag {_TAGS.get(verdict.verdict, "bad")}">{verdict.verdict}</span>',
        ]
        for verdict in verdicts
        if verdict.where
    ]
    if not lines:
        return ""
    missing = sum(one.verdict == UNKNOWN and not one.where for one in verdicts)
    skipped = [[escape(one.text), escape(one.why)] for one in verdicts if one.verdict == SKIPPED]
    heads = ("Claim", "Dataset", "Measured", "Claimed", "Verdict")
    checks = markup.table("Claims of the paper and measured values", heads, lines)
    return (
        f"<h3>The paper's claims</h3>{checks}"
        '<p class="note">holds, exceeds: by more than the paper states; holds among the paper\'s: a method '
        "that the claim does not name is better; not decided: the 95 % interval (in brackets) contains the "
        "bound, or both rows are of one model. Intervals of quality are of paired differences over views and "
        "seeds, those of bytes, times and frame rates of ratios over scenes and seeds. Each claim is checked "
        "by itself, while leads of this page are corrected together: a claim may hold where no lead is "
        "significant. "
        f"{missing} further claims were not measured "
        "(<code>bench report --check-claims</code> lists them).</p>"
        f"<details><summary>{len(skipped)} claims are not evaluated</summary>"
        f"{markup.table('Claims that are not evaluated', ('Claim', 'Why'), skipped)}</details>"
    )


def to_text(verdicts: Sequence[Verdict]) -> str:
    """Text for a terminal: a line per verdict, then the counts."""
    wide = max(map(len, VERDICTS))
    lines = []
    for one in verdicts:
        remark = f" [{one.why}]" if one.why else ""
        if one.where:
            where = one.where if one.same else f"{one.where}, other data than the paper's"
            where += f", {one.why}" if one.why else ""
            measured = f": {_measured(one)}, claimed {one.bounds}" if one.measured is not None else ""
            remark = f" [{where}{measured}]"
        lines.append(f"{one.verdict:<{wide}} {one.claim:<22} {one.text}{remark}")
    counts = [f"{sum(one.verdict == verdict for one in verdicts)} {verdict}" for verdict in VERDICTS]
    return "\n".join([*lines, "", "; ".join(counts)]) + "\n"


def _soft(remark: str) -> str:
    return f' <span class="soft">({escape(remark)})</span>' if remark else ""


def _measured(one: Verdict) -> str:
    """The measured quantity, with its interval if it has one."""
    if one.measured is None:
        return MISSING
    text = f"{one.measured:.3g}".replace("-", "\N{MINUS SIGN}")
    if one.interval is None or one.interval.low is None:
        return text
    return f"{text} ({ends(one.interval.low, one.interval.high)})"
