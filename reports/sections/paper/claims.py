"""The paper's claims as conditions on its tables, checked on measured values."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby, product
from typing import Any, NamedTuple

from econgs_bench.reports.schema import METRICS
from econgs_bench.reports.sections.paper import intervals
from econgs_bench.reports.sections.paper.layouts import FOLDER, layouts
from econgs_bench.reports.sections.paper.values import QUANTITIES, Block, PaperRow, PaperTable
from econgs_bench.reports.statistics import Interval, Views

HOLDS, EXCEEDS, FAILS = "holds", "holds, exceeds", "does not hold"
AMONG = "holds among the paper's"
NOT_DECIDED = "not decided"
UNKNOWN = "not measured"
SKIPPED = "not evaluated"
VERDICTS = (HOLDS, EXCEEDS, AMONG, FAILS, NOT_DECIDED, UNKNOWN, SKIPPED)
_GRAVITY = (FAILS, NOT_DECIDED, AMONG, HOLDS, EXCEEDS)
"""Verdicts of several checks, the one that decides first."""
_RATIOS = ("ratio", "speedup")
_LEAST_COLUMNS = 2
_LEAST_DATASETS = 3
"""Numbers of scenes that have a trend."""


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
        verdict: one of :data:`VERDICTS`. :data:`EXCEEDS`: by more than the paper states; :data:`AMONG`: the
            table has rows that the claim does not name and that are better; :data:`NOT_DECIDED`: the interval
            contains the bound, or both rows are of the same model.
        interval: 95 % interval: of a difference of quality over views and seeds, of a ratio of bytes, times
            or frame rates over scenes and seeds.
        why: why the claim is not evaluated or decided, or a further difference between its rows.
        published: the paper's name of the dataset; "" if it has none, or there are several.
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
    published: str = ""

    @property
    def place(self) -> tuple[str, str]:
        """Dataset, scenes and protocol of the check."""
        return self.where, self.published


@cache
def claims() -> list[dict[str, Any]]:
    """The content of ``published/claims.toml``."""
    return list(tomllib.loads((FOLDER / "claims.toml").read_text(encoding="utf-8"))["claims"])


def check(tables: Sequence[PaperTable], views: Views) -> list[Verdict]:
    """Every claim on every dataset of its table; one verdict without dataset if none was measured.

    Args:
        tables: the measured tables of the paper, and those of :mod:`.reports.sections.paper.evidence`.
        views: the table `views`, for intervals of differences of quality.
    """
    evidence = _Evidence({table.name: table.blocks for table in tables}, views)
    return [verdict for claim in claims() for verdict in evidence.verdicts(claim) or [_open(claim)]]


class Outcome(NamedTuple):
    """What all checks of a claim say together.

    Attributes:
        verdict: the one that decides.
        alike: checks with its verdict.
        checks: checks of the claim on such data.
    """

    verdict: Verdict
    alike: int
    checks: int


def outcomes(verdicts: Sequence[Verdict]) -> list[Outcome]:
    """One for each claim: the worst on the paper's own data, where they decide, else on others.

    Args:
        verdicts: of :func:`check`.
    """
    found = []
    for _, group in groupby(verdicts, lambda one: one.claim):
        each = list(group)
        decided = [one for one in each if one.verdict in _GRAVITY]
        counted = [one for one in decided if one.same] or decided or each
        worst = min(counted, key=lambda one: _GRAVITY.index(one.verdict)) if decided else counted[0]
        found.append(Outcome(worst, sum(one.verdict == worst.verdict for one in counted), len(counted)))
    return found


def tally(verdicts: Sequence[Verdict]) -> Counter[str]:
    """Verdict -> number of claims with it."""
    return Counter(one.verdict.verdict for one in outcomes(verdicts))


def _open(claim: dict[str, Any]) -> Verdict:
    """The verdict on a claim that no data decide."""
    why = claim.get("why", "")
    state = SKIPPED if why else UNKNOWN
    return Verdict(claim["id"], claim["text"], "", False, None, _bounds(claim), state, None, why)


@cache
def _by_id() -> dict[str, dict[str, Any]]:
    return {claim["id"]: claim for claim in claims()}


@dataclass(frozen=True)
class _Evidence:
    """What claims are held against.

    Attributes:
        blocks: of each table, by name.
        views: for intervals of differences of quality.
    """

    blocks: Mapping[str, Sequence[Block]]
    views: Views

    def verdicts(self, claim: dict[str, Any]) -> list[Verdict]:
        """One for each dataset and protocol that has all values of a claim."""
        if "all" in claim:
            return _together(claim, [self.verdicts(_by_id()[part]) for part in claim["all"]])
        blocks = [block for block in self.blocks.get(claim.get("table", ""), ()) if _about(claim, block)]
        if "over" in claim:
            return self._trends(claim, blocks)
        one = self._in_all if "columns" in claim else self._verdict
        return [verdict for block in blocks if (verdict := one(claim, block)) is not None]

    def _verdict(self, claim: dict[str, Any], block: Block) -> Verdict | None:
        """The verdict; None if the block lacks a row.

        Of several rows in the first place and of several rivals each pair is judged: one that fails decides,
        then one that is not decided.
        """
        column = claim["column"]
        places = self._places(claim, block, column)
        if places is None or not all(places):
            return _lacking(claim, block, [column], places)
        judged = [
            (rows, measured, *self._judged(claim, rows, measured))
            for rows in map(list, product(*places))
            if (measured := _quantity(claim, rows)) is not None
        ]
        if not judged:
            return None
        rows, measured, verdict, interval, why = min(judged, key=lambda one: _GRAVITY.index(one[2]))
        remarks = [why, _mixed(claim, rows)]
        if verdict in (HOLDS, EXCEEDS) and (ahead := _beside(claim, block, column, places[0][0])):
            verdict, remarks = AMONG, [*remarks, f"not in the claim: {ahead}"]
        return _stated(claim, block, measured, verdict, interval, "; ".join(filter(None, remarks)))

    def _judged(
        self, claim: dict[str, Any], rows: list[PaperRow], measured: float
    ) -> tuple[str, Interval | None, str]:
        """The verdict on some rows, the interval of what they are compared in, and a remark."""
        if len(rows) > 1 and intervals.same(rows[0], rows[1]):
            return NOT_DECIDED, None, f"the same model: {rows[0].label}, {rows[1].label}"
        interval = self._interval(claim, rows)
        alone = interval is None and claim.get("what") in _RATIOS and any(row.parts for row in rows)
        verdict = _decide(claim, measured, interval)
        return verdict, interval, "no interval: nothing is repeated" if alone else ""

    def _interval(self, claim: dict[str, Any], rows: list[PaperRow]) -> Interval | None:
        """Of a difference of quality over views and seeds, of a ratio over scenes and seeds."""
        column, what = claim["column"], claim.get("what")
        if what == "gain" and column in METRICS:
            return self.views.difference(rows[0].jobs, rows[1].jobs, column)
        if what in _RATIOS:
            above, below = (rows[1], rows[0]) if what == "ratio" else (rows[0], rows[1])
            return intervals.ratio(above, below, column)
        return None

    def _in_all(self, claim: dict[str, Any], block: Block) -> Verdict | None:
        """Whether the first row is ahead of its rivals in all columns; None if the block lacks a row.

        A column that was measured nowhere in the block is left out, with a remark.
        """
        columns = [name for name in claim["columns"] if any(_has(row, name) for row in block.rows)]
        if len(columns) < _LEAST_COLUMNS:
            return None
        behind, undecided, beside = [], [], []
        for name in columns:
            places = self._places(claim, block, name)
            if places is None or not all(places):
                return _lacking(claim, block, [name], places)
            better = QUANTITIES[name].better
            what = "ratio" if better < 0 else "gain" if name in METRICS else "speedup"
            one = claim | {"column": name, "what": what, "least": 0.0 if what == "gain" else 1.0}
            states = []
            for first, rival in product(*places):
                measured = _quantity(one, [first, rival])
                states.append(FAILS if measured is None else self._judged(one, [first, rival], measured)[0])
            if FAILS in states:
                behind.append(name)
            elif NOT_DECIDED in states:
                undecided.append(name)
            elif ahead := _beside(claim, block, name, places[0][0]):
                beside.append(ahead)
        verdict = FAILS if behind else NOT_DECIDED if undecided else AMONG if beside else HOLDS
        remarks = [f"behind in {QUANTITIES[name].title}" for name in behind]
        remarks += [f"not decided in {QUANTITIES[name].title}" for name in undecided]
        remarks += [f"without {QUANTITIES[name].title}" for name in claim["columns"] if name not in columns]
        remarks += [f"not in the claim: {ahead}" for ahead in beside]
        good = len(columns) - len(behind)
        return _stated(claim | {"columns": columns}, block, good, verdict, None, "; ".join(remarks))

    def _trends(self, claim: dict[str, Any], blocks: Sequence[Block]) -> list[Verdict]:
        """Share of the pairs of datasets in which that with more scenes has the larger quantity.

        One verdict per protocol that has :data:`_LEAST_DATASETS` numbers of scenes.
        """
        verdicts = []
        for protocol in dict.fromkeys(block.protocol for block in blocks):
            points = []
            for block in (one for one in blocks if one.protocol == protocol and one.published):
                places = self._places(claim, block, claim["column"])
                value = _quantity(claim, [rows[0] for rows in places]) if places and all(places) else None
                if value is not None:
                    points.append((block.count, value, block))
            if len({count for count, _, _ in points}) < _LEAST_DATASETS:
                continue
            pairs = [b[1] > a[1] for a in points for b in points if b[0] > a[0]]
            share = sum(pairs) / len(pairs)
            names = dict.fromkeys(block.dataset for _, _, block in points)
            where = ", ".join(filter(None, [*names, protocol]))
            same = all(block.same for _, _, block in points)
            verdict = _decide(claim, share, None)
            verdicts.append(Verdict(claim["id"], claim["text"], where, same, share, _bounds(claim), verdict))
        return verdicts

    def _places(self, claim: dict[str, Any], block: Block, column: str) -> list[list[PaperRow]] | None:
        """The rows of each place of a claim that have a value; None if a place was not measured at all.

        Of several in the first place the worst comes first, of several rivals the best.
        """
        places = []
        for place, labels in enumerate(claim["rows"]):
            names = [labels] if isinstance(labels, str) else labels
            rows = [row for row in block.rows if row.label in names and (row.jobs or _has(row, column))]
            sign = QUANTITIES[column].better * (1.0 if place else -1.0)
            valued = [row for row in rows if _has(row, column)]
            places.append(sorted(valued, key=lambda row: -sign * _value(row, column)))
            if not rows:
                return None
        if (other := claim.get("against")) is not None:
            found = [
                row
                for one in self.blocks.get(other["table"], ())
                if _alike(other, one, block)
                for row in one.rows
                if row.label == other["row"] and _has(row, column)
            ]
            if not found:
                return None
            places.append(found[:1])
        return places


def _about(claim: dict[str, Any], block: Block) -> bool:
    """Whether a claim applies: one that names datasets applies to them and to their stand-ins."""
    if claim.get("own") and not block.same:
        return False
    return "datasets" not in claim or block.published in claim["datasets"]


def _alike(other: Mapping[str, str], one: Block, block: Block) -> bool:
    """Whether a block of another table is of the same data as ``block``, or of those that a claim names.

    It has the conditions of ``block``, or fewer: what no model has part in has no training views.
    """
    published = other.get("published", block.published)
    alike = "published" in other or one.dataset == block.dataset
    conditions = [set(each.protocol.split(", ")) for each in (one, block)]
    return alike and one.published == published and one.same == block.same and conditions[0] <= conditions[1]


def _together(claim: dict[str, Any], parts: Sequence[Sequence[Verdict]]) -> list[Verdict]:
    """One verdict for each dataset and protocol where all parts of a claim have one."""
    verdicts = []
    for place in dict.fromkeys(one.place for part in parts for one in part):
        found = [one for part in parts for one in part if one.place == place]
        if len(found) < len(parts):
            continue
        behind = [one.claim for one in found if one.verdict == FAILS]
        undecided = [one.claim for one in found if one.verdict == NOT_DECIDED]
        unknown = [one.claim for one in found if one.verdict == UNKNOWN]
        verdict = FAILS if behind else UNKNOWN if unknown else NOT_DECIDED if undecided else HOLDS
        remarks = [f"against {', '.join(behind)}"] if behind else []
        remarks += [f"not decided: {', '.join(undecided)}"] if undecided else []
        remarks += [f"not measured: {', '.join(unknown)}"] if unknown else []
        why = "; ".join(remarks)
        first = found[0]
        good = None if verdict == UNKNOWN else float(len(found) - len(behind))
        verdicts.append(
            Verdict(claim["id"], claim["text"], first.where, first.same, good, _bounds(claim), verdict,
                    None, why, first.published)
        )  # fmt: skip
    return verdicts


def _stated(
    claim: dict[str, Any],
    block: Block,
    measured: float | None,
    verdict: str,
    interval: Interval | None,
    why: str,
) -> Verdict:
    where = f"{block.dataset}, {block.protocol}" if block.protocol else block.dataset
    return Verdict(
        claim["id"], claim["text"], where, block.same, measured, _bounds(claim), verdict, interval, why,
        block.published,
    )  # fmt: skip


def _mixed(claim: dict[str, Any], rows: list[PaperRow]) -> str:
    """A remark if rows of one method are from several versions, which may cause their difference."""
    lines = layouts()["tables"].get(claim["table"], {"rows": ()})["rows"]
    methods = {line["label"]: line["method"] for line in lines}
    versions = {row.versions for row in rows}
    alike = len({methods.get(row.label) for row in rows}) == 1
    return "rows of several versions of the method" if alike and len(versions) > 1 else ""


def _lacking(
    claim: dict[str, Any], block: Block, columns: Sequence[str], places: Sequence[Sequence[PaperRow]] | None
) -> Verdict | None:
    """The verdict where measured rows lack a value, with the reason; None where a row was not measured."""
    if places is None:
        return None
    reasons: dict[str, None] = {}
    for column, labels in product(columns, claim["rows"]):
        names = [labels] if isinstance(labels, str) else labels
        rows = [row for row in block.rows if row.label in names and row.jobs]
        if any(_has(row, column) for row in rows):
            continue
        for row in rows:
            why = row.missing.get(column, "no value of all scenes")
            reasons[f"{QUANTITIES[column].title} of {row.label}: {why}"] = None
    return _stated(claim, block, None, UNKNOWN, None, "; ".join(reasons))


def _beside(claim: dict[str, Any], block: Block, column: str, first: PaperRow) -> str:
    """Rows that a claim on "all" methods does not name (`beside`) and that are better than its first one."""
    quantity = QUANTITIES[column]
    ahead = [
        f"{row.label}, {_value(row, column):,.{quantity.digits}f}"
        for row in block.rows
        if row.label in claim.get("beside", ()) and _has(row, column)
        and quantity.better * (_value(row, column) - _value(first, column)) > 0.0
    ]  # fmt: skip
    if not ahead:
        return ""
    own = f"{first.label} {_value(first, column):,.{quantity.digits}f}"
    return f"{', '.join(ahead)} ({quantity.title}; {own})"


def _has(row: PaperRow, column: str) -> bool:
    return column in row.values and row.values[column].mean is not None


def _value(row: PaperRow, column: str) -> float:
    return float(row.values[column].mean or 0.0)


def _quantity(claim: dict[str, Any], rows: list[PaperRow]) -> float | None:
    """What a claim bounds; None if a value is missing."""
    column = claim["column"]
    values = [_value(row, column) for row in rows]
    if "of" in claim:
        if not _has(rows[0], claim["of"]):
            return None
        whole = _value(rows[0], claim["of"])
        values = [values[0] / QUANTITIES[column].scale, whole / QUANTITIES[claim["of"]].scale]
    what = claim.get("what", "value")
    if what == "value":
        return values[0]
    first, second = values
    if what == "gain":
        return first - second
    # Nothing is infinitely many times as large as nothing.
    above, below = (second, first) if what == "ratio" else (first, second)
    return above / below if below else None


def _decide(claim: dict[str, Any], measured: float, interval: Interval | None) -> str:
    # The tolerance is half of the last printed digit: "2.2 times" holds for 2.15.
    half = 0.0 if claim.get("exact") else 0.5 * 10.0 ** -_digits(claim)
    low, high, top = claim.get("least"), claim.get("most"), claim.get("top")
    # "Smaller" and "more accurate" are no rounded numbers.
    equal = 1.0 if claim.get("what") in ("ratio", "speedup") else 0.0
    floor = None if low is None else low - (half if low != equal else 0.0)
    good = (floor is None or measured >= floor) and (high is None or measured <= high + half)
    ends = [end for end in (floor, None if high is None else high + half) if end is not None]
    if interval is not None and any(map(interval.contains, ends)):
        return NOT_DECIDED
    if not good:
        return FAILS
    return EXCEEDS if top is not None and measured > top + half else HOLDS


def _digits(claim: dict[str, Any]) -> int:
    """Decimals of a claim's bounds as printed."""
    bounds = [str(claim[key]) for key in ("least", "most", "top") if key in claim]
    return max((len(text.partition(".")[2].rstrip("0")) for text in bounds), default=0)


def _bounds(claim: dict[str, Any]) -> str:
    for several in ("all", "columns"):
        if several in claim:
            return f"all {len(claim[several])}"
    if "column" not in claim:
        return ""
    if "over" in claim:
        return f"\N{GREATER-THAN OR EQUAL TO} {claim['least']:g} of the pairs"
    unit = {"gain": " dB", "value": "", "share": ""}.get(claim.get("what", "value"), " times")
    low, high = claim.get("least"), claim.get("most", claim.get("top"))
    if low is None or high is None or low == high:
        sign = "≥ " if high is None else "≤ " if low is None else ""
        text = f"{sign}{high if low is None else low:g}"
    else:
        text = f"{low:g} to {high:g}"
    return text.replace("-", "\N{MINUS SIGN}") + unit
