"""The page's pictures: panels of each scene, and a dialog that compares two pictures of a view."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.reports import markup
from econgs_bench.reports.pictures import panel_files
from econgs_bench.reports.pictures.difference import DELTA_E_MAX, scale
from econgs_bench.reports.pictures.files import pictures, uri
from econgs_bench.reports.pictures.panels import RULE, WHICH, SceneView, Shot, models, panels
from econgs_bench.reports.pictures.transfer import beside
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import Model, row_label
from econgs_bench.reports.tables.columns import cell
from econgs_bench.reports.tables.protocols import conditions

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from econgs_bench.reports.report import Report

PICTURE_BYTES = 4_300_000
"""Most bytes of pictures on the page."""
TRUTH = "Ground truth"
_MOST_OPEN = 4
"""Scenes whose panels are unfolded; of more, each dataset's are folded."""


def section(page: Page) -> Section | None:
    """Panels of all scenes with pictures, and notes on missing ones; None without either."""
    html = "" if page.folder is None else _scenes(page.report, page.root, page.folder)
    return Section("scenes", "Pictures", html=html) if html else None


def _scenes(report: Report, root: Path, charts: Path) -> str:
    """The same as HTML; if pictures exceed :data:`PICTURE_BYTES`, median views have priority over worst ones.

    Args:
        report: the tables.
        root: folder that the paths of pictures are relative to.
        charts: folder for panels as PDF and PNG.
    """
    tables = report.tables
    results = report.results[report.results["kind"] != "edited"]
    keys = ["dataset", "scene", "preset", "split"]
    blocks: list[tuple[str, str, dict[str, str]]] = []
    without = 0
    views_of = dict(list(tables["views"].groupby(keys, dropna=False, sort=False)))
    for scene, rows in results.groupby(keys, dropna=False, sort=False):
        views = views_of.get(scene, tables["views"][:0])
        if not pictures(views, root):
            without += bool(len(views))
            continue
        rows = models(rows)
        first = rows.iloc[0]
        name = " · ".join([f"{first['dataset']} / {first['scene']}", *conditions(first, results)])
        of_scene = beside(panels(rows, views, root), tables.get("scenes"), first)
        informative = [panel for panel in of_scene if panel.informative]
        if not informative:
            without += bool(of_scene)
            continue
        remark = "composed" if first["kind"] == "composed" else ""
        figures = {panel.which: figure(panel, name, report.models) for panel in informative}
        head = heading(informative, name, name, charts, remark)
        blocks.append((str(first["dataset"]), head, figures))
    selection, omitted = _within(PICTURE_BYTES, [figures for _, _, figures in blocks])
    parts = [INLINE, _legend()] if blocks else []
    of_datasets: dict[str, list[str]] = {}
    for (dataset, head, _), figures_of_scene in zip(blocks, selection, strict=True):
        of_datasets.setdefault(dataset, []).append(block(head, figures_of_scene))
    for dataset, scenes in of_datasets.items():
        html = "\n".join(scenes)
        if len(blocks) > _MOST_OPEN:
            count = "1 scene" if len(scenes) == 1 else f"{len(scenes)} scenes"
            title = f"All pictures of {escape(dataset)} ({count})"
            html = f'<details class="pictures"><summary>{title}</summary>{html}</details>'
        parts.append(html)
    if omitted:
        parts.append(
            f'<p class="note">This page omits {omitted} panels to stay small; '
            "the PDFs of their scenes contain them.</p>"
        )
    if without:
        subject = "1 scene" if without == 1 else f"{without} scenes"
        parts.append(
            f'<p class="note">This store has no pictures of {subject if blocks else "the scenes"}: bundles '
            "contain numbers only.</p>"
        )
    return "\n".join(parts)


def heading(panels: list[SceneView], title: str, name: str, charts: Path, remark: str = "") -> str:
    """Title of a scene with a link to its panels as files, which are written under ``name``."""
    html = escape(title) + (f' <span class="soft">{remark}</span>' if remark else "")
    if any(panel.window for panel in panels):
        short = panel_files.write(panels, name, charts)
        html += f' <span class="soft">(<a href="charts/{short}.pdf">PDF</a>)</span>'
    return html


def block(head: str, figures: Iterable[str]) -> str:
    """A scene with its views."""
    return f'<section class="scene"><h3>{head}</h3><div class="panels">{"".join(figures)}</div></section>'


def sheets(
    sequences: Iterable[tuple[str, list[SceneView]]], about: str, charts: Path, models: list[Model], room: int
) -> tuple[list[str], int]:
    """Scenes with their panels as HTML, and how many have no room on the page; the files contain all.

    Args:
        sequences: name of a scene, and its panels.
        about: what the panels are of; follows the scene in the names of files.
        charts: folder for the panels as PDF and PNG.
        models: all of the report.
        room: most bytes of all figures.
    """
    blocks, omitted = [], 0
    for name, views in sequences:
        head = heading(views, name, f"{name} {about}", charts)
        figures = [figure(panel, f"{name}, {panel.caption}", models) for panel in views]
        if sum(map(len, figures)) > room:
            omitted += 1
            continue
        room -= sum(map(len, figures))
        blocks.append(block(head, figures))
    return blocks, omitted


def _within(room: int, scenes: list[dict[str, str]]) -> tuple[list[list[str]], int]:
    """The figures of each scene that fit into ``room`` bytes, and the number of those that do not."""
    selection: list[list[str]] = [[] for _ in scenes]
    omitted = 0
    for which in WHICH:
        for figures, fitting in zip(scenes, selection, strict=True):
            if which not in figures:
                continue
            if len(figures[which]) > room:
                omitted += 1
                continue
            room -= len(figures[which])
            fitting.append(figures[which])
    return selection, omitted


