"""Tables that another tool made: read, checked, and filled up to the documented ones."""

from __future__ import annotations

import csv
import difflib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

NEEDED = ("dataset", "scene", "method", "psnr", "size_bytes")
"""Columns that a table of results cannot do without."""
_AXES = ("dataset", "scene", "method", "variant", "rate", "preset", "requested_views", "split", "seed")
_TEXT = {
    "dataset": "", "scene": "", "kind": "basic", "method": "", "variant": "", "preset": "", "split": "",
    "status": "ok", "reason": None, "group": None, "device": None, "machine": None, "stage": None,
    "commit": None, "edit": "", "processor": None, "fit_processor": None,
}  # fmt: skip
_WHOLE = (
    "primitives", "iterations", "train_views", "width", "height", "threads", "identical_views", "group_bytes",
    "standalone_bytes", "size_bytes", "peak_host_bytes", "peak_device_bytes", "group_peak_host_bytes",
    "requested_views",
)  # fmt: skip
_NUMBERS = (
    "rate", "psnr", "psnr_fg", "ssim", "lpips_vgg", "flip", "delta_e_uv", "train_seconds", "group_seconds",
    "load_seconds", "fps", "fps_p05", "fps_p95", "encode_seconds", "reference_seconds", "partition_seconds",
    "cpu_seconds", "missing", "excess",
)  # fmt: skip
_OTHERS = {
    "views": "job dataset scene method variant rate preset split seed view psnr psnr_fg ssim lpips_vgg flip "
    "delta_e_uv identical truth_file render_file alpha_file background requested_views missing excess",
    "curve": "job dataset scene method variant preset seed iteration train_seconds loss psnr primitives "
    "bytes_estimate loss_parts requested_views",
    "losses": "job dataset scene method variant preset seed stage first iteration losses requested_views",
    "ledger": "job dataset scene method variant rate preset seed part bytes requested_views",
    "timing": "job dataset scene method variant rate preset seed part seconds requested_views",
    "features": "job dataset scene method variant preset name values width requested_views",
    "scenes": "job dataset scene preset split requested_views transfer",
    "dvr": "job dataset scene kind preset status reason nx ny nz variables dtype volume_bytes ms_per_view "
    "ms_p05 ms_p95 fps load_seconds setup_seconds peak_host_bytes peak_device_bytes width height renderer "
    "version backend machine threads reference_seconds commit",
}


class Unusable(Exception):
    """An input that no report can be made of; the text names the file, the reason and the remedy."""


def read_results(path: Path) -> dict[str, pd.DataFrame]:
    """The documented tables, of which only `results` has rows.

    Args:
        path: a CSV file with a header, or a Parquet file, with at least the columns :data:`NEEDED`; others
            of docs/concepts/architecture.md are used, unknown ones ignored. A row without ``psnr`` is
            one that failed.

    Raises:
        Unusable: it cannot be read, lacks columns or rows, or has a value that is none.
    """
    import pandas as pd

    table = _read(path)
    missing = [name for name in NEEDED if name not in table]
    if missing:
        raise Unusable(f"{path}: {_lacks(missing, [str(name) for name in table.columns])}")
    if table.empty:
        raise Unusable(f"{path}: it has a header but no rows; write one row per scene and method")
    made = pd.DataFrame(index=pd.RangeIndex(len(table)))
    for name, usual in _TEXT.items():
        given = (
            table[name].astype("string") if name in table else pd.Series(pd.NA, made.index, dtype="string")
        )
        made[name] = given.fillna(usual) if usual is not None else given
    for name in (*_NUMBERS, *_WHOLE, "seed"):
        whole = name in _WHOLE or name == "seed"
        made[name] = _numbers(path, table, name, "Int64" if whole else "Float64")
    made["seed"] = made["seed"].fillna(0)
    for name in ("dataset", "scene", "method"):
        empty = [i for i, value in enumerate(made[name]) if not value]
        if empty:
            raise Unusable(f"{path}: {_line(empty[0])} has no {name}; fill the column in every row")
    made.loc[made["psnr"].isna() & (made["status"] == "ok"), ["status", "reason"]] = ["failed", "no psnr"]
    made["stale"] = pd.Series(False, made.index, dtype="boolean")
    made["job"] = pd.Series([f"row-{i}" for i in range(len(made))], dtype="string")
    _once(path, made)
    empties = {
        name: pd.DataFrame({column: pd.Series(dtype="object") for column in columns.split()})
        for name, columns in _OTHERS.items()
    }
    return {"results": made, **empties}


