"""The paper's claims as conditions on its tables, checked on measured values."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from reports.paper.layouts import FOLDER, layouts
from reports.paper.values import QUANTITIES, Block, PaperTable, Row
from reports.schema import METRICS
from reports.statistics import Interval, Views

HOLDS, EXCEEDS, FAILS = "holds", "holds, exceeds", "does not hold"
UNSURE = "not decided"
UNKNOWN = "not measured"
SKIPPED = "not evaluated"
VERDICTS = (HOLDS, EXCEEDS, FAILS, UNSURE, UNKNOWN, SKIPPED)


@dataclass(frozen=True)
class Verdict:
    """One claim on one dataset.

    Attributes:
        claim: identifier.
        text: the claim.
        where: dataset and protocol of the check; "" if there was none.
        same: whether the dataset is the paper's own.
        measured: the quantity that the claim bounds; None if it was not measured.
        bounds: the paper's bounds of the quantity.
        verdict: one of :data:`VERDICTS`. :data:`EXCEEDS`: by more than the paper states; :data:`UNSURE`: the
            interval of the paired difference contains the bound.
        interval: 95 % interval over views of a difference of quality.
        why: why the claim is not evaluated, or a further difference between its rows.
    """

    claim: str
    text: str
    where: str
    same: bool
    measured: float | None
    bounds: str
    verdict: str
    interval: Interval | None = None
    why: str = ""


@cache
def claims() -> list[dict[str, Any]]:
    """The content of ``published/claims.toml``."""
    return list(tomllib.loads((FOLDER / "claims.toml").read_text(encoding="utf-8"))["claims"])


def check(tables: Sequence[PaperTable], views: Views) -> list[Verdict]:
    """Every claim on every dataset of its table; one verdict without dataset if none was measured.

    Args:
        tables: the measured tables of the paper.
        views: the table `views`, for intervals of differences of quality.
    """
    by_name = {table.name: table for table in tables}
    verdicts: list[Verdict] = []
    for claim in claims():
        table = by_name.get(claim.get("table", ""))
        blocks = [block for block in table.blocks if _about(claim, block)] if table else []
        checks = [verdict for block in blocks if (verdict := _verdict(claim, block, views)) is not None]
        if not checks:
            why = claim.get("why", "")
            state = SKIPPED if why else UNKNOWN
            checks = [Verdict(claim["id"], claim["text"], "", False, None, _bounds(claim), state, None, why)]
        verdicts += checks
    return verdicts


def _about(claim: dict[str, Any], block: Block) -> bool:
    """Whether a claim applies: one that names datasets applies to them and to their stand-ins."""
    if claim.get("own") and not block.same:
        return False
    return "datasets" not in claim or block.published in claim["datasets"]


def _verdict(claim: dict[str, Any], block: Block, views: Views) -> Verdict | None:
    """The verdict; None if the block lacks a value."""
    rows = _rows(claim, block)
    if rows is None:
        return None
    column, what = claim["column"], claim.get("what", "value")
    values = [float(row.values[column].mean or 0.0) for row in rows]
    if "of" in claim:
        whole = rows[0].values[claim["of"]].mean
        if whole is None:
            return None
        values = [values[0] / QUANTITIES[column].scale, whole / QUANTITIES[claim["of"]].scale]
    measured = _measured(what, values)
    interval = None
    if what == "gain" and column in METRICS:
        interval = views.difference(rows[0].jobs, rows[1].jobs, column)
    verdict = _decide(claim, measured, interval)
    where = f"{block.dataset}, {block.protocol}" if block.protocol else block.dataset
    why = _mixed(claim, rows)
    return Verdict(
        claim["id"], claim["text"], where, block.same, measured, _bounds(claim), verdict, interval, why
    )


def _mixed(claim: dict[str, Any], rows: list[Row]) -> str:
    """A remark if rows of one method are from several versions, which may cause their difference."""
    methods = {line["label"]: line["method"] for line in layouts()["tables"][claim["table"]]["rows"]}
    versions = {row.versions for row in rows}
    alike = len({methods.get(row.label) for row in rows}) == 1
    return "rows of several versions of the method" if alike and len(versions) > 1 else ""


def _rows(claim: dict[str, Any], block: Block) -> list[Row] | None:
    """The rows that a claim compares, the best one of several rivals; None if one is missing."""
    column = claim["column"]
    by_label = {row.label: row for row in block.rows if row.values[column].mean is not None}
    rows = []
    for labels in claim["rows"]:
        names = [labels] if isinstance(labels, str) else labels
        rivals = [by_label[name] for name in names if name in by_label]
        if not rivals:
            return None
        better = QUANTITIES[column].better
        rows.append(max(rivals, key=lambda row: better * float(row.values[column].mean or 0.0)))
    return rows


def _decide(claim: dict[str, Any], measured: float, interval: Interval | None) -> str:
    # The tolerance is half of the last printed digit: "2.2 times" holds for 2.15.
    half = 0.0 if claim.get("exact") else 0.5 * 10.0 ** -_digits(claim)
    low, high, top = claim.get("least"), claim.get("most"), claim.get("top")
    # "Smaller" and "more accurate" are no rounded numbers.
    equal = 1.0 if claim.get("what") in ("ratio", "speedup") else 0.0
    floor = None if low is None else low - (half if low != equal else 0.0)
    good = (floor is None or measured >= floor) and (high is None or measured <= high + half)
    if floor is not None and interval is not None and interval.contains(floor):
        return UNSURE
    if not good:
        return FAILS
    return EXCEEDS if top is not None and measured > top + half else HOLDS


def _measured(what: str, values: list[float]) -> float:
    if what == "value":
        return values[0]
    first, second = values
    if what == "gain":
        return first - second
    return second / first if what == "ratio" else first / second


def _digits(claim: dict[str, Any]) -> int:
    """Decimals of a claim's bounds as printed."""
    bounds = [str(claim[key]) for key in ("least", "most", "top") if key in claim]
    return max((len(text.partition(".")[2].rstrip("0")) for text in bounds), default=0)


def _bounds(claim: dict[str, Any]) -> str:
    if "column" not in claim:
        return ""
    unit = {"gain": " dB", "value": "", "share": ""}.get(claim.get("what", "value"), " times")
    low, high = claim.get("least"), claim.get("most", claim.get("top"))
    if low is None or high is None or low == high:
        sign = "≥ " if high is None else "≤ " if low is None else ""
        text = f"{sign}{high if low is None else low:g}"
    else:
        text = f"{low:g} to {high:g}"
    return text.replace("-", "\N{MINUS SIGN}") + unit
