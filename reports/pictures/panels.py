"""Panels as in papers: ground truth and all models of a scene side by side, for the same view.

The numbers determine the views, models and zoom windows; nothing is selected by hand.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.pictures.cieluv import delta_e_uv
from econgs_bench.reports.pictures.difference import colored, largest_window
from econgs_bench.reports.pictures.files import background, inside, read
from econgs_bench.reports.style import absent
from econgs_bench.reports.tables.columns import cell

if TYPE_CHECKING:
    import pandas as pd

WHICH = {
    "median": "Median view",
    "worst": "Worst view",
    "lowest": "Lowest PSNR of any model",
}
"""Titles of a scene's views, most important first: by mean PSNR over the models, and by PSNR of one model."""
RULE = (
    "Each scene has its median and its worst view, by mean PSNR over the models, and the view with the "
    "lowest PSNR of a single model, if it is another view. The box is the window, a quarter of the picture "
    "wide, with the largest mean difference over the models. The enlarged window is below the picture, "
    "beside the difference. Pictures are from the first seed, and from the default rate, or the middle rate "
    "if the default was not measured."
)
ABSENT = "no picture in this store"
_ZOOM = 4  # shorter side of the picture / side of a zoom window
_LEAST = 12  # pixels; least side of a zoom window


@dataclass(frozen=True, eq=False)
class Shot:
    """One model's picture of a view.

    Attributes:
        row: the model's row of `results`.
        psnr, ssim, delta_e: values of this view; None if missing.
        picture: (height, width, 3) uint8, or None.
        difference: difference to the ground truth in the colors of the fixed scale.
        problem: reason why there is no picture.
    """

    row: Any
    psnr: float | None = None
    ssim: float | None = None
    delta_e: float | None = None
    picture: NDArray[np.uint8] | None = None
    difference: NDArray[np.uint8] | None = None
    problem: str = ""

    @property
    def cost(self) -> str:
        """Size and frame rate of the model; what is missing is left out, as is all of a failed one."""
        units = {"size_bytes": "MiB", "fps": "FPS"}
        values = {name: self.row.get(name) for name in units} if self.row["status"] == "ok" else {}
        texts = [f"{cell(name, value)} {units[name]}" for name, value in values.items() if not absent(value)]
        return ", ".join(texts)


@dataclass(frozen=True, eq=False)
class SceneView:
    """One view of a scene.

    Attributes:
        which: a key of :data:`WHICH`.
        view: name of the view.
        truth: (height, width, 3) uint8 ground truth; None if it cannot be read.
        shots: one shot per model.
        window: top, left and side of the zoom window in pixels; None without pictures.
        caption: title, if it is not that of ``which``.
        transfer: (side, side, 3) uint8 picture of the transfer function; None if there is none.
    """

    which: str
    view: str
    truth: NDArray[np.uint8] | None
    shots: list[Shot]
    window: tuple[int, int, int] | None
    caption: str = ""
    transfer: NDArray[np.uint8] | None = None

    @property
    def informative(self) -> bool:
        """Whether it has a picture, or a reason for a missing one other than that the store has none."""
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
    """One row of a scene per method and variant (without rate knobs), for its pictures.

    Finished rows precede others, and current rows precede stale ones; then the default rate decides, then the
    first seed. Of several rates it is the one with the median size.
    """
    candidates: dict[tuple[Any, Any], list[tuple[tuple[bool, bool, bool, int], float, Any]]] = {}
    names = ["method", "base", "knob_value", "rate", "status", "stale", "seed", "size_bytes"]
    for index, *cells in rows[names].itertuples():
        method, base, knob, rate, status, stale, seed, size = (
            None if absent(value) else value for value in cells
        )
        default = knob is None and rate is None
        rank = (status != "ok", bool(stale), not default, int(seed or 0))
        candidates.setdefault((method, base), []).append((rank, float(size or 0), index))
    indices = []
    for group in candidates.values():
        first = min(rank for rank, _, _ in group)
        by_size = sorted((size, at) for at, (rank, size, _) in enumerate(group) if rank == first)
        indices.append(group[by_size[(len(by_size) - 1) // 2][1]][2])
    return rows.loc[indices]


def choose(views: pd.DataFrame) -> dict[str, str]:
    """Key of :data:`WHICH` -> name of the view; no view occurs twice.

    Args:
        views: rows of the table `views`, of one scene and the models of its panels.
    """
    measured = views.dropna(subset=["psnr"])
    if views.empty:
        return {}
    if measured.empty:
        return {"median": str(views["view"].iloc[0])}
    ranked = measured.groupby("view", sort=False)["psnr"].mean().sort_values(kind="stable")
    candidates = {
        "median": ranked.index[len(ranked) // 2],
        "worst": ranked.index[0],
        "lowest": measured.sort_values("psnr", kind="stable")["view"].iloc[0],
    }
    distinct: dict[str, str] = {}
    for which, view in candidates.items():
        if str(view) not in distinct.values():
            distinct[which] = str(view)
    return distinct


def panels(rows: pd.DataFrame, views: pd.DataFrame, root: Path) -> Iterator[SceneView]:
    """The panels of a scene, most important first.

    Args:
        rows: rows of `results`, one per model (:func:`models`).
        views: the table `views`.
        root: folder that the paths in ``views`` are relative to.
    """
    of_scene = views[views["job"].isin(set(rows["job"].dropna()))]
    for which, view in choose(of_scene).items():
        yield _panel(which, view, rows, of_scene, root)


def in_view(rows: pd.DataFrame, views: pd.DataFrame, root: Path, view: str, caption: str) -> SceneView:
    """The panel of a given view; arguments as of :func:`panels`."""
    return replace(_panel("median", view, rows, views, root), caption=caption)


def _panel(which: str, view: str, models: pd.DataFrame, views: pd.DataFrame, root: Path) -> SceneView:
    rows = views[views["view"] == view].drop_duplicates("job").set_index("job")
    truth, shots, differences = None, [], []
    for _, model in models.iterrows():
        if model["job"] not in rows.index:
            shots.append(
                Shot(model, problem="" if model["status"] != "ok" else "no measurement of this view")
            )
            continue
        row = rows.loc[model["job"]]
        psnr, ssim, delta_e = (
            None if absent(row[name]) else float(row[name]) for name in ("psnr", "ssim", "delta_e_uv")
        )
        try:
            color = background(row["background"])
            target, picture = (read(inside(root, row[name]), color) for name in ("truth_file", "render_file"))
            truth = target if truth is None else truth
            if not truth.shape == target.shape == picture.shape:
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
    return SceneView(which, view, truth, shots, window)


def _why(error: Exception) -> str:
    """Reason why there is no picture, without paths of this machine."""
    if isinstance(error, FileNotFoundError):
        return ABSENT
    if isinstance(error, OSError):
        return f"no picture: {error.strerror or 'the file has another format'}"
    return f"no picture: {error}"
