"""Ladders: how far a method climbs from the usual run towards the fatal one, and how it breaks.

The definition of a break is that of the columns `failure` and `change` of :mod:`.reports.schema`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from statistics import fmean, stdev
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.report import Report, once
from econgs_bench.reports.schema import COLUMNS, records
from econgs_bench.reports.style import absent
from econgs_bench.reports.tables.protocols import of_shared_seeds

if TYPE_CHECKING:
    import pandas as pd

LOSS = 3.0
"""Fall of PSNR that is a break, in dB."""
CAP = 48.13
"""PSNR of an error of one 8-bit step; better ones count as this."""
COVERAGE_LOSS = 0.2
"""Growth of missing or excess alpha that is a break, as a share of the truth's."""
COLLAPSE = 0.5
"""Missing alpha of a picture that is little but background."""
EXPLOSION = 5.0
"""Factor on the number of primitives that is a break."""
STATUSES = {"diverged": "diverged", "oom": "memory", "timeout": "time", "refused": "refusal"}
FAILURES = (
    *STATUSES.values(), "decode error", "failure", "collapse", "explosion", "vanishing parts", "floaters",
    "quality",
)  # fmt: skip
"""Kinds of breaks, the gravest first."""
_MEANS = ("psnr", "missing", "excess", "flicker", "primitives", "size_bytes", "train_seconds")
_FACTS = ("purpose", "rungs", "rung", "dataset", "scene", "same_truth", "job")
_OF_BREAK = (
    "place", "rung", "failure", "subject", "scene", "change", "missing", "excess", "reason", "job",
)  # fmt: skip
_MODEL = ("method", "variant")
_KEY = ("ladder", "preset", "split", "requested_views", "subject", *_MODEL)
COLUMNS_OF_LADDERS = (
    *_KEY, "purpose", "place", "rungs", "rung", "dataset", "scene", "same_truth", "psnr", "psnr_std", "seeds",
    "change", "missing", "excess", "flicker", "primitives", "size_bytes", "train_seconds", "failure",
    "reason", "job", "first_job",
)  # fmt: skip

Row = dict[str, Any]


@once
def of_report(report: Report) -> pd.DataFrame:
    """The ladders of a report."""
    return ladders(report.table("rungs"))


@once
def at_shared_seeds(report: Report) -> pd.DataFrame:
    """The ladders of a report, each rung of the seeds that all methods have there, if they have any."""
    places = [*(name for name in _KEY if name not in _MODEL), "place"]
    return ladders(of_shared_seeds(report.table("rungs"), places))


