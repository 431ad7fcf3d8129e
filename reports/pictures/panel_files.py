"""Panels as files for papers: PDF and PNG, one per scene."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.pictures.difference import DELTA_E_MAX, scale
from econgs_bench.reports.pictures.panels import SceneView, Shot
from econgs_bench.reports.pictures.sheet import Sheet, line_height, save
from econgs_bench.reports.style import row_label
from econgs_bench.reports.tables.columns import cell
from econgs_bench.reports.text import short_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_CELL = 1.5  # inches, width of a picture
_GAP = 0.06
_TEXT = 0.17  # inches; height of a line
_HALF = (_CELL - _GAP) / 2
_LETTERS = 29  # letters of a line below a picture
_BOLD = 24  # letters of a line above a picture
_FRAME = "#d6006c"  # between white lines, visible on light and on dark pictures


def write(panels: list[SceneView], scene: str, folder: Path) -> str:
    """Write the panels of a scene, one row of pictures per view.

    Args:
        panels: panels, at least one of them with pictures.
        scene: name of the scene.
        folder: folder of the files; it is created if it does not exist.

    Returns:
        Name of the files without suffix: "panel-<dataset>-<scene>".
    """
    name = short_name("panel-" + re.sub(r"[^\w.@=+-]+", "-", scene))
    save(draw([panel for panel in panels if panel.window is not None], scene), folder, name, dpi=200)
    return name


def draw(panels: list[SceneView], scene: str) -> Sheet:
    """A row per view with ground truth and all models: the picture, and below it zoom and difference."""
    columns = 1 + max(len(panel.shots) for panel in panels)
    heights = [_above(panel) + _CELL * _aspect(panel) + _GAP + _HALF + 2 * _TEXT for panel in panels]
    size = (columns * (_CELL + _GAP) + _GAP, sum(heights) + 2.4 * _TEXT)
    sheet = Sheet(*size)
    top = _GAP
    for panel, height in zip(panels, heights, strict=True):
        _row(sheet, panel, top)
        top += height
    _show(sheet, scale()[None], _GAP, top + 0.06, _CELL, 0.09)
    text = f"ΔE*uv to the ground truth, 0 to {DELTA_E_MAX:.0f}"
    sheet.caption(2 * _GAP + _CELL, top + 0.03, text if columns > 2 else f"ΔE*uv 0 to {DELTA_E_MAX:.0f}")
    sheet.caption(_GAP, top + 0.03 + _TEXT, scene, color="#555555")
    return sheet


def _row(sheet: Sheet, panel: SceneView, top: float) -> None:
    """One view: all pictures side by side."""
    aspect, bottom = _aspect(panel), top + _above(panel)
    below = bottom + _CELL * aspect + _GAP
    words = f"{panel.title[:1].lower()}{panel.title[1:]}, {panel.view}"
    words = textwrap.fill(words, _LETTERS)
    shots: list[tuple[str, Any, Any, str]] = [("Ground truth", panel.truth, None, words)]
    for shot in panel.shots:
        values = f"{cell('psnr', shot.psnr)} dB, ΔE {cell('delta_e_uv', shot.delta_e)}"
        if shot.picture is None:
            values = str(shot.row["status"]) if shot.row["status"] != "ok" else "no picture"
        values += f"\n{shot.cost}" if shot.cost else ""
        shots.append((_name(shot), shot.picture, shot.difference, values))
    for column, (name, picture, difference, values) in enumerate(shots):
        left = _GAP + column * (_CELL + _GAP)
        above = bottom - 0.03 - (name.count("\n") + 1) * line_height()
        sheet.caption(left, above, name, bold=True)
        sheet.caption(left, below + _HALF + 0.03, values)
        if picture is None:
            continue
        _show(sheet, picture, left, bottom, _CELL, _CELL * aspect, panel.window)
        _show(sheet, panel.zoom(picture), left, below, _HALF, _HALF)
        sheet.frame(left, below, _HALF, _HALF, _FRAME, 1.0)
        if column == 0 and panel.transfer is not None:
            _show(sheet, panel.transfer, left + _HALF + _GAP, below, _HALF, _HALF)
        if difference is not None:
            wide = min(_HALF, _HALF / aspect)
            _show(sheet, difference, left + _HALF + _GAP, below, wide, wide * aspect, panel.window)


def _show(
    sheet: Sheet,
    picture: NDArray[np.uint8],
    left: float,
    top: float,
    width: float,
    height: float,
    window: tuple[int, int, int] | None = None,
) -> None:
    """A picture in a thin frame, with the box of the zoom window."""
    sheet.picture(picture, left, top, width, height)
    sheet.frame(left, top, width, height, "#000000", 0.4)
    if window is not None:
        rows, columns = picture.shape[:2]
        at, side = (left + width * window[1] / columns, top + height * window[0] / rows), window[2]
        for color, line in (("#ffffff", 1.8), (_FRAME, 1.0)):
            sheet.frame(*at, width * side / columns, height * side / rows, color, line)


def _name(shot: Shot) -> str:
    """Method, variant and rate, in lines that fit above a picture."""
    return textwrap.fill(row_label(shot.row), _BOLD)


def _above(panel: SceneView) -> float:
    """Height of the longest name above the pictures, in inches."""
    return _TEXT * 0.75 * (max([1, *(_name(shot).count("\n") + 1 for shot in panel.shots)]) + 1 / 3)


def _aspect(panel: SceneView) -> float:
    """Height of the pictures over their width."""
    assert panel.truth is not None
    height, width = panel.truth.shape[:2]
    return float(height / width)
