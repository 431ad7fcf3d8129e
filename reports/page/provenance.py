"""Where the numbers come from: of each row in its details, of each kind of run in a table."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

from reports.page import markup
from reports.style import MISSING, absent, mib, seconds, series
from reports.tables.columns import cell

if TYPE_CHECKING:
    import pandas as pd


def _mib(value: Any) -> str:
    return f"{mib(float(value))} MiB"


def _milliseconds(value: Any) -> str:
    return f"{float(value) * 1e3:.1f} ms"


DETAILS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "job": ("Job", str),
    "commit": ("Commit", str),
    "machine": ("Machine", str),
    "processor": ("Processor", str),
    "fit_processor": ("Trained on", str),
    "device": ("Device", str),
    "threads": ("Threads", str),
    "variant": ("Options", str),
    "rate": ("Rate", "{:g}".format),
    "preset": ("Preset", str),
    "split": ("Split", str),
    "seed": ("Seed", str),
    "group": ("Trained with", str),
    "iterations": ("Iterations", "{:,}".format),
    "train_views": ("Training views", str),
    "width": ("Image width", str),
    "height": ("Image height", str),
    "group_seconds": ("Fit of the group", lambda value: seconds(float(value))),
    "cpu_seconds": ("Processor time of the fit, its share", lambda value: seconds(float(value))),
    "encode_seconds": ("Encoding", lambda value: seconds(float(value))),
    "group_bytes": ("Files of the group", _mib),
    "standalone_bytes": ("Files for this scene alone", _mib),
    "group_peak_host_bytes": ("Memory of the fit", _mib),
    "fps_p05": ("FPS of the slowest 5 %", "{:.4g}".format),
    "fps_p95": ("FPS of the fastest 5 %", "{:.4g}".format),
    "reference_seconds": ("Reference kernel", _milliseconds),
    "identical_views": ("Identical views", str),
    "stage": ("Stopped in", str),
    "reason": ("Reason", str),
    # Of rows that sum up others.
    "scenes": ("Scenes", str),
    "seeds": ("Seeds", str),
    "note": ("Note", str),
}
"""Column -> its name in a row's details, and how it is written there."""


def details(row: Any) -> list[str]:
    """What the table does not show of a row, in the order of :data:`DETAILS`; "" where it is missing."""
    return [
        "" if absent(row.get(name)) or row[name] == "" else write(row[name])
        for name, (_, write) in DETAILS.items()
    ]


def section(results: pd.DataFrame) -> str:
    """The page's table of runs: rows of one method, dataset, commit, machine and options are told once."""
    columns = ("commit", "machine", "fit_processor", "device", "threads", "preset", "iterations", "variant")
    keys = ["method", "dataset", *columns]
    lines = []
    names = series(results)
    for _, rows in results.groupby(keys, dropna=False, sort=False):
        row = rows.iloc[0].copy()
        row["rate"] = None  # of all rates
        kernel = rows["reference_seconds"].dropna()
        times = f"{kernel.min() * 1e3:.1f} to {kernel.max() * 1e3:.1f} ms" if len(kernel) else MISSING
        cells = [markup.method(row, names), escape(str(row["dataset"])), _code(row["commit"], 12)]
        cells += [escape(cell(name, row[name])) for name in columns[1:-1]]
        cells += [escape(str(row["variant"])) if row["variant"] else "the preset", times]
        cells += [f"{len(rows)}", seconds(float(rows["group_seconds"].drop_duplicates().fillna(0).sum()))]
        memory = rows["group_peak_host_bytes"].dropna()
        cells.append(f"{mib(float(memory.max()))} MiB" if len(memory) else MISSING)
        lines.append(cells)
    heads = ("Method", "Dataset", *(DETAILS[name][0] for name in columns))
    more = ("Reference kernel", "Rows", "Fit time", "Fit memory")
    return (
        f"{markup.table('Which code ran where, and with which options', (*heads, *more), lines)}"
        '<p class="note">The reference kernel is a fixed piece of work timed before and after each '
        "measurement: speeds from different moments or machines can be normalised by it. "
        "All resolved options and software versions stand in the run store's records, the jobs' names in "
        "<code>results.csv</code> and in the details of each row of the results.</p>"
    )


def _code(value: Any, digits: int) -> str:
    return MISSING if absent(value) else f"<code>{escape(str(value)[:digits])}</code>"
