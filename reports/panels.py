"""Example views: ground truth, render, and their color difference, as data URIs."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from reports.cieluv import delta_e_uv
from reports.style import absent

if TYPE_CHECKING:
    import pandas as pd

DELTA_E_MAX = 20.0
"""End of the fixed color scale of difference maps."""
_SIDE = 400  # pixels; larger pictures are shown smaller
_LOSSLESS = 256  # up to this side pictures are shown pixel for pixel


@dataclass(frozen=True)
class Panel:
    """One example view of one job.

    Attributes:
        which: "worst", "median" or "best" of the job's views by PSNR; several if they are the same view.
        view: name of the view.
        psnr, ssim, delta_e: measured values of this view, None if missing.
        truth, render, difference: data URIs; empty if the pictures are missing, then ``problem`` says why.
        bytes: length of the data URIs.
    """

    which: str
    view: str
    psnr: float | None
    ssim: float | None
    delta_e: float | None
    truth: str = ""
    render: str = ""
    difference: str = ""
    problem: str = ""

    @property
    def bytes(self) -> int:
        return len(self.truth) + len(self.render) + len(self.difference)


def choose(views: pd.DataFrame) -> dict[str, Any]:
    """Which ("median", "worst", "best") -> row label of a job's view by PSNR; views are never repeated."""
    ranked = views.dropna(subset=["psnr"]).sort_values("psnr", kind="stable")
    if ranked.empty:
        ranked = views
    if ranked.empty:
        return {}
    places = {"median": (len(ranked) - 1) // 2, "worst": 0, "best": len(ranked) - 1}
    chosen: dict[str, Any] = {}
    for which, place in places.items():
        if ranked.index[place] not in chosen.values():
            chosen[which] = ranked.index[place]
    return chosen


def panels(views: pd.DataFrame, root: Path, budget: int) -> tuple[dict[str, list[Panel]], int]:
    """Job -> its example views, worst first. All jobs' median views come first, then worst, then best.

    Args:
        views: the documented table.
        root: the folder that its paths are relative to.
        budget: bytes that the pictures may take together.

    Returns:
        The panels, and how many were left out for want of room.
    """
    made: dict[str, list[Panel]] = {}
    left_out = spent = 0
    chosen = {str(job): choose(rows) for job, rows in views.groupby("job", sort=False)}
    for which in ("median", "worst", "best"):
        for job, rows in chosen.items():
            if which not in rows:
                continue
            if spent >= budget:
                left_out += 1
                continue
            panel = _panel(which, views.loc[rows[which]], root)
            spent += panel.bytes
            made.setdefault(job, []).append(panel)
    order = ("worst", "median", "best")
    return {
        job: sorted(row, key=lambda panel: order.index(panel.which)) for job, row in made.items()
    }, left_out


def _panel(which: str, row: Any, root: Path) -> Panel:
    def value(name: str) -> float | None:
        return None if absent(row[name]) else float(row[name])

    numbers: dict[str, Any] = {"psnr": value("psnr"), "ssim": value("ssim"), "delta_e": value("delta_e_uv")}
    try:
        background = _background(row["background"])
        truth, render = (read(_inside(root, row[name]), background) for name in ("truth_file", "render_file"))
        if truth.shape != render.shape:
            raise ValueError(f"sizes differ: {truth.shape[:2]} and {render.shape[:2]}")
    except (OSError, ValueError, SyntaxError) as error:
        return Panel(which, str(row["view"]), **numbers, problem=f"no pictures: {error}")
    difference = colored(delta_e_uv(truth / 255.0, render / 255.0))
    return Panel(
        which, str(row["view"]), **numbers, truth=uri(truth), render=uri(render), difference=uri(difference)
    )


def _inside(root: Path, name: Any) -> Path:
    """A table's path, which must not lead out of the store."""
    if absent(name) or not name:
        raise ValueError("the table names none")
    path = (root / str(name)).resolve()
    if not path.is_relative_to(root.resolve()):
        raise ValueError(f"{name} lies outside the run store")
    return path


def _background(value: Any) -> tuple[float, float, float]:
    """From "#rrggbb".

    Raises:
        ValueError: it is not known, and a guess would show other pictures than were measured.
    """
    if absent(value):
        raise ValueError("their background is not known")
    text = str(value)
    return (int(text[1:3], 16) / 255.0, int(text[3:5], 16) / 255.0, int(text[5:7], 16) / 255.0)


def read(path: Path, background: Iterable[float]) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 of a picture with straight alpha, composited."""
    from PIL import Image

    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGBA"), dtype=np.float64) / 255.0
    alpha = pixels[..., 3:]
    shown = pixels[..., :3] * alpha + (1.0 - alpha) * np.asarray(list(background), dtype=np.float64)
    return np.rint(shown * 255.0).astype(np.uint8)  # type: ignore[no-any-return]


@cache
def scale() -> NDArray[np.uint8]:
    """(256, 3) uint8: the color scale of difference maps (inferno: perceptually uniform, 0 is black)."""
    from matplotlib import colormaps

    table: NDArray[np.uint8] = (colormaps["inferno"](np.arange(256), bytes=True))[:, :3]
    return table


def colored(difference: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A difference map in the colors of the fixed scale, 0 to :data:`DELTA_E_MAX`."""
    levels = np.rint(np.clip(difference / DELTA_E_MAX, 0.0, 1.0) * 255.0).astype(np.uint8)
    picture: NDArray[np.uint8] = scale()[levels]
    return picture


def uri(pixels: NDArray[np.uint8]) -> str:
    """A picture as a data URI: PNG if small, else WebP at no more than 400 pixels a side."""
    from PIL import Image

    image = Image.fromarray(pixels)
    file = io.BytesIO()
    if max(image.size) <= _LOSSLESS:
        image.save(file, "PNG", optimize=True)
        kind = "png"
    else:
        image.thumbnail((_SIDE, _SIDE), Image.Resampling.LANCZOS)
        image.save(file, "WEBP", quality=88, method=4)
        kind = "webp"
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
