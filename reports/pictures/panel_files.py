"""Panels as files for papers: PDF and PNG, one per scene."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.reports.pictures.difference import DELTA_E_MAX, scale
from econgs_bench.reports.pictures.panels import Panel, Shot
from econgs_bench.reports.style import row_label
from econgs_bench.reports.tables.columns import cell
from econgs_bench.reports.text import printable, short_name

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

_CELL = 1.5  # inches, width of a picture
_GAP = 0.06
_TEXT = 0.17  # inches; height of a line
_HALF = (_CELL - _GAP) / 2
_LETTERS = 29  # letters of a line below a picture
_BOLD = 24  # letters of a line above a picture
_FRAME = "#d6006c"  # between white lines, visible on light and on dark pictures


def write(panels: list[Panel], scene: str, folder: Path) -> str:
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


def save(figure: Figure, folder: Path, name: str, dpi: int) -> None:
    """Write a figure as PDF, the same bytes each time, and as PNG; the folder is created if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.pdf", metadata={"CreationDate": None})
    figure.savefig(folder / f"{name}.png", dpi=dpi)


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure with one set of axes for all pictures, in inches from the upper left corner.

    Hundreds of axes take seconds.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    figure.suppressComposite = True  # the PDF keeps the pixels of every picture
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set(xlim=(0.0, width), ylim=(height, 0.0), autoscale_on=False)
    return figure, axes


def draw(panels: list[Panel], scene: str) -> Figure:
    """A row per view with ground truth and all models: the picture, and below it zoom and difference."""
    columns = 1 + max(len(panel.shots) for panel in panels)
    heights = [_above(panel) + _CELL * _aspect(panel) + _GAP + _HALF + 2 * _TEXT for panel in panels]
    size = (columns * (_CELL + _GAP) + _GAP, sum(heights) + 2.4 * _TEXT)
    figure, axes = canvas(*size)
    top = _GAP
    for panel, height in zip(panels, heights, strict=True):
        _row(axes, panel, top)
        top += height
    _show(axes, scale()[None], _GAP, top + 0.06, _CELL, 0.09)
    text = f"ΔE*uv to the ground truth, 0 to {DELTA_E_MAX:.0f}"
    caption(axes, 2 * _GAP + _CELL, top + 0.03, text if columns > 2 else f"ΔE*uv 0 to {DELTA_E_MAX:.0f}")
    caption(axes, _GAP, top + 0.03 + _TEXT, scene, color="#555555")
    return figure


def _row(axes: Axes, panel: Panel, top: float) -> None:
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
        caption(axes, left, bottom - 0.03, name, weight="bold", va="bottom")
        caption(axes, left, below + _HALF + 0.03, values)
        if picture is None:
            continue
        _show(axes, picture, left, bottom, _CELL, _CELL * aspect, panel.window)
        _show(axes, panel.zoom(picture), left, below, _HALF, _HALF)
        _frame(axes, left, below, _HALF, _HALF, _FRAME, 1.0)
        if column == 0 and panel.transfer is not None:
            _show(axes, panel.transfer, left + _HALF + _GAP, below, _HALF, _HALF)
        if difference is not None:
            wide = min(_HALF, _HALF / aspect)
            _show(axes, difference, left + _HALF + _GAP, below, wide, wide * aspect, panel.window)


def _show(
    axes: Axes,
    picture: NDArray[np.uint8],
    left: float,
    top: float,
    width: float,
    height: float,
    window: tuple[int, int, int] | None = None,
) -> None:
    """A picture in a thin frame, with the box of the zoom window."""
    place = (left, left + width, top + height, top)
    axes.imshow(picture, extent=place, aspect="auto", interpolation="nearest")
    _frame(axes, left, top, width, height, "#000000", 0.4)
    if window is not None:
        rows, columns = picture.shape[:2]
        at, side = (left + width * window[1] / columns, top + height * window[0] / rows), window[2]
        for color, line in (("#ffffff", 1.8), (_FRAME, 1.0)):
            _frame(axes, *at, width * side / columns, height * side / rows, color, line)


def _frame(axes: Axes, left: float, top: float, width: float, height: float, color: str, line: float) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(Rectangle((left, top), width, height, fill=False, ec=color, lw=line, joinstyle="miter"))


def caption(axes: Axes, left: float, top: float, text: str, **style: Any) -> None:
    """Text from an upper left corner, in inches; a dollar sign is one."""
    axes.text(left, top, printable(text), **{"fontsize": 6.5, "va": "top", "parse_math": False, **style})


def _name(shot: Shot) -> str:
    """Method, variant and rate, in lines that fit above a picture."""
    return textwrap.fill(row_label(shot.row), _BOLD)


def _above(panel: Panel) -> float:
    """Height of the longest name above the pictures, in inches."""
    return _TEXT * 0.75 * (max([1, *(_name(shot).count("\n") + 1 for shot in panel.shots)]) + 1 / 3)


def _aspect(panel: Panel) -> float:
    """Height of the pictures over their width."""
    assert panel.truth is not None
    height, width = panel.truth.shape[:2]
    return float(height / width)
