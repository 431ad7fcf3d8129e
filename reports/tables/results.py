"""The table of results as people read it, and its notes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from reports.schema import by_name
from reports.style import absent, label
from reports.tables.columns import cell, is_results, quality

if TYPE_CHECKING:
    import pandas as pd


def shown(results: pd.DataFrame) -> pd.DataFrame:
    """What people read of `results`: method with variant and rate in one name, no columns of bookkeeping.

    Columns that say the same for all rows (one seed, what nobody has measured) are left out; reasons are
    those of rows that did not finish.
    """
    import pandas as pd

    names = ["dataset", "scene", "method", *quality(results), "size_bytes", "primitives", "train_seconds"]
    names += ["load_seconds", "fps", "peak_host_bytes", "peak_device_bytes"]
    names = [name for name in names if name in ("psnr", "size_bytes") or results[name].notna().any()]
    out = pd.DataFrame({name: results[name] for name in names}, index=results.index)
    out["method"] = [label(*row) for row in results[["method", "variant", "rate"]].itertuples(index=False)]
    for axis in ("kind", "preset", "split", "seed", "device"):
        if results[axis].nunique(dropna=False) > 1:
            out.insert(3, axis, results[axis])
    out["status"] = [_status(row) for row in results[["status", "stale"]].itertuples(index=False)]
    unfinished = results["status"] != "ok"
    if unfinished.any():
        out["reason"] = results["reason"].where(unfinished, None)
    return out


def notes(results: pd.DataFrame) -> list[str]:
    """Why finished rows lack a metric, each reason once; and the processors that timed them, if several."""
    finished = results[results["status"] == "ok"]
    reasons = [str(reason) for reason in finished["reason"] if not absent(reason)]
    return [told for told in dict.fromkeys([*reasons, processors(results)]) if told]


def processors(results: pd.DataFrame) -> str:
    """That speeds and times are of several processors; "" if they are not, or it is not known."""
    told = []
    for column, what in (("processor", "rendering was timed"), ("fit_processor", "models were trained")):
        names = distinct_processors(results, column)
        if len(names) > 1:
            told.append(f"{what} on {' and on '.join(names)}")
    return f"Several processors: {'; '.join(told)}. Compare times of one." if told else ""


def distinct_processors(results: pd.DataFrame, column: str) -> list[str]:
    """Those that a column names. What runs without native kernels does not name their instruction set."""
    every = [str(name) for name in results[column].dropna().unique()] if column in results else []
    return [name for name in every if not any(other.startswith(f"{name},") for other in every)]


def left_out(superseded: pd.DataFrame | None) -> str:
    """How many rows the tables leave out for others of the same model; "" if none."""
    count = 0 if superseded is None else len(superseded)
    if not count:
        return ""
    rows = "1 row" if count == 1 else f"{count} rows"
    verb = "is" if count == 1 else "are"
    return f"{rows} of older versions of the same models {verb} left out."


def readable(table: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """A table as people read it, and remarks to stand under it."""
    if is_results(table):
        return shown(table), notes(table)
    if "reason" not in table:
        return table, []
    # Why metrics are missing is told once instead of in every row.
    told = (part for reason in table["reason"] if not absent(reason) for part in reason.split("; "))
    ranked = [name for name in table.columns if by_name(name).better]
    nowhere = [name for name in ranked if table[name].isna().all()]
    return table.drop(columns=["reason", *nowhere]), list(dict.fromkeys(part for part in told if part))


def _status(row: Any) -> str:
    status, stale = row
    return f"{status} (stale)" if not absent(stale) and stale else str(status)


_FIRST_TO_GO = (
    "reason", "load_seconds", "peak_device_bytes", "peak_host_bytes", "primitives", "delta_e_uv", "psnr_fg",
)  # fmt: skip
_GAP = 2


def terminal_rows(results: pd.DataFrame, width: int) -> list[list[str]]:
    """Header and lines of the table that ends a run.

    Where the columns do not fit ``width`` characters, those that people miss least are left out (the
    reasons are told below the table anyway): a number cut short is worse than none.
    """
    table = shown(results)
    texts = {
        name: ["" if name == "reason" and absent(value) else cell(name, value) for value in table[name]]
        for name in table.columns
    }
    for name in _FIRST_TO_GO:
        if sum(least_width(by_name(n).header, cells) + _GAP for n, cells in texts.items()) - _GAP <= width:
            break
        texts.pop(name, None)
    return [[by_name(name).header for name in texts], *map(list, zip(*texts.values(), strict=True))]


def least_width(header: str, cells: list[str]) -> int:
    """Characters that a column needs: a header can be broken between words, cells cannot."""
    return max(map(len, [*header.split(), *cells]))
