"""Edited models beside the ground truth of the edited scene: quality after an edit."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.reports import markup
from econgs_bench.reports.page.scenes import sheets
from econgs_bench.reports.pictures.panels import Panel, choose, in_view, models
from econgs_bench.reports.pictures.transfer import beside
from econgs_bench.reports.style import MISSING, label
from econgs_bench.reports.tables.edited import with_bases
from econgs_bench.reports.tables.protocols import conditions

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.charts.report import Report

PICTURE_BYTES = 2_000_000
"""Most bytes of pictures on the page; the files contain all of them."""
UNEDITED = "unedited"
_KEYS = ["dataset", "preset", "split"]


def section(report: Report, root: Path, charts: Path) -> str:
    """A table of quality by edit, and each scene's edits in one view; "" without edits.

    Args:
        report: the tables.
        root: folder that the paths of pictures are relative to.
        charts: folder for sequences as PDF and PNG.
    """
    results = report.results
    if not (results["kind"] == "edited").any():
        return ""
    parts = [
        "<p>PSNR [dB] against the ground truth of the edited scene, mean over scenes and seeds. A method "
        f"refuses an edit that it cannot make. “{UNEDITED}” is the PSNR of the same scenes "
        "before the edit.</p>"
    ]
    for name, heads, rows in quality(results):
        parts.append(markup.table(name, heads, ([escape(text) for text in row] for row in rows)))
    shown, omitted = sheets(sequences(report.tables, root), "edited", charts, report.models, PICTURE_BYTES)
    parts += shown
    if omitted:
        parts.append(f'<p class="note">Only the files contain the edits of {omitted} further scenes.</p>')
    return "\n".join(parts)


def quality(results: pd.DataFrame) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Caption, heads and rows of a table per dataset: PSNR of each method by edit.

    A mean needs all scenes and seeds. Otherwise the cell has the statuses of the runs.
    """
    for (dataset, *_), rows in _runs(results).groupby([*_KEYS, "joint"], dropna=False, sort=False):
        edits = [str(edit) for edit in rows["edit"].fillna("").unique() if edit]
        if not edits:
            continue
        scenes = set(rows.loc[rows["kind"] == "edited", "base"])
        rows = rows[rows["base"].isin(scenes)]
        lines = []
        for name, fits in rows.groupby(["method", "variant", "rate"], dropna=False, sort=False):
            if not (fits["kind"] == "edited").any():
                continue
            cells = [_mean(fits[fits["edit"].fillna("") == edit], scenes) for edit in ("", *edits)]
            lines.append([label(*name), *cells])
        caption = " \N{MIDDLE DOT} ".join([str(dataset), *conditions(rows.iloc[0], results)])
        yield caption, ["Method", UNEDITED, *edits], lines


def sequences(tables: dict[str, pd.DataFrame], root: Path) -> Iterator[tuple[str, list[Panel]]]:
    """Name of a scene, and panels of the scene and its edits in the median view of the unedited models."""
    results, views, scenes = tables["results"], tables["views"], tables.get("scenes")
    keys = [*_KEYS, "base"]
    for (dataset, *_, base), rows in _runs(results).groupby(keys, dropna=False, sort=False):
        edits = [str(edit) for edit in rows["edit"].fillna("").unique() if edit]
        if not edits:
            continue
        panels: list[Panel] = []
        view = ""
        for edit in ("", *edits):
            edited = models(rows[rows["edit"].fillna("") == edit])
            if edited.empty:
                continue
            view = view or choose(views[views["job"].isin(set(edited["job"].dropna()))]).get("median", "")
            panel = in_view(edited, views, root, view, edit or UNEDITED)
            if panel.window is not None:
                panels += beside([panel], scenes, edited.iloc[0])
        if panels:
            yield " \N{MIDDLE DOT} ".join([f"{dataset} / {base}", *conditions(rows.iloc[0], results)]), panels


def _runs(results: pd.DataFrame) -> pd.DataFrame:
    """The rows of scenes, compositions and edited ones; a column `base` has them without their edit."""
    return with_bases(results[results["kind"].isin(["basic", "composed", "edited"])])


def _mean(rows: pd.DataFrame, scenes: set[str]) -> str:
    failures = [str(status) for status in rows["status"] if status != "ok"]
    if failures:
        return ", ".join(dict.fromkeys(failures))
    if set(rows["base"]) != scenes or rows["psnr"].isna().any():
        return MISSING
    return f"{rows['psnr'].mean():.2f}"
