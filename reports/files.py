"""The files beside the page: charts for papers, and the tables in formats to take away."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from reports import charts, datasets, paper_tables
from reports.tables import to_csv, to_latex, to_markdown

if TYPE_CHECKING:
    import pandas as pd


def write_files(tables: dict[str, pd.DataFrame], folder: Path) -> None:
    """Write ``charts/`` (PDF and PNG), ``results.*`` and ``paper/`` (its tables); ``datasets.*`` where
    rendering volumes was measured.

    Args:
        tables: results, views, curve, ledger, timing, features and dvr as documented in docs/architecture.md.
        folder: where to; made if it is missing.
    """
    results, dvr = tables["results"], tables["dvr"]
    if not results.empty:
        folder.mkdir(parents=True, exist_ok=True)
        charts.write(tables, folder / "charts")
        for table in paper_tables.paper_tables(results, tables["views"], tables["timing"]):
            write_text(folder / "paper" / f"{table.name}.md", paper_tables.to_markdown(table))
            write_text(folder / "paper" / f"{table.name}.tex", paper_tables.to_latex(table))
        write_text(folder / "results.csv", to_csv(results))
        write_text(folder / "results.md", to_markdown(results, tables["views"]))
        write_text(folder / "results.tex", to_latex(results, tables["views"]))
    if not dvr.empty:
        costs = datasets.costs(dvr)
        write_text(folder / "datasets.csv", to_csv(dvr))
        write_text(folder / "datasets.md", to_markdown(costs))
        write_text(folder / "datasets.tex", to_latex(costs))


def write_text(path: Path, text: str) -> None:
    """A file is whole or as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    aside.write_text(text, encoding="utf-8")
    os.replace(aside, path)
