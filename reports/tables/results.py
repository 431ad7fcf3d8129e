"""The table of results as people read it, and its notes."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

from econgs_bench.reports import comparability
from econgs_bench.reports.schema import COLUMNS, TABLES, records
from econgs_bench.reports.style import absent, label
from econgs_bench.reports.tables.columns import axes, cell, field, is_results, numbers
from econgs_bench.reports.tables.grid import Field, needed

if TYPE_CHECKING:
    import pandas as pd


def display(results: pd.DataFrame) -> pd.DataFrame:
    """The columns of `results` that people read: method, variant and rate as one name, no bookkeeping.

    A column that is the same in all rows (one seed) or empty is omitted. Only unfinished rows have a reason.
    """
    names = numbers(results)
    out = results[["dataset", "scene", "method", *names]].copy()
    out["method"] = [label(*row) for row in results[["method", "variant", "rate"]].itertuples(index=False)]
    for axis in axes(results):
        out.insert(3, axis, results[axis])
    out["status"] = [_status(row) for row in results[["status", "stale"]].itertuples(index=False)]
    unfinished = results["status"] != "ok"
    if unfinished.any():
        out["reason"] = results["reason"].where(unfinished, None)
    return out


def notes(results: pd.DataFrame) -> list[str]:
    """A fixed number of rays of the truth, reasons why finished rows lack a metric, what is not compared."""
    reasons = results.loc[results["status"] == "ok", "reason"].dropna().astype(str)
    rays = comparability.fixed_rays(records(results))
    every = [rays and f"Ground truth: {rays}.", *reasons, *comparability.notes(results)]
    return [note for note in dict.fromkeys(every) if note]


def omissions(text: Any) -> dict[str, str]:
    """Metric -> reason why it is missing, from the column `omissions`."""
    return {} if absent(text) else dict(json.loads(text))


def with_notes(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """A table as people read it, and the notes below it."""
    if is_results(table):
        return display(table), notes(table)
    if "reason" not in table:
        return table, []
    # A note gives each reason once instead of in every row.
    ranked = [name for name in table.columns if name in COLUMNS and COLUMNS[name].better]
    empty = [name for name in ranked if table[name].isna().all()]
    return table.drop(columns=["reason", *empty]), [
        reason for reason in table["reason"].dropna().unique() if reason
    ]


def _status(row: Any) -> str:
    status, stale = row
    return f"{status} (stale)" if not absent(stale) and stale else str(status)


def marked(text: str, left_out: bool) -> str:
    """A cell; a value that is not compared is in brackets."""
    return f"({text})" if left_out else text


_OPTIONAL = (
    "load_seconds", "peak_device_bytes", "peak_host_bytes", "primitives", "delta_e_uv", "psnr_fg",
    "lpips_vgg", "flip", "reason", "floor", "kind", "ssim", "train_seconds", "fps", "status", "size_bytes",
)  # fmt: skip
"""Columns that a narrow terminal omits, in this order."""
_CONSTANT = ("dataset", "preset", "split", "seed", "device", "status")
"""What is said once, above the table, where all rows share it."""


_LONGEST = 300
"""Characters of a cell; what has longer ones is for programs."""


def for_terminal(results: pd.DataFrame, width: int, *, jobs: bool = False) -> tuple[str, list[Field]]:
    """The table of results in ``width`` characters: what all rows share, and the columns.

    Where the columns do not fit, the least important ones are omitted, because no number may be cut.

    Args:
        results: rows.
        width: in characters.
        jobs: with the name of each row's job, whole.
    """
    table = display(results)
    if "reason" in table:
        table["reason"] = table["reason"].fillna("")
    if jobs:
        table["job"] = results["job"]
    return fitted(results, table, comparability.left_out(results), _OPTIONAL, width)


def stored_for_terminal(name: str, table: pd.DataFrame, width: int) -> tuple[str, list[Field]]:
    """Any table of the schema as :func:`for_terminal` shows results: scene and method, then its own columns.

    The last columns are omitted where they do not fit, and such as are empty or for programs.
    """
    axes = [axis for axis in ("dataset", "scene", "method", *_CONSTANT[1:5]) if axis in TABLES[name].axes]
    facts = [
        fact
        for fact in TABLES[name].facts
        if fact not in (*axes, "job", "variant", "rate") and table[fact].notna().any()
    ]
    shown = table[[*axes, *facts, "job"]].copy()
    if {"method", "variant"} <= set(table.columns):
        keys = [name for name in ("method", "variant", "rate") if name in table]
        shown["method"] = [label(*row) for row in table[keys].itertuples(index=False)]
    return fitted(table, shown, (), facts[::-1], width)


def fitted(
    table: pd.DataFrame,
    shown: pd.DataFrame,
    out: Collection[tuple[Any, str]],
    optional: Sequence[str],
    width: int,
) -> tuple[str, list[Field]]:
    """What all rows share, and those columns that fit.

    Args:
        table: has the axes.
        shown: has the columns.
        out: (row index, column) of values in brackets.
        optional: columns that are omitted where they do not fit, in this order.
        width: in characters.
    """
    values = {name: shown[name] if name in shown else table[name] for name in _CONSTANT if name in table}
    same = [name for name, column in values.items() if column.nunique(dropna=False) == 1]
    shared = [_shared(name, values[name].iloc[0]) for name in same if not absent(values[name].iloc[0])]
    fields = {}
    for name in [name for name in shown.columns if name not in same]:
        cells = [marked(cell(name, value), (index, name) in out) for index, value in shown[name].items()]
        if max(map(len, cells), default=0) <= _LONGEST or name not in optional:
            fields[name] = field(name, cells)
    for name in optional:
        if needed(fields.values()) <= width:
            break
        fields.pop(name, None)
    return ", ".join(filter(None, shared)), list(fields.values())


def _shared(axis: str, value: Any) -> str:
    """As "vortices", "preset quick", "seed 0", "test views"; "" for what is usual."""
    text = cell(axis, value)
    if axis == "split":
        return f"{text} views"
    if axis == "status" and text == "ok":
        return ""
    return f"{axis} {text}" if axis in ("preset", "seed", "status") else text
