"""Which code ran where, and with which options."""

from __future__ import annotations

from econgs_bench.reports.schema import by_name
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING, absent, label, mib, seconds
from econgs_bench.reports.tables.columns import cell
from econgs_bench.reports.tables.table import Table

_COLUMNS = ("commit", "machine", "fit_processor", "device", "threads", "preset", "iterations")
_NOTE = (
    "The reference kernel is a fixed piece of work, timed before and after each measurement: its time "
    "normalises speeds of other moments or machines. The records of the run store have all resolved options "
    "and software versions; results.csv and the details of each row of the results name the jobs."
)


def section(page: Page) -> Section | None:
    """One row per method, dataset, commit, machine and options; None where no row has them."""
    results = page.report.results
    if results[["machine", "commit"]].dropna(how="all").empty:
        return None
    lines = []
    keys = ["method", "variant", "dataset", *_COLUMNS]
    for _, rows in results.groupby(keys, dropna=False, sort=False):
        row = rows.iloc[0]
        kernel = rows["reference_seconds"].dropna() * 1e3
        memory = rows["group_peak_host_bytes"].dropna()
        time = float(rows["group_seconds"].drop_duplicates().fillna(0).sum())
        lines.append(
            [
                label(row["method"], row["variant"]),
                str(row["dataset"]),
                MISSING if absent(row["commit"]) else str(row["commit"])[:12],
                *(cell(name, row[name]) for name in _COLUMNS[1:]),
                f"{kernel.min():.1f} to {kernel.max():.1f} ms" if len(kernel) else MISSING,
                f"{len(rows)}",
                seconds(time),
                f"{mib(float(memory.max()))} MiB" if len(memory) else MISSING,
            ]
        )
    heads = ["Method", "Dataset", *(by_name(name).header for name in _COLUMNS)]
    heads += ["Reference kernel", "Rows", "Fit time", "Fit memory"]
    table = Table("Which code ran where, and with which options", heads, lines)
    return Section("provenance", "Provenance", tables=[table], note=_NOTE)
