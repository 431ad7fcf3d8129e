"""Edits of models: checked and resolved to factors, palette color and light."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch

from econgs_bench.datasets.edits import changes_transfer
from econgs_bench.econgs.anchors.shading import Factors
from econgs_bench.methods.interface import Edit, Refused

Direction = tuple[float, float, float]


def triple(values: Iterable[float]) -> Direction:
    """A color or direction from JSON.

    Raises:
        TypeError, ValueError: anything but three finite numbers.
    """
    try:
        x, y, z = (float(value) for value in values)
    except OverflowError as error:
        raise ValueError(str(error)) from error
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"{x}, {y}, {z} are not finite")
    return x, y, z


def opacity_factor(method: str, name: str, edit: Edit) -> float:
    """The factor of opacity of a scene, of a method that edits nothing else; 1 where it stays.

    Raises:
        Refused: an edit of anything else, a factor out of range.
    """
    others = [part for part, value in vars(edit).items() if value is not None and part != "opacity"]
    if others:
        raise Refused(f"{method} cannot edit {', '.join(others)} of scene {name!r}: only opacity")
    factor = 1.0 if edit.opacity is None else edit.opacity
    if not (math.isfinite(factor) and factor >= 0.0):
        raise Refused(f"opacity factor {factor} of scene {name!r} is not a finite number >= 0")
    return factor


def shading_edit(
    name: str, palette: torch.Tensor, light: Direction | None, edit: Edit
) -> tuple[torch.Tensor, Direction | None, Factors]:
    """Palette color, light and factors of an edited scene that is shaded.

    Args:
        name: the scene's name.
        palette: (3,) its own color.
        light: unit vector to its own directional light; None for a headlight.
        edit: the changes.

    Raises:
        Refused: a value out of range.
    """
    if changes_transfer(edit):
        raise Refused(f"the transfer function of scene {name!r} is part of its model: it cannot be edited")
    numbers = {
        part: 1.0 if value is None else float(value)
        for part in ("opacity", "ambient", "diffuse", "specular", "shininess")
        for value in (getattr(edit, part),)
    }
    for part, value in numbers.items():
        if not (math.isfinite(value) and value >= 0.0):
            raise Refused(f"{part} factor {value} of scene {name!r} is not a finite number >= 0")
    if edit.palette is not None:
        if not all(math.isfinite(value) and 0.0 <= value <= 1.0 for value in edit.palette):
            raise Refused(f"palette color {edit.palette} of scene {name!r} is not in [0, 1]")
        palette = palette.new_tensor(edit.palette)
    if edit.light == "headlight":
        light = None
    elif edit.light is not None:
        direction = np.asarray(edit.light, dtype=np.float64)
        length = float(np.linalg.norm(direction))
        if direction.shape != (3,) or not math.isfinite(length) or length < 1e-6:
            raise Refused(f"light {edit.light} of scene {name!r} is no direction")
        light = triple(direction / length)
    return palette, light, Factors(**numbers)
