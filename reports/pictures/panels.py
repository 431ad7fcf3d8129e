"""Panels as in papers: ground truth and all models of a scene side by side, for the same view.

Nothing in them is chosen by hand: which views, models and zoom windows are shown follows from the numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from reports.pictures.cieluv import delta_e_uv
from reports.pictures.difference import colored, largest_window
from reports.pictures.files import background, inside, read
from reports.style import absent

if TYPE_CHECKING:
    import pandas as pd

WHICH = {
    "median": "Median view",
    "worst": "Worst view",
    "lowest": "Lowest PSNR of any model",
}
"""The views that are shown, most important first: by mean PSNR over the models, and of any one model."""
RULE = (
    "Views are ranked by mean PSNR over the models of a scene: shown are the worst and the median view, and, "
    "if it is another one, the view with the lowest PSNR of any one model. The box is the window, a quarter "
    "of the picture wide, in which the difference is largest on average over the models; it stands enlarged "
    "below the picture, beside the difference. Of several seeds the first is shown, of several rates the "
    "default, or the middle one where that was not measured."
)
ABSENT = "no picture in this store"
_ZOOM = 4  # a zoom window is this part of the picture's shorter side
_LEAST = 12  # pixels, of a zoom window


@dataclass(frozen=True, eq=False)
class Shot:
    """One model's picture of a view.

    Attributes:
        row: the model's row of `results`.
        psnr, ssim, delta_e: measured values of this view, None if missing.
        picture: (height, width, 3) uint8, or None; then ``problem`` says why.
        difference: to the ground truth in the colors of the fixed scale.
    """

    row: Any
    psnr: float | None = None
    ssim: float | None = None
    delta_e: float | None = None
    picture: NDArray[np.uint8] | None = None
    difference: NDArray[np.uint8] | None = None
    problem: str = ""


@dataclass(frozen=True, eq=False)
class Panel:
    """One view of a scene.

    Attributes:
        which: a key of :data:`WHICH`.
        view: its name.
        truth: (height, width, 3) uint8; None if it cannot be read.
        shots: one per model.
        window: top, left and side of the zoom window in pixels; None without pictures.
        caption: what it shows, if not the view that ``which`` says.
        transfer: what the scene shows, as (side, side, 3) uint8; None if it is not known.
    """

    which: str
    view: str
    truth: NDArray[np.uint8] | None
    shots: list[Shot]
    window: tuple[int, int, int] | None
    caption: str = ""
    transfer: NDArray[np.uint8] | None = None

    @property
    def tells(self) -> bool:
        """Whether it has pictures, or a reason for their lack that is none of the whole store."""
        return self.window is not None or any(shot.problem not in ("", ABSENT) for shot in self.shots)

    @property
    def title(self) -> str:
        return self.caption or WHICH[self.which]

    def zoom(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The window cut out of a picture of this view."""
        assert self.window is not None
        top, left, side = self.window
        return picture[top : top + side, left : left + side]


def models(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of a scene whose pictures are shown: one per method and variant, rate knobs apart.

    Finished rows go before others and current before stale ones; then the default rate; then the first seed;
    of its rates the middle one by size.
    """
    candidates: dict[tuple[Any, Any], list[tuple[tuple[bool, bool, bool, int], float, Any]]] = {}
    names = ["method", "base", "knob_value", "rate", "status", "stale", "seed", "size_bytes"]
    for index, *cells in rows[names].itertuples():
        known = (None if absent(value) else value for value in cells)
        method, base, knob, rate, status, stale, seed, size = known
        default = knob is None and rate is None
        rank = (status != "ok", bool(stale), not default, int(seed or 0))
        candidates.setdefault((method, base), []).append((rank, float(size or 0), index))
    chosen = []
    for group in candidates.values():
        first = min(rank for rank, _, _ in group)
        by_size = sorted((size, at) for at, (rank, size, _) in enumerate(group) if rank == first)
        chosen.append(group[by_size[(len(by_size) - 1) // 2][1]][2])
    return rows.loc[chosen]


def choose(views: pd.DataFrame) -> dict[str, str]:
    """Which (key of :data:`WHICH`) -> name of the view; none is repeated.

    Args:
        views: the documented table, of one scene and those models that are shown.
    """
    known = views.dropna(subset=["psnr"])
    if views.empty:
        return {}
    if known.empty:
        return {"median": str(views["view"].iloc[0])}
    ranked = known.groupby("view", sort=False)["psnr"].mean().sort_values(kind="stable")
    wanted = {
        "median": ranked.index[len(ranked) // 2],
        "worst": ranked.index[0],
        "lowest": known.sort_values("psnr", kind="stable")["view"].iloc[0],
    }
    chosen: dict[str, str] = {}
    for which, view in wanted.items():
        if str(view) not in chosen.values():
            chosen[which] = str(view)
    return chosen


def panels(shown: pd.DataFrame, views: pd.DataFrame, root: Path) -> Iterator[Panel]:
    """The panels of a scene, most important first.

    Args:
        shown: its rows of `results`, one per model (:func:`models`).
        views: the documented table, or those of its rows that are of the scene.
        root: the folder that its paths are relative to.
    """
    of_scene = views[views["job"].isin(set(shown["job"].dropna()))]
    for which, view in choose(of_scene).items():
        rows = of_scene[of_scene["view"] == view].drop_duplicates("job").set_index("job")
        yield _panel(which, view, shown, rows, root)


def in_view(shown: pd.DataFrame, views: pd.DataFrame, root: Path, view: str, caption: str) -> Panel:
    """The panel of one view that was chosen elsewhere; arguments as of :func:`panels`."""
    rows = views[views["job"].isin(set(shown["job"].dropna())) & (views["view"] == view)]
    return replace(
        _panel("median", view, shown, rows.drop_duplicates("job").set_index("job"), root), caption=caption
    )


def _panel(which: str, view: str, shown: pd.DataFrame, rows: pd.DataFrame, root: Path) -> Panel:
    truth, shots, differences = None, [], []
    for _, model in shown.iterrows():
        if model["job"] not in rows.index:
            shots.append(Shot(model, problem="" if model["status"] != "ok" else "this view was not measured"))
            continue
        row = rows.loc[model["job"]]
        psnr, ssim, delta_e = (
            None if absent(row[name]) else float(row[name]) for name in ("psnr", "ssim", "delta_e_uv")
        )
        try:
            behind = background(row["background"])
            seen, picture = (read(inside(root, row[name]), behind) for name in ("truth_file", "render_file"))
            truth = seen if truth is None else truth
            if not truth.shape == seen.shape == picture.shape:
                raise ValueError(f"sizes differ: {truth.shape[:2]} and {picture.shape[:2]}")
        except (OSError, ValueError, SyntaxError) as error:
            shots.append(Shot(model, psnr, ssim, delta_e, problem=_why(error)))
            continue
        difference = delta_e_uv(truth / 255.0, picture / 255.0)
        differences.append(difference)
        shots.append(Shot(model, psnr, ssim, delta_e, picture, colored(difference)))
    window = None
    if differences:
        shorter = min(differences[0].shape)
        side = min(shorter, max(_LEAST, shorter // _ZOOM))
        window = (*largest_window(np.mean(differences, axis=0), side), side)
    return Panel(which, view, truth, shots, window)


def _why(error: Exception) -> str:
    """Why there is no picture, without paths of this machine."""
    if isinstance(error, FileNotFoundError):
        return ABSENT
    if isinstance(error, OSError):
        return f"no picture: {error.strerror or 'the file is none'}"
    return f"no picture: {error}"
