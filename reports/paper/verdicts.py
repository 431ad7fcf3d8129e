"""The paper's tables and the verdicts on its claims, as HTML and as text."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

from reports.page import markup
from reports.paper.claims import EXCEEDS, HOLDS, SKIPPED, UNKNOWN, UNSURE, VERDICTS, Verdict, check
from reports.paper.documents import to_html as table_html
from reports.tables.confidence import ends

if TYPE_CHECKING:
    import pandas as pd

    from reports.paper.values import PaperTable

_TAGS = {HOLDS: "ok", EXCEEDS: "ok", UNSURE: "stale"}


def section(measured: Sequence[PaperTable], views: pd.DataFrame) -> str:
    """HTML of the paper's tables and of the claims they decide; "" if there is nothing to compare."""
    if not measured:
        return ""
    note = (
        "<p>What was measured here, above what the paper reports (its FPS and times on an RTX 4090, its "
        "pictures 800 \N{MULTIPLICATION SIGN} 800). Quality and FPS are means over scenes, size, time and "
        "anchors sums. Second lines on other data than the paper's show its numbers, not a goal.</p>"
    )
    return note + "\n".join(table_html(table) for table in measured) + to_html(check(measured, views))


def to_html(verdicts: Sequence[Verdict]) -> str:
    """A table of those that were measured; why others are not evaluated, and how many were not measured."""
    lines = [
        [
            escape(one.text),
            escape(one.where) + _soft("" if one.same else "other data") + _soft(one.why),
            escape(_measured(one)),
            escape(one.bounds),
            f'<span class="tag {_TAGS.get(one.verdict, "bad")}">{one.verdict}</span>',
        ]
        for one in verdicts
        if one.measured is not None
    ]
    if not lines:
        return ""
    missing = sum(one.verdict == UNKNOWN for one in verdicts)
    skipped = [[escape(one.text), escape(one.why)] for one in verdicts if one.verdict == SKIPPED]
    heads = ("Claim", "Dataset", "Measured", "Claimed", "Verdict")
    decided = markup.table("Claims of the paper and what was measured", heads, lines)
    return (
        f"<h3>The paper's claims</h3>{decided}"
        '<p class="note">holds, exceeds: by more than the paper states; not decided: the 95 % interval of '
        "the paired difference over views (in brackets) contains the bound. "
        f"{missing} further claims were not measured "
        "(<code>bench report --check-claims</code> lists them).</p>"
        f"<details><summary>{len(skipped)} claims are not evaluated</summary>"
        f"{markup.table('Claims that are not evaluated', ('Claim', 'Why'), skipped)}</details>"
    )


def to_text(verdicts: Sequence[Verdict]) -> str:
    """For a terminal: a line per verdict, then the counts."""
    wide = max(map(len, VERDICTS))
    lines = []
    for one in verdicts:
        told = f" [{one.why}]" if one.why else ""
        if one.measured is not None:
            where = one.where if one.same else f"{one.where}, other data than the paper's"
            where += f", {one.why}" if one.why else ""
            told = f" [{where}: {_measured(one)}, claimed {one.bounds}]"
        lines.append(f"{one.verdict:<{wide}} {one.claim:<22} {one.text}{told}")
    counts = [f"{sum(one.verdict == verdict for one in verdicts)} {verdict}" for verdict in VERDICTS]
    return "\n".join([*lines, "", "; ".join(counts)]) + "\n"


def _soft(remark: str) -> str:
    return f' <span class="soft">({escape(remark)})</span>' if remark else ""


def _measured(one: Verdict) -> str:
    """The quantity, with its interval where it has one."""
    text = f"{one.measured:.3g}".replace("-", "\N{MINUS SIGN}")
    if one.interval is None or one.interval.low is None:
        return text
    return f"{text} ({ends(one.interval.low, one.interval.high)})"
