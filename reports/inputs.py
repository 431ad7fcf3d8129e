"""Tables of other tools as tables of :mod:`.reports.schema`: checked, with defaults for missing columns."""

from __future__ import annotations

import csv
import difflib
import json
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.reports.comparability import judged
from econgs_bench.reports.schema import COLUMNS, TABLES, Column, frame
from econgs_bench.reports.style import absent
from econgs_bench.reports.text import csv_text

if TYPE_CHECKING:
    import pandas as pd

NEEDED = ("dataset", "scene", "method", "psnr", "size_bytes")
"""Columns that a table of results must have."""
_KEYS = (
    "dataset", "scene", "kind", "edit", "recipe", "scenes_together", "method", "variant", "rate", "preset",
    "requested_views", "split", "seed",
)  # fmt: skip
_OWN = ("job", "stale", "omissions", "differences")
"""Columns of `results` that are not read from a foreign table."""


class Unusable(Exception):
    """An input from which no report can be made; the text names the file, the reason and the remedy."""


def read_results(path: Path) -> dict[str, pd.DataFrame]:
    """All tables, of which only `results` has rows.

    Args:
        path: a CSV file with a header, or a Parquet file, with at least the columns :data:`NEEDED`. Further
            columns of `results` are used, unknown ones ignored. A row without ``psnr`` counts as failed.

    Raises:
        Unusable: the file cannot be read, lacks columns or rows, or has a value of the wrong type.
    """
    import pandas as pd

    table = _read(path).reset_index(drop=True)
    missing = [name for name in NEEDED if name not in table]
    if missing:
        raise Unusable(f"{path}: {_lacks(missing, [str(name) for name in table.columns])}")
    if table.empty:
        raise Unusable(f"{path}: it has a header but no rows; write one row per scene and method")
    results = pd.DataFrame({name: _values(path, table, name) for name in TABLES["results"].columns})
    results["base"] = results["base"].fillna(results["variant"])
    for name in ("dataset", "scene", "method"):
        empty = [i for i, value in enumerate(results[name]) if not value]
        if empty:
            raise Unusable(f"{path}: {_line(empty[0])} has no {name}; fill the column in every row")
    lost = results["psnr"].isna() & (results["status"] == "ok")
    results.loc[lost, ["status", "reason"]] = ["failed", "no psnr"]
    results["job"] = pd.Series([f"row-{i}" for i in range(len(results))], dtype="string")
    _once(path, results)
    results = judged(results)
    return {name: results if name == "results" else frame(name) for name in TABLES}


def _values(path: Path, table: pd.DataFrame, name: str) -> pd.Series:
    """A column of `results`, with its default where the foreign table has no value."""
    import pandas as pd

    column = COLUMNS[name]
    if name not in table or name in _OWN:
        values = pd.Series(pd.NA, table.index, dtype=column.dtype)
    elif column.dtype == "string":
        values = table[name].astype("string")
        if name == "fitted_scenes":
            _check_lists(path, values)
    elif column.dtype == "boolean":
        values = _truths(path, table[name], column)
    else:
        values = _numbers(path, table[name], column)
    return values if column.default is None else values.fillna(column.default)


def _read(path: Path) -> pd.DataFrame:
    import pandas as pd

    try:
        return pd.read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    except FileNotFoundError as error:
        raise Unusable(f"{path}: there is no such file; give the table of results with --table") from error
    except (OSError, ValueError, csv.Error) as error:  # also pandas' and Arrow's own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        remedy = "give a CSV file in UTF-8 with a header, or a Parquet file"
        raise Unusable(f"{path}: it cannot be read as a table ({reason}); {remedy}") from error


def _read_csv(path: Path) -> pd.DataFrame:
    """All cells as text. Not by pandas, which takes cells for an index where a row has too many."""
    import pandas as pd

    with path.open(encoding="utf-8-sig", newline="") as file:
        header, *rows = [row for row in csv.reader(file) if row] or [[]]
    if not header:
        raise Unusable(f"{path}: it is empty; write a header and one row per scene and method")
    twice = [name for i, name in enumerate(header) if name in header[:i]]
    if twice:
        raise Unusable(f"{path}: it has the column {twice[0]} twice; rename or remove one of them")
    for i, row in enumerate(rows):
        if len(row) != len(header):
            cells = f"{len(row)} cells, the header {len(header)}"
            raise Unusable(f"{path}: {_line(i)} has {cells}; write decimal points, quote texts with commas")
    table = pd.DataFrame([map(csv_text, row) for row in rows], columns=header, dtype="string")
    return table.mask(table == "")


def _lacks(missing: list[str], columns: list[str]) -> str:
    """The missing columns, and similar names that may stand for them."""
    names = [text.strip().lower() for text in columns]
    similar = [(name, difflib.get_close_matches(name, names, 1, 0.5)) for name in missing]
    near = [f"{match} -> {name}" for name, matches in similar for match in matches]
    hint = f"rename {', '.join(near)}" if near else f"a table needs {', '.join(NEEDED)}"
    return f"it lacks the columns {', '.join(missing)}; {hint}"


def _check_lists(path: Path, texts: pd.Series) -> None:
    for i, text in enumerate(texts):
        try:
            good = absent(text) or all(isinstance(name, str) for name in json.loads(text))
        except (ValueError, TypeError, RecursionError):
            good = False
        if not good:
            reason = f"{_line(i)} has {texts.name} = {text}, not a JSON list of names"
            raise Unusable(f"{path}: {reason}; leave it empty if missing")


def _truths(path: Path, texts: pd.Series, column: Column) -> pd.Series:
    import pandas as pd

    known = {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}
    values: list[bool | None] = []
    for i, text in enumerate(texts):
        value = None if pd.isna(text) else known.get(str(text).strip().lower())
        if value is None and not pd.isna(text):
            reason = f"{_line(i)} has {column.name} = {text}, neither true nor false"
            raise Unusable(f"{path}: {reason}; leave it empty if missing")
        values.append(value)
    return pd.Series(values, texts.index, dtype="boolean")


def _numbers(path: Path, texts: pd.Series, column: Column) -> pd.Series:
    import pandas as pd

    values: pd.Series = pd.to_numeric(texts, errors="coerce").astype("Float64")
    whole = column.dtype == "Int64"
    for i, (text, value) in enumerate(zip(texts, values, strict=True)):
        if pd.isna(text):
            continue
        if pd.isna(value) or abs(float(value)) == float("inf") or (whole and float(value) % 1):
            what = "a whole number" if whole else "a number"
            reason = f"{_line(i)} has {column.name} = {text}, not {what}"
            raise Unusable(f"{path}: {reason}; leave it empty if missing")
    return values.astype(column.dtype)


def _once(path: Path, table: pd.DataFrame) -> None:
    again = table.duplicated(list(_KEYS))
    if again.any():
        i = int(again.to_numpy().argmax())
        who = " / ".join(str(table[name][i]) for name in ("dataset", "scene", "method"))
        remedy = "tell them apart by variant, rate, preset, requested_views, split or seed"
        raise Unusable(f"{path}: {_line(i)} repeats {who} of a row above; {remedy}")


def _line(row: int) -> str:
    """As an editor counts, below the header."""
    return f"line {row + 2}"
