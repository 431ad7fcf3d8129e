"""Origin of the numbers: details of each row, and a table of the runs."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

from econgs_bench.reports import markup
from econgs_bench.reports.schema import by_name
from econgs_bench.reports.style import MISSING, absent, mib, seconds
from econgs_bench.reports.tables.columns import cell

if TYPE_CHECKING:
    from econgs_bench.reports.charts.report import Report


DETAILS = (
    "job", "commit", "machine", "processor", "fit_processor", "device", "threads", "variant", "rate",
    "preset", "split", "seed", "group", "iterations", "train_views", "width", "height", "samples", "one_ray",
    "group_seconds", "cpu_seconds", "encode_seconds", "group_bytes", "standalone_bytes",
    "group_peak_host_bytes", "fps_p05", "fps_p95", "reference_seconds", "identical_views", "stage", "reason",
    "scenes", "seeds", "note",
)  # fmt: skip
"""Columns of a row's details."""


def details(row: Any) -> list[str]:
    """The columns :data:`DETAILS` of a row of results or means; "" where one is missing."""
    return [
        "" if absent(row.get(name)) or row[name] == "" else by_name(name).text(row[name]) for name in DETAILS
    ]


def section(report: Report) -> str:
    """The page's table of runs: one row per method, dataset, commit, machine and options."""
    columns = ("commit", "machine", "fit_processor", "device", "threads", "preset", "iterations", "variant")
    keys = ["method", "dataset", *columns]
    lines = []
    for _, rows in report.results.groupby(keys, dropna=False, sort=False):
        row = rows.iloc[0].copy()
        row["rate"] = None  # the row is for all rates
        kernel = rows["reference_seconds"].dropna()
        times = f"{kernel.min() * 1e3:.1f} to {kernel.max() * 1e3:.1f} ms" if len(kernel) else MISSING
        cells = [markup.method(row, report.models), escape(str(row["dataset"])), _code(row["commit"], 12)]
        cells += [escape(cell(name, row[name])) for name in columns[1:-1]]
        cells += [escape(str(row["variant"])) if row["variant"] else "the preset", times]
        cells += [f"{len(rows)}", seconds(float(rows["group_seconds"].drop_duplicates().fillna(0).sum()))]
        memory = rows["group_peak_host_bytes"].dropna()
        cells.append(f"{mib(float(memory.max()))} MiB" if len(memory) else MISSING)
        lines.append(cells)
    heads = ("Method", "Dataset", *(by_name(name).header for name in columns))
    more = ("Reference kernel", "Rows", "Fit time", "Fit memory")
    return (
        f"{markup.table('Which code ran where, and with which options', (*heads, *more), lines)}"
        '<p class="note">The reference kernel is a fixed piece of work, timed before and after each '
        "measurement. Its time normalises speeds of different moments or machines. The records of the run "
        "store contain all resolved options and software versions; <code>results.csv</code> and the details "
        "of each row of the results contain the names of the jobs.</p>"
    )


def _code(value: Any, digits: int) -> str:
    return MISSING if absent(value) else f"<code>{escape(str(value)[:digits])}</code>"
