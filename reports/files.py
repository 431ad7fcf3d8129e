"""The files beside the page: tables as CSV, Parquet, Markdown, LaTeX and JSON."""

from __future__ import annotations

import json
import os
import re
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from reports.charts import rate_distortion
from reports.paper import datasets
from reports.paper import documents as paper_documents
from reports.tables import confidence
from reports.tables.documents import to_csv, to_latex, to_markdown
from reports.tables.protocols import by_protocol
from reports.tables.results import superseded_note

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from reports.paper.values import PaperTable
    from reports.statistics import Views


def write_files(
    tables: dict[str, pd.DataFrame],
    folder: Path,
    paper: Sequence[PaperTable],
    views: Views,
) -> None:
    """Write tables.

    Always: ``results.*`` (CSV, Parquet, Markdown, LaTeX), ``paper/`` (the paper's
    tables), ``curves/`` (JSON, one file per method and dataset). ``intervals.csv`` and ``comparisons.csv``
    need views, ``bd-rate.csv`` needs several rates, and ``datasets.*`` needs costs of rendering.

    Args:
        tables: the tables of :mod:`reports.schema`.
        folder: folder of the files; it is created if it does not exist.
        paper: the paper's tables, from the same rows.
        views: ``tables["views"]``.
    """
    results, dvr = tables["results"], tables["dvr"]
    if not results.empty:
        folder.mkdir(parents=True, exist_ok=True)
        for table in paper:
            write_text(folder / "paper" / f"{table.name}.md", paper_documents.to_markdown(table))
            write_text(folder / "paper" / f"{table.name}.tex", paper_documents.to_latex(table))
        write_text(folder / "results.csv", to_csv(results))
        _replace(folder / "results.parquet", results.to_parquet(None, index=False))
        remark = superseded_note(tables.get("superseded"))
        results = by_protocol({"results": results})["results"]
        write_text(folder / "results.md", to_markdown(results, views, remark))
        write_text(folder / "results.tex", to_latex(results, views, remark))
        for name, make in (("intervals", confidence.intervals), ("comparisons", confidence.comparisons)):
            statistics = make(results, views)
            if not statistics.empty:
                write_text(folder / f"{name}.csv", to_csv(statistics))
        _write_rates(results, folder)
    if not dvr.empty:
        costs = datasets.costs(dvr)
        write_text(folder / "datasets.csv", to_csv(dvr))
        write_text(folder / "datasets.md", to_markdown(costs))
        write_text(folder / "datasets.tex", to_latex(costs))


def _write_rates(results: pd.DataFrame, folder: Path) -> None:
    import pandas as pd

    curves = rate_distortion.curves(results)
    for dataset, rows in curves.items():
        for curve in rows:
            path = folder / "curves" / _file_name(dataset) / f"{_file_name(curve.title)}.json"
            write_text(path, json.dumps(curve.exchange(), indent=1) + "\n")
    differences = rate_distortion.differences(curves)
    if differences:
        table = pd.DataFrame([asdict(difference) for difference in differences])
        table["warnings"] = ["; ".join(warnings) for warnings in table["warnings"]]
        for name in ("psnr_range", "bytes_range"):
            table[name] = [f"{ends[0]:.7g} to {ends[1]:.7g}" if ends else "" for ends in table[name]]
        write_text(folder / "bd-rate.csv", to_csv(table))


def _file_name(title: str) -> str:
    """A title as a file name that is valid on every system."""
    return re.sub(r"[^A-Za-z0-9._=+-]+", "-", title).strip("-.") or "unnamed"


def write_text(path: Path, text: str) -> None:
    """Write a file; readers get the old content or the whole new one."""
    _replace(path, text.encode("utf-8"))


def _replace(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    aside.write_bytes(content)
    os.replace(aside, path)
