"""Small pictures of transfer functions: color and opacity over values from 0 to 1."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.pictures.panels import SceneView
from econgs_bench.reports.style import absent

if TYPE_CHECKING:
    import pandas as pd

AXIS = (110, 110, 110)
"""Color of the line at opacity 0."""
_SIDE = 96  # pixels of a picture beside a panel
_PALE = 0.85  # least channel of a pale color
_GAP = 2  # pixels between the functions of a composition


def draw_transfer(picture: NDArray[np.floating], transfer: NDArray[np.floating]) -> None:
    """Draw a function: the area under its opacity, filled with the color of each value.

    Args:
        picture: (height, width, 3) in [0, 1]; it is changed.
        transfer: (m, 4) color and opacity in [0, 1] at equidistant values.
    """
    height, wide = picture.shape[:2]
    across = (np.arange(wide) + 0.5) / wide
    up = (height - 1 - np.arange(height) + 0.5)[:, None] / height
    where = np.linspace(0.0, 1.0, len(transfer))
    # The largest opacity within each column, so that a narrow peak is not missed.
    cells = np.clip((where * wide).astype(int), 0, wide - 1)
    opacity = np.interp(across, where, transfer[:, 3])
    np.maximum.at(opacity, cells, transfer[:, 3])
    color = np.stack([np.interp(across, where, transfer[:, c]) for c in range(3)], axis=-1)
    inside = (up < opacity[None]) & (opacity[None] > 0)
    picture[inside] = np.broadcast_to(color, picture.shape)[inside]
    edge = inside & ~(up + 1.0 / height < opacity[None])
    # Pale colors need an outline at the sides too. It would darken narrow peaks of other colors.
    beyond = np.pad(inside, ((0, 0), (1, 1)))
    edge |= inside & ~(beyond[:, :-2] & beyond[:, 2:]) & (color.min(axis=-1) > _PALE)
    picture[edge] *= 0.6


def draw_level(picture: NDArray[np.floating], value: float, color: Sequence[float]) -> None:
    """Draw an isosurface as an upright line."""
    at = min(int(value * picture.shape[1]), picture.shape[1] - 2)
    picture[:, at : at + 2] = color


def pixels(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """8-bit values of an image in [0, 1]."""
    values: NDArray[np.uint8] = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    return values


def transfer_picture(transfer: Any, side: int) -> NDArray[np.uint8] | None:
    """(side, side, 3) picture of a scene's transfer functions, one strip per part; None without a part.

    Args:
        transfer: a value of the column `transfer` of the table `scenes`: a JSON object, part -> "transfer"
            ((m, 4) color and opacity) and "levels" (normalised value and color of each isosurface).
        side: width and height in pixels.
    """
    parts = [] if absent(transfer) or not transfer else list(json.loads(str(transfer)).values())
    if not parts:
        return None
    strips = np.ones((side, side, 3))
    edges = np.linspace(0, side, len(parts) + 1).round().astype(int)
    for part, top, bottom in zip(parts, edges, edges[1:], strict=False):
        strip = strips[top : max(bottom - (_GAP if bottom < side else 0), top + 2)]
        if part["transfer"]:
            draw_transfer(strip, np.asarray(part["transfer"], dtype=float))
        for value, *color in part["levels"]:
            draw_level(strip, value, color)
        strip[-1] = np.asarray(AXIS) / 255.0
    return pixels(strips)


def beside(panels: Iterable[SceneView], scenes: pd.DataFrame | None, row: Any) -> list[SceneView]:
    """The panels of a scene with the picture of its transfer function, if the table `scenes` has it.

    Args:
        panels: the panels of one scene.
        scenes: the table `scenes`; None if there is none.
        row: one of the scene's rows of `results`.
    """
    transfer = None
    if scenes is not None and len(scenes):
        keys = ["dataset", "scene", "preset", "split"]
        matches = scenes.loc[(scenes[keys] == [row[key] for key in keys]).all(axis=1), "transfer"]
        transfer = matches.iloc[0] if len(matches) else None
    picture = transfer_picture(transfer, _SIDE)
    return [replace(panel, transfer=picture) for panel in panels]
