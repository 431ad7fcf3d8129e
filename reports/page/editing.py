"""Edited models beside the ground truth of the edited scene: what of the quality survives an edit."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from reports.page import markup
from reports.page.scenes import figure
from reports.pictures import panel_files as panel_figures
from reports.pictures.panels import Panel, choose, in_view, models
from reports.pictures.transfer import beside
from reports.style import MISSING, label, series

if TYPE_CHECKING:
    import pandas as pd

PICTURE_BYTES = 2_000_000
"""Room for pictures on the page; what is over stands in the files alone."""
UNEDITED = "unedited"
_KEYS = ["dataset", "preset", "split"]


def section(tables: dict[str, pd.DataFrame], root: Path, charts: Path | None) -> str:
    """A table of quality by edit, and each scene's edits in one view; "" where nothing was edited.

    Args:
        tables: results and views as documented.
        root: the folder that picture paths are relative to.
        charts: where the sequences are also written as PDF and PNG; None for nowhere.
    """
    results = tables["results"]
    if "edit" not in results or not (results["kind"] == "edited").any():
        return ""
    names = series(results)
    parts = [
        "<p>PSNR [dB], mean over scenes and seeds, against the edited scene's ground truth. An edit that "
        f"a method cannot make it refuses. “{UNEDITED}” are the same scenes as they were learned.</p>"
    ]
    for name, heads, rows in quality(results):
        parts.append(markup.table(name, heads, ([escape(text) for text in row] for row in rows)))
    room, left_out = PICTURE_BYTES, 0
    for name, made in sequences(tables, root):
        files = ""
        if charts is not None:
            short = panel_figures.write(made, f"{name} edited", charts)
            files = f' <span class="soft">(<a href="charts/{short}.pdf">PDF</a>)</span>'
        figures = [figure(panel, f"{name}, {panel.caption}", names) for panel in made]
        if sum(map(len, figures)) > room:
            left_out += 1
            continue
        room -= sum(map(len, figures))
        html = "".join(figures)
        parts.append(f'<section class="scene"><h3>{escape(name)}{files}</h3><div class="panels">{html}</div>')
        parts.append("</section>")
    if left_out:
        parts.append(f'<p class="note">The edits of {left_out} scenes are in the files alone.</p>')
    return "\n".join(parts)


def quality(results: pd.DataFrame) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Caption, heads and rows of a table per dataset: PSNR of each method by edit.

    A mean is told only if every scene and seed was measured; else what happened is.
    """
    touched = results[results["kind"].isin(["basic", "edited"])]
    for keys, rows in touched.groupby(_KEYS, dropna=False, sort=False):
        edits = [str(edit) for edit in rows["edit"].fillna("").unique() if edit]
        if not edits:
            continue
        scenes_edited = {_base(row) for row in rows[rows["kind"] == "edited"].itertuples()}
        lines = []
        for name, fits in rows.groupby(["method", "variant", "rate"], dropna=False, sort=False):
            if not (fits["kind"] == "edited").any():
                continue
            cells = [_mean(fits[fits["edit"].fillna("") == edit], scenes_edited) for edit in ("", *edits)]
            lines.append([label(*name), *cells])
        told = [str(keys[0])]
        told += [str(key) for key, axis in zip(keys[1:], _KEYS[1:], strict=True) if _several(results, axis)]
        yield " \N{MIDDLE DOT} ".join(told), ["Method", UNEDITED, *edits], lines


def sequences(tables: dict[str, pd.DataFrame], root: Path) -> Iterator[tuple[str, list[Panel]]]:
    """Name of a scene -> it and its edits in one view, the median one of the unedited models."""
    results, views, scenes = tables["results"], tables["views"], tables.get("scenes")
    touched = results[results["kind"].isin(["basic", "edited"])]
    touched = touched.assign(base=[_base(row) for row in touched.itertuples()])
    keys = [*_KEYS, "base"]
    for (dataset, preset, split, base), rows in touched.groupby(keys, dropna=False, sort=False):
        edits = [str(edit) for edit in rows["edit"].fillna("").unique() if edit]
        if not edits:
            continue
        told = [str(v) for v, axis in ((preset, "preset"), (split, "split")) if _several(results, axis)]
        made: list[Panel] = []
        view = ""
        for edit in ("", *edits):
            shown = models(rows[rows["edit"].fillna("") == edit])
            if shown.empty:
                continue
            view = view or choose(views[views["job"].isin(set(shown["job"].dropna()))]).get("median", "")
            panel = in_view(shown, views, root, view, edit or UNEDITED)
            if panel.window is not None:
                made += beside([panel], scenes, shown.iloc[0])
        if made:
            yield " \N{MIDDLE DOT} ".join([f"{dataset} / {base}", *told]), made


def _base(row: object) -> str:
    """The scene that a row's edit was made of."""
    scene, edit = str(row.scene), str(row.edit or "")  # type: ignore[attr-defined]
    return scene.removesuffix(f" {edit}") if edit else scene


def _several(results: pd.DataFrame, axis: str) -> bool:
    return bool(results[axis].nunique(dropna=False) > 1)


def _mean(rows: pd.DataFrame, wanted: set[str]) -> str:
    rows = rows.assign(base=[_base(row) for row in rows.itertuples()])
    rows = rows[rows["base"].isin(wanted)]
    bad = [str(status) for status in rows["status"] if status != "ok"]
    if bad:
        return ", ".join(dict.fromkeys(bad))
    if set(rows["base"]) != wanted or rows["psnr"].isna().any():
        return MISSING
    return f"{rows['psnr'].mean():.2f}"