def _read(path: Path) -> pd.DataFrame:
    import pandas as pd

    try:
        return pd.read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    except FileNotFoundError as error:
        raise Unusable(f"{path}: there is no such file; give the table of results with --table") from error
    except (OSError, ValueError, csv.Error) as error:  # also pandas' and Arrow's own
        told = str(error).splitlines()[0] if str(error) else type(error).__name__
        remedy = "give a CSV file in UTF-8 with a header, or a Parquet file"
        raise Unusable(f"{path}: it cannot be read as a table ({told}); {remedy}") from error


def _read_csv(path: Path) -> pd.DataFrame:
    """All cells as text. Not by pandas, which takes cells for an index where a row has too many."""
    import pandas as pd

    with path.open(encoding="utf-8-sig", newline="") as file:
        header, *rows = [row for row in csv.reader(file) if row] or [[]]
    if not header:
        raise Unusable(f"{path}: it is empty; write a header and one row per scene and method")
    twice = [name for i, name in enumerate(header) if name in header[:i]]
    if twice:
        raise Unusable(f"{path}: it has the column {twice[0]} twice; rename or remove one")
    for i, row in enumerate(rows):
        if len(row) != len(header):
            cells = f"{len(row)} cells, the header {len(header)}"
            raise Unusable(f"{path}: {_line(i)} has {cells}; write decimal points, quote texts with commas")
    table = pd.DataFrame(rows, columns=header, dtype="string")
    return table.mask(table == "")


def _lacks(missing: list[str], given: list[str]) -> str:
    """What is missing, and what may have been meant."""
    near = []
    for name in missing:
        found = difflib.get_close_matches(name, [text.strip().lower() for text in given], 1, 0.5)
        near += [f"{found[0]} -> {name}"] if found else []
    hint = f"rename {', '.join(near)}" if near else f"a table needs {', '.join(NEEDED)}"
    return f"it lacks the columns {', '.join(missing)}; {hint}"


def _numbers(path: Path, table: pd.DataFrame, name: str, kind: str) -> pd.Series:
    import pandas as pd

    if name not in table:
        return pd.Series(pd.NA, pd.RangeIndex(len(table)), dtype=kind)  # type: ignore[call-overload,no-any-return]
    values: pd.Series = pd.to_numeric(table[name], errors="coerce").astype("Float64")
    whole = kind == "Int64"
    for i, (text, value) in enumerate(zip(table[name], values, strict=True)):
        if pd.isna(text):
            continue
        if pd.isna(value) or abs(float(value)) == float("inf") or (whole and float(value) % 1):
            what = "a whole number" if whole else "a number"
            raise Unusable(f"{path}: {_line(i)} has {name} = {text}, not {what}; leave it empty if missing")
    return values.astype(kind)  # type: ignore[call-overload,no-any-return]


def _once(path: Path, table: pd.DataFrame) -> None:
    again = table.duplicated(list(_AXES))
    if again.any():
        i = int(again.to_numpy().argmax())
        who = " / ".join(str(table[name][i]) for name in ("dataset", "scene", "method"))
        remedy = "tell them apart by variant, rate, preset, requested_views, split or seed"
        raise Unusable(f"{path}: {_line(i)} repeats {who} of a row above; {remedy}")


def _line(row: int) -> str:
    """As an editor counts, below the header."""
    return f"line {row + 2}"
