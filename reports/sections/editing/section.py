"""Edited models beside the ground truth of the edited scene: quality after an edit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.reports.pictures.panels import SceneView, choose, in_view, models
from econgs_bench.reports.pictures.transfer import beside
from econgs_bench.reports.sections.editing.table import with_bases
from econgs_bench.reports.sections.pictures.section import sheets
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING, label
from econgs_bench.reports.tables.protocols import conditions
from econgs_bench.reports.tables.table import Table

if TYPE_CHECKING:
    import pandas as pd


PICTURE_BYTES = 2_000_000
"""Most bytes of pictures on the page; the files contain all of them."""
UNEDITED = "unedited"
_WORDS = (
    "PSNR [dB] against the ground truth of the edited scene, mean over scenes and seeds. A method refuses an "
    f"edit that it cannot make. “{UNEDITED}” is the PSNR of the same scenes before the edit."
)
_KEYS = ["dataset", "preset", "split"]


def section(page: Page) -> Section | None:
    """A table of quality by edit, and each scene's edits in one view; None without edits."""
    report = page.report
    if page.folder is None or not (report.results["kind"] == "edited").any():
        return None
    tables = [Table(*each) for each in quality(report.results)]
    named = sequences(report.tables, page.root)
    shown, omitted = sheets(named, "edited", page.folder, report.models, PICTURE_BYTES)
    if omitted:
        shown.append(f'<p class="note">Only the files contain the edits of {omitted} further scenes.</p>')
    return Section("editing", "Editing", words=_WORDS, tables=tables, html="\n".join(shown))


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


def sequences(tables: dict[str, pd.DataFrame], root: Path) -> Iterator[tuple[str, list[SceneView]]]:
    """Name of a scene, and panels of the scene and its edits in the median view of the unedited models."""
    results, views, scenes = tables["results"], tables["views"], tables.get("scenes")
    keys = [*_KEYS, "base"]
    for (dataset, *_, base), rows in _runs(results).groupby(keys, dropna=False, sort=False):
        edits = [str(edit) for edit in rows["edit"].fillna("").unique() if edit]
        if not edits:
            continue
        panels: list[SceneView] = []
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