def figure(panel: SceneView, scene: str, models: list[Model]) -> str:
    """A view as HTML; ``models`` are all of the report."""
    where = f"{scene}, view {panel.view}"
    cells = []
    if panel.truth is not None:
        zoom = (
            f"<div>{_image(panel.zoom(panel.truth), f'{where}: {TRUTH}, enlarged')}</div>"
            if panel.window
            else ""
        )
        cells.append(
            f'<div class="shot truth"><p>{TRUTH}</p>{_picture(panel, panel.truth, where, TRUTH)}'
            f'<div class="pair">{zoom}{_transfer(panel, where)}</div></div>'
        )
    cells += [_shot(panel, shot, where, models) for shot in panel.shots]
    compare = '<button type="button" class="compare" hidden>Compare</button>' if panel.window else ""
    caption = f"{escape(panel.title)} <span class=soft>{escape(panel.view)}</span>"
    return (
        f'<figure class="card panel" data-view="{escape(where)}"><figcaption>{caption} {compare}</figcaption>'
        f'<div class="shots" style="--n:{len(cells)}">{"".join(cells)}</div></figure>'
    )


def _transfer(panel: SceneView, where: str) -> str:
    if panel.transfer is None:
        return ""
    return f'<div class="tf">{_image(panel.transfer, f"{where}: transfer function")}</div>'


def _shot(panel: SceneView, shot: Shot, where: str, models: list[Model]) -> str:
    name = f"<p>{markup.method(shot.row, models)}</p>"
    if shot.picture is None or shot.difference is None:
        state = "" if shot.row["status"] == "ok" else markup.status(shot.row)
        return f'<div class="shot">{name}<p class="note">{state} {escape(shot.problem)}</p></div>'
    model = row_label(shot.row)
    zoom = _image(panel.zoom(shot.picture), f"{where}: {model}, enlarged")
    difference = _picture(panel, shot.difference, where, f"ΔE*uv of {model}")
    values = (
        f"<span><b>{cell('psnr', shot.psnr)}</b> dB ·</span> <span>SSIM {cell('ssim', shot.ssim)} ·</span> "
        f"<span>ΔE {cell('delta_e_uv', shot.delta_e)}</span>"
    )
    if shot.cost:
        values += f" <span>· {escape(shot.cost)}</span>"
    return (
        f'<div class="shot">{name}{_picture(panel, shot.picture, where, model)}'
        f'<div class="pair"><div>{zoom}</div>{difference}</div><p class="values">{values}</p></div>'
    )


def _picture(panel: SceneView, pixels: NDArray[np.uint8], where: str, name: str) -> str:
    """A picture for comparison, with the box of the zoom window."""
    box = ""
    if panel.window is not None:
        height, width = pixels.shape[:2]
        top, left, side = panel.window
        place = (100 * left / width, 100 * top / height, 100 * side / width, 100 * side / height)
        box = (
            '<span class="box" style="left:{:.2f}%;top:{:.2f}%;width:{:.2f}%;height:{:.2f}%"></span>'.format(
                *place
            )
        )
    return f'<div class="pic">{_image(pixels, f"{where}: {name}", name)}{box}</div>'


def _image(pixels: NDArray[np.uint8], alt: str, name: str = "") -> str:
    height, width = pixels.shape[:2]
    data = f' data-as="{escape(name)}"' if name else ""
    size = f'width="{width}" height="{height}"'
    return f'<img src="{uri(pixels)}" alt="{escape(alt)}" {size}{data} decoding="async">'


def _legend() -> str:
    stops = ", ".join("rgb({},{},{})".format(*scale()[i]) for i in range(0, 256, 15))
    return (
        f"<p>{RULE}</p>"
        '<div class="scalebar"><span>Difference: CIELUV ΔE*<sub>uv</sub>&nbsp; 0</span><span class="bar" '
        f'style="background:linear-gradient(to right,{stops})"></span>'
        f"<span>{DELTA_E_MAX:.0f} and more; about 1 is just noticeable. All pictures share the scale."
        "</span></div>"
    )


_CONTROLS = """<div class="controls">
<label>Left <select data-side="a"></select></label><label>Right <select data-side="b"></select></label>
<label>As <select data-mode><option value="slider">slider</option><option value="flip">flip</option>
<option value="beside">side by side</option></select></label>
<label data-slider>Divider <input type="range" min="0" max="100" value="50"></label>
<button type="button" data-do="flip" aria-keyshortcuts="f">Flip (F)</button>
<button type="button" data-do="truth" aria-keyshortcuts="g" aria-pressed="false">Ground truth (G)</button>
<button type="button" data-do="previous" aria-keyshortcuts="p">Previous view (P)</button>
<button type="button" data-do="next" aria-keyshortcuts="n">Next view (N)</button>
</div>
<div class="stage"><img data-side="a" alt="Left picture"><img data-side="b" alt="Right picture">
<span class="divider"></span></div>
<p role="status"></p>"""
INLINE = f"""<div class="comparison" hidden><h3></h3>
{_CONTROLS}
</div>"""
"""Two pictures of a view on each other; the page's script fills and shows it."""
COMPARE = f"""<dialog id="compare" class="comparison" aria-labelledby="compare-title">
<div class="bar"><h3 id="compare-title">Compare</h3><button type="button" data-do="close">Close</button></div>
{_CONTROLS}
</dialog>"""
"""The same as a dialog, which a panel opens."""
