"""The paper's claims as conditions on its tables, held against what was measured."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reports.paper_documents import to_html as table_html
from reports.paper_tables import Block, PaperTable, paper_tables

if TYPE_CHECKING:
    import pandas as pd

HOLDS, FAILS, UNKNOWN = "holds", "does not hold", "not measured"


@dataclass(frozen=True)
class Verdict:
    """One claim on one dataset.

    Attributes:
        claim: its identifier.
        text: what is claimed.
        dataset: where it was checked; "" if nowhere.
        same: whether that is the paper's own dataset.
        measured: the quantity that the claim bounds, None if it was not measured.
        bounds: what the paper states of it.
        verdict: :data:`HOLDS`, :data:`FAILS` or :data:`UNKNOWN`.
    """

    claim: str
    text: str
    dataset: str
    same: bool
    measured: float | None
    bounds: str
    verdict: str


@cache
def claims() -> list[dict[str, Any]]:
    """What ``published/claims.toml`` says."""
    path = Path(__file__).parent / "published" / "claims.toml"
    return list(tomllib.loads(path.read_text(encoding="utf-8"))["claims"])


def check(tables: Sequence[PaperTable]) -> list[Verdict]:
    """Every claim on every dataset of its table; one verdict without dataset where none was measured."""
    by_name = {table.name: table for table in tables}
    verdicts: list[Verdict] = []
    for claim in claims():
        table = by_name.get(claim.get("table", ""))
        found = [_verdict(claim, block) for block in table.blocks if _about(claim, block)] if table else []
        known = [one for one in found if one.measured is not None]
        verdicts += known or [Verdict(claim["id"], claim["text"], "", False, None, _bounds(claim), UNKNOWN)]
    return verdicts


def _about(claim: dict[str, Any], block: Block) -> bool:
    """Claims about one dataset by name are not asked of others, except of what imitates it."""
    return "datasets" not in claim or block.published in claim["datasets"]


def _verdict(claim: dict[str, Any], block: Block) -> Verdict:
    by_label = {row.label: row for row in block.rows}
    values = []
    for label in claim["rows"]:
        row = by_label.get(label)
        values.append(row.values[claim["column"]].mean if row is not None else None)
    known = [value for value in values if value is not None]
    measured = _measured(claim.get("what", "value"), known) if len(known) == len(values) else None
    verdict = UNKNOWN
    if measured is not None:
        # As exact as the paper prints its own numbers: "2.2 times" is what rounds to it.
        half = 0.5 * 10.0 ** -_digits(claim)
        low, high = claim.get("least"), claim.get("most")
        good = (low is None or measured >= low - (half if low else 0.0)) and (
            high is None or measured <= high + half
        )
        verdict = HOLDS if good else FAILS
    return Verdict(claim["id"], claim["text"], block.dataset, block.same, measured, _bounds(claim), verdict)


def _measured(what: str, values: list[float]) -> float:
    if what == "value":
        return values[0]
    first, second = values
    if what == "gain":
        return first - second
    return second / first if what == "ratio" else first / second


def _digits(claim: dict[str, Any]) -> int:
    """Decimals of a claim's bounds as printed."""
    bounds = [str(claim[key]) for key in ("least", "most") if key in claim]
    return max((len(text.partition(".")[2].rstrip("0")) for text in bounds), default=0)


def _bounds(claim: dict[str, Any]) -> str:
    if "column" not in claim:
        return ""
    unit = {"gain": " dB", "value": ""}.get(claim.get("what", "value"), " times")
    low, high = claim.get("least"), claim.get("most")
    if low is not None and high is not None:
        return f"{low:g} to {high:g}{unit}"
    return f"≥ {low:g}{unit}" if high is None else f"≤ {high:g}{unit}"


def section(tables: dict[str, pd.DataFrame]) -> str:
    """HTML of all the paper's tables and of the claims they decide; "" if there is nothing to compare."""
    measured = paper_tables(tables["results"], tables["views"], tables["timing"])
    if not measured:
        return ""
    note = (
        "<p>What was measured here, above what the paper reports (its FPS and times on an RTX 4090, its "
        "pictures 800 \N{MULTIPLICATION SIGN} 800). Quality and FPS are means over scenes, size, time and "
        "anchors sums. Second lines on other data than the paper's show its numbers, not a goal.</p>"
    )
    return note + "\n".join(table_html(table) for table in measured) + to_html(check(measured))


def to_html(verdicts: Sequence[Verdict]) -> str:
    """A table of those that were measured, and how many were not."""
    rows = [
        f'<tr><th scope="row">{escape(one.text)}</th><td>{escape(one.dataset)}'
        f"{'' if one.same else ' <span class=soft>(other data)</span>'}</td>"
        f'<td class="r">{one.measured:.3g}</td><td class="r">{escape(one.bounds)}</td>'
        f'<td><span class="tag {"ok" if one.verdict == HOLDS else "bad"}">{one.verdict}</span></td></tr>'
        for one in verdicts
        if one.measured is not None
    ]
    missing = sum(one.measured is None for one in verdicts)
    if not rows:
        return ""
    head = "".join(
        f'<th scope="col">{text}</th>' for text in ("Claim", "Dataset", "Measured", "Claimed", "Verdict")
    )
    return (
        "<h3>The paper's claims</h3>"
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        f'<p class="note">{missing} further claims were not measured '
        "(<code>bench report --check-claims</code> lists them).</p>"
    )


def to_text(verdicts: Sequence[Verdict]) -> str:
    """For a terminal: a line per verdict, then the counts."""
    lines = []
    for one in verdicts:
        told = ""
        if one.measured is not None:
            where = one.dataset if one.same else f"{one.dataset}, other data than the paper's"
            told = f" [{one.measured:.3g}, claimed {one.bounds}; {where}]"
        lines.append(f"{one.verdict:<14} {one.claim:<20} {one.text}{told}")
    counts = ", ".join(
        f"{sum(one.verdict == verdict for one in verdicts)} {verdict}" for verdict in (HOLDS, FAILS, UNKNOWN)
    )
    return "\n".join([*lines, "", counts]) + "\n"
