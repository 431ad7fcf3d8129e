"""The table of results as people read it, and its notes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from reports import comparability
from reports.schema import COLUMNS, by_name, records
from reports.style import absent, label
from reports.tables.columns import axes, cell, is_results, numbers

if TYPE_CHECKING:
    import pandas as pd


def display(results: pd.DataFrame) -> pd.DataFrame:
    """The columns of `results` that people read: method, variant and rate as one name, no bookkeeping.

    A column that is the same in all rows (one seed) or empty is omitted. Only unfinished rows have a reason.
    """
    names = [n for n in numbers(results) if n in ("psnr", "size_bytes") or results[n].notna().any()]
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
    "reason", "load_seconds", "peak_device_bytes", "peak_host_bytes", "primitives", "delta_e_uv", "psnr_fg",
    "floor",
)  # fmt: skip
"""Columns that a narrow terminal omits, in this order."""
_GAP = 2


def terminal_rows(results: pd.DataFrame, width: int) -> list[list[str]]:
    """Header and lines of the table at the end of a run.

    Where the columns do not fit into ``width`` characters, the least important ones are omitted, because no
    number may be cut. (The run prints the reasons below the table in any case.)
    """
    table = display(results)
    out = comparability.left_out(results)
    texts = {
        name: [
            "" if name == "reason" and absent(value) else marked(cell(name, value), (index, name) in out)
            for index, value in table[name].items()
        ]
        for name in table.columns
    }
    for name in _OPTIONAL:
        if sum(least_width(by_name(n).header, cells) + _GAP for n, cells in texts.items()) - _GAP <= width:
            break
        texts.pop(name, None)
    header = [by_name(name).header for name in texts]
    return [header, *map(list, zip(*texts.values(), strict=True))]


def least_width(header: str, cells: list[str]) -> int:
    """Least width of a column in characters: a header can be broken between words, cells cannot."""
    return max(map(len, [*header.split(), *cells]))
