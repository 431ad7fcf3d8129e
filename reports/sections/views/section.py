"""Pictures of models by their number of training views: one view of a scene, a row per number."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.reports.pictures.panels import SceneView, choose, in_view, models
from econgs_bench.reports.pictures.transfer import beside
from econgs_bench.reports.sections.pictures.section import sheets
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.tables.protocols import conditions

if TYPE_CHECKING:
    import pandas as pd


PICTURE_BYTES = 2_000_000
"""Most bytes of pictures on the page; the files contain all of them."""


def section(page: Page) -> Section | None:
    """Each scene that was trained from several numbers of views, as pictures; None without any."""
    if page.folder is None:
        return None
    named = grids(page.report.stored, page.root)
    parts, omitted = sheets(named, "by training views", page.folder, page.report.models, PICTURE_BYTES)
    if omitted:
        parts.append(f'<p class="note">Only the files contain the pictures of {omitted} further scenes.</p>')
    words = "All pictures of a scene are of one test view, the median of all its models."
    return (
        Section("views", "Numbers of training views", words=words, html="\n".join(parts)) if parts else None
    )


def grids(tables: dict[str, pd.DataFrame], root: Path) -> Iterator[tuple[str, list[SceneView]]]:
    """Name of a scene, and a panel per number of training views, the fewest first, all of one test view.

    Args:
        tables: as stored, where a dataset has one name whatever the number of views.
        root: folder that the paths of pictures are relative to.
    """
    results, views = tables["results"], tables["views"]
    results = results[results["kind"] != "edited"]
    keys = ["dataset", "scene", "preset", "split"]
    for (dataset, scene, *_), rows in results.groupby(keys, dropna=False, sort=False):
        numbers = sorted(int(number) for number in rows["requested_views"].dropna().unique())
        if len(numbers) < 2:
            continue
        view = choose(views[views["job"].isin(set(rows["job"].dropna()))]).get("median", "")
        panels: list[SceneView] = []
        for number in numbers:
            trained = models(rows[rows["requested_views"] == number])
            panel = in_view(trained, views, root, view, f"{number} training views")
            if panel.window is not None:
                panels += beside([panel], tables.get("scenes"), trained.iloc[0])
        if len(panels) > 1:
            name = " \N{MIDDLE DOT} ".join([f"{dataset} / {scene}", *conditions(rows.iloc[0], results)])
            yield name, panels
