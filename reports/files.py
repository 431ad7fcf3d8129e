"""The files beside the page: tables as CSV, Parquet, Markdown, LaTeX and JSON."""

from __future__ import annotations

import json
import os
import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.reports.comparability import listing, replaced
from econgs_bench.reports.sections.ladders import table as ladders
from econgs_bench.reports.sections.paper import datasets
from econgs_bench.reports.sections.paper import documents as paper_documents
from econgs_bench.reports.sections.rates import conclusion as rates
from econgs_bench.reports.sections.uncertainty.table import comparisons_of, intervals_of
from econgs_bench.reports.tables.documents import to_csv, to_latex, to_markdown
from econgs_bench.reports.text import short_name

if TYPE_CHECKING:
    from collections.abc import Sequence

    from econgs_bench.reports.report import Report
    from econgs_bench.reports.sections.paper.values import PaperTable


def write_files(report: Report, folder: Path, paper: Sequence[PaperTable]) -> None:
    """Write tables.

    Always: ``results.*`` (CSV, Parquet, Markdown, LaTeX), ``paper/`` (the paper's
    tables), ``curves/`` (JSON, one file per method and dataset). ``intervals.csv`` and ``comparisons.csv``
    need views, ``bd-rate.csv`` needs several rates, ``ladders.csv`` needs ladders,
    ``datasets.*`` needs costs of rendering, and ``differences.csv`` values that are not compared.

    Args:
        report: the tables.
        folder: folder of the files; it is created if it does not exist.
        paper: the paper's tables, from the same rows.
    """
    results, dvr = report.stored["results"], report.stored["dvr"]
    if not results.empty:
        folder.mkdir(parents=True, exist_ok=True)
        for table in paper:
            write_text(folder / "paper" / f"{table.name}.md", paper_documents.to_markdown(table))
            write_text(folder / "paper" / f"{table.name}.tex", paper_documents.to_latex(table))
        write_text(folder / "results.csv", to_csv(results))
        _replace(folder / "results.parquet", results.to_parquet(None, index=False))
        remark = replaced(report.stored.get("superseded"))
        write_text(folder / "results.md", to_markdown(report.measured, report.ranks, remark))
        write_text(folder / "results.tex", to_latex(report.measured, report.ranks, remark))
        _write_differences(report, folder)
        for name, statistics in (
            ("intervals", intervals_of(report)),
            ("comparisons", comparisons_of(report)),
        ):
            if not statistics.empty:
                write_text(folder / f"{name}.csv", to_csv(statistics))
        _write_rates(report, folder)
        rungs = ladders.of_report(report)
        if not rungs.empty:
            write_text(folder / "ladders.csv", to_csv(rungs))
    if not dvr.empty:
        costs = datasets.costs(dvr)
        write_text(folder / "datasets.csv", to_csv(dvr))
        write_text(folder / "datasets.md", to_markdown(costs))
        write_text(folder / "datasets.tex", to_latex(costs))


def _write_differences(report: Report, folder: Path) -> None:
    """What is not compared, a line each; no file where everything is."""
    table = listing(report.stored["results"], report.stored.get("superseded"))
    if table.empty:
        (folder / "differences.csv").unlink(missing_ok=True)
    else:
        write_text(folder / "differences.csv", to_csv(table))


def _write_rates(report: Report, folder: Path) -> None:
    import pandas as pd

    for dataset, rows in report.curves.items():
        for curve in rows:
            path = folder / "curves" / file_name(dataset) / f"{file_name(curve.title)}.json"
            write_text(path, json.dumps(curve.exchange(), indent=1) + "\n")
    if differences := rates.of_report(report):
        table = pd.DataFrame([asdict(difference) for difference in differences])
        table = table.drop(columns="scenes")
        table["warnings"] = ["; ".join(warnings) for warnings in table["warnings"]]
        for name in ("psnr_range", "bytes_range", "rate_interval", "psnr_interval"):
            table[name] = [f"{ends[0]:.7g} to {ends[1]:.7g}" if ends else "" for ends in table[name]]
        write_text(folder / "bd-rate.csv", to_csv(table))


def file_name(title: str) -> str:
    """A title as a file name that is valid on every system."""
    return short_name(re.sub(r"[^A-Za-z0-9._=+-]+", "-", title).strip("-.") or "unnamed")


def write_text(path: Path, text: str) -> None:
    """Write a file; readers get the old content or the whole new one."""
    _replace(path, text.encode("utf-8"))


def _replace(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        aside.write_bytes(content)
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)