def ladders(rungs: pd.DataFrame) -> pd.DataFrame:
    """One row per rung that a method was measured on, means over its seeds, with the kind of its break.

    Ladders of which only the first rung was measured are left out.

    Args:
        rungs: the table `rungs`.

    Returns:
        Columns :data:`COLUMNS_OF_LADDERS`: ``job`` and ``first_job`` are measurements of the rung (with the
        first seed; one that failed, if any did) and of the first rung.
    """
    import pandas as pd

    climbs: dict[tuple[Any, ...], dict[int, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in records(rungs):
        key = tuple("" if absent(row[name]) else row[name] for name in _KEY)
        climbs[key][int(row["place"])].append(row)
    means = {
        key: {place: _mean(rows) for place, rows in sorted(places.items())}
        for key, places in climbs.items()
        if set(places) != {0}
    }
    best: dict[tuple[Any, ...], float] = {}
    for key, places in means.items():
        for place, row in places.items():
            if row["psnr"] is not None:
                where = (*key[:5], place)
                best[where] = max(best.get(where, 0.0), min(row["psnr"], CAP))
    rows = []
    for key, places in means.items():
        first = places.get(0)
        for place, row in places.items():
            lead = best.get((*key[:5], place), 0.0) - best.get((*key[:5], 0), 0.0)
            row["change"] = _change(row, first, lead)
            row["first_job"] = first["job"] if first else None
            row["failure"] = row["failure"] or _break(row, first)
            rows.append(dict(zip(_KEY, key, strict=True)) | {"place": place} | row)
    types = {name: COLUMNS[name].dtype for name in COLUMNS_OF_LADDERS if name in COLUMNS}
    return pd.DataFrame(rows, columns=list(COLUMNS_OF_LADDERS)).astype(types | {"first_job": "string"})


def climbed(table: pd.DataFrame) -> list[Row]:
    """How far each method climbs each ladder, on all subjects together.

    Args:
        table: of :func:`ladders`.

    Returns:
        A row per ladder, preset, split, number of views, method and variant, in the order of the ladders.
        ``rungs`` of the ladder and its ``purpose``; ``outcomes``, place of a measured rung -> the gravest
        kind of break of any subject, None if the rung holds on all. Of the first break, on the subject with
        the earliest and gravest: ``place``, ``rung``, ``failure``, ``subject``, ``scene``, ``change``,
        ``missing``, ``excess``, ``reason``, ``job``; None without a break.
    """
    climbs: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in records(table):
        climbs[tuple(row[name] for name in _KEY if name != "subject")].append(row)
    result = []
    for key, rows in climbs.items():
        outcomes: dict[int, str | None] = {}
        for row in rows:
            kinds = [outcomes.get(row["place"]), None if absent(row["failure"]) else row["failure"]]
            outcomes[row["place"]] = min(kinds, key=_gravity)
        broken = min(
            (row for row in rows if not absent(row["failure"])),
            key=lambda row: (
                row["place"],
                _gravity(row["failure"]),
                0.0 if absent(row["change"]) else row["change"],
            ),
            default=None,
        )
        climb = dict(zip((name for name in _KEY if name != "subject"), key, strict=True))
        climb |= {"rungs": rows[0]["rungs"], "purpose": rows[0]["purpose"], "outcomes": outcomes}
        for name in _OF_BREAK:
            climb[name] = None if broken is None or absent(broken[name]) else broken[name]
        result.append(climb)
    return result


def held(climb: Row) -> int:
    """Number of rungs above the usual run that hold."""
    return sum(place > 0 and kind is None for place, kind in climb["outcomes"].items())


def _gravity(failure: str | None) -> int:
    return len(FAILURES) if failure is None else FAILURES.index(failure)


def severity(climb: Row) -> tuple[float, int, float]:
    """Sorts climbs, the earliest break ahead: by the share of rungs before it, kind of break and change."""
    before = climb["rungs"] if climb["failure"] is None else climb["place"]
    return (before - 1) / (climb["rungs"] - 1), _gravity(climb["failure"]), climb["change"] or 0.0


def _mean(rows: Sequence[Row]) -> Row:
    """A rung: means over its finished seeds; the failure of a seed is the rung's."""
    rows = sorted(rows, key=lambda row: row["seed"])
    good = [row for row in rows if row["status"] == "ok"]
    failed = next((row for row in rows if row["status"] != "ok"), None)
    shown = failed or rows[0]
    means = {name: _values(good, name) for name in _MEANS}
    psnr = means["psnr"]
    return {
        **{name: fmean(values) if values else None for name, values in means.items()},
        **{name: shown[name] for name in _FACTS},
        "primitives": round(fmean(means["primitives"])) if means["primitives"] else None,
        "size_bytes": round(fmean(means["size_bytes"])) if means["size_bytes"] else None,
        "psnr_std": stdev(psnr) if len(psnr) > 1 else None,
        "seeds": len(good),
        "failure": None if failed is None else _failure(failed),
        "reason": None if failed is None or absent(failed["reason"]) else failed["reason"],
    }


def _values(rows: Sequence[Row], name: str) -> list[float]:
    return [float(row[name]) for row in rows if not absent(row[name])]


def _failure(row: Row) -> str:
    """The kind of a failed step."""
    if row["status"] in STATUSES:
        return STATUSES[row["status"]]
    step, stage, reason = (
        "" if absent(row[name]) else str(row[name]) for name in ("failed_step", "stage", "reason")
    )
    if "not finite" in reason or "FloatingPointError" in reason:
        return "diverged"
    return "decode error" if step == "encode" or (step == "measure" and stage == "load") else "failure"


def _change(row: Row, first: Row | None, lead: float) -> float | None:
    """PSNR less that of the first rung; of other test pictures, less what the best method gained (lead)."""
    if first is None or row["psnr"] is None or first["psnr"] is None:
        return None
    change = float(min(row["psnr"], CAP) - min(first["psnr"], CAP))
    return change if row["same_truth"] else change - lead


def _break(row: Row, first: Row | None) -> str | None:
    """The kind of break of a result; None if the rung holds."""
    grown = {
        name: (row[name] or 0.0) - ((first[name] if first and row is not first else None) or 0.0)
        for name in ("missing", "excess")
    }
    if (row["missing"] or 0.0) > COLLAPSE and grown["missing"] > COVERAGE_LOSS:
        return "collapse"
    if first is None or row is first:
        return None
    if row["same_truth"] and (row["primitives"] or 0) > EXPLOSION * (first["primitives"] or float("inf")):
        return "explosion"
    if grown["missing"] > COVERAGE_LOSS:
        return "vanishing parts"
    if grown["excess"] > COVERAGE_LOSS:
        return "floaters"
    if row["change"] is not None and row["change"] <= -LOSS:
        return "quality"
    return None
