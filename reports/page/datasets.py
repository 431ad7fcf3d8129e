"""The page's section on the cost of rendering volumes."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from econgs_bench.reports.paper.datasets import PUBLISHED, costs
from econgs_bench.reports.schema import by_name
from econgs_bench.reports.tables.columns import cell

if TYPE_CHECKING:
    import pandas as pd


def section(dvr: pd.DataFrame) -> str:
    """A table by dataset with the published values, and one by scene."""
    table = costs(dvr)
    if table["gpu_gib"].isna().all():
        table = table.drop(columns="gpu_gib")
    lines = []
    for _, row in table.iterrows():
        of_paper = str(row["dataset"]).endswith(f"({PUBLISHED})")
        lines.append(f'<tr class="{"soft" if of_paper else "mean"}">{_cells(row, list(table.columns))}</tr>')
    return (
        "<p>A representation replaces direct volume rendering. These are its costs, one view at a time on "
        "the test path. Times are means over the basic scenes; memory is the maximum of the whole process "
        "that renders. Published values follow the same dataset, or the one that imitates it; "
        "their renderer and machine differ.</p>"
        f"{_table('Cost of rendering each volume', list(table.columns), ''.join(lines))}"
        f"{_scenes(dvr)}"
        '<p class="note">Files: <a href="datasets.csv">CSV</a>, <a href="datasets.md">Markdown</a>, '
        '<a href="datasets.tex">LaTeX</a>.</p>'
    )


def _scenes(dvr: pd.DataFrame) -> str:
    names = ["dataset", "scene", "kind", "ms_per_view", "ms_p05", "ms_p95", "fps", "setup_seconds"]
    names += ["peak_host_bytes", "peak_device_bytes", "status", "reason"]
    names = [n for n in names if n != "peak_device_bytes" or dvr[n].notna().any()]
    if (dvr["status"] == "ok").all():
        names = names[:-2]
    lines = "".join(f"<tr>{_cells(row, names)}</tr>" for _, row in dvr.iterrows())
    table = _table("Cost of rendering each scene", names, lines)
    return f"<details><summary>{len(dvr)} scenes</summary>{table}</details>"


def _cells(row: pd.Series, names: list[str]) -> str:
    first, *others = names
    cells = "".join(f"<td{_align(n)}>{escape(cell(n, row[n]))}</td>" for n in others)
    return f'<th scope="row">{escape(cell(first, row[first]))}</th>{cells}'


def _table(caption: str, names: list[str], lines: str) -> str:
    head = "".join(f'<th scope="col"{_align(n)}>{escape(by_name(n).header)}</th>' for n in names)
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{caption}"><table>'
        f"<caption>{caption}</caption><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table></div>"
    )


def _align(name: str) -> str:
    return ' class="r"' if by_name(name).numeric else ""
