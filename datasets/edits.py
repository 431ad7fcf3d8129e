"""Edits of a scene at render time, and the ground-truth scene of an edited model."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

from econgs_bench.datasets.errors import DataError

if TYPE_CHECKING:
    from econgs_bench.datasets.scene import RGB, BasicScene, Light
    from econgs_bench.datasets.transfer import Bump, TransferFunction

_SAMPLES = 4096


@dataclass(frozen=True)
class Edit:
    """Changes to a scene at render time; None keeps the trained value.

    Attributes:
        palette: displayed sRGB palette color in [0, 1].
        opacity: factor on opacity, >= 0.
        light: unit vector from the object to the light, or "headlight".
        ambient, diffuse, specular, shininess: factors on the trained coefficients, >= 0.
        transfer: another transfer function on the same variable; the other changes come on top of it.
        shift: every bump moves along the values by this many of its own widths; negative: to lower values.
        width: factor on the width of every bump, around the middle of its plateau, > 0.
    """

    palette: RGB | None = None
    opacity: float | None = None
    light: tuple[float, float, float] | Literal["headlight"] | None = None
    ambient: float | None = None
    diffuse: float | None = None
    specular: float | None = None
    shininess: float | None = None
    transfer: TransferFunction | None = None
    shift: float | None = None
    width: float | None = None


def edited(scene: BasicScene, edit: Edit) -> BasicScene:
    """The scene whose ground truth an edited model is measured against.

    * Palette: the scene's mean color becomes the palette color; every color of the scene moves by the same
      amount, clipped to [0, 1]. A model that holds one palette color per scene and offsets from it changes in
      this way; a scene of one color takes exactly the new color.
    * Opacity: factor on the opacities of the transfer function (they stay below 1) or of the isosurfaces.
    * Light: the new direction, and factors on its coefficients.
    * Transfer function: the new one, then the widths of its bumps, then their places, then palette and
      opacity. Corners of bumps stay in [0, 1].

    Raises:
        DataError: the scene does not allow the edit, or a value is out of range.
    """
    _check(scene, edit)
    if edit.transfer is not None:
        scene = replace(scene, transfer=edit.transfer)
    if edit.width is not None:
        width = edit.width
        scene = _changed(scene, lambda bump: _widened(bump, width))
    if edit.shift is not None:
        shift = edit.shift
        scene = _changed(scene, lambda bump: _shifted(bump, shift))
    if edit.palette is not None:
        r, g, b = (new - old for new, old in zip(edit.palette, mean_color(scene), strict=True))
        scene = _changed(scene, lambda part: _recolor(part, (r, g, b)))
    if edit.opacity is not None:
        from econgs_bench.datasets.transfer import MOST_OPACITY

        factor, most = edit.opacity, 1.0 if scene.isosurfaces else MOST_OPACITY
        scene = _changed(scene, lambda part: replace(part, opacity=min(factor * part.opacity, most)))
    if scene.light is not None:
        scene = replace(scene, light=_relight(scene.light, edit))
    return scene


def changes_transfer(edit: Edit) -> bool:
    """Whether other values are visible after an edit than before."""
    return any(change is not None for change in (edit.transfer, edit.shift, edit.width))


def mean_color(scene: BasicScene) -> RGB:
    """The mean of a scene's colors.

    Weights are the extinction over the values of a transfer function, or the opacities of isosurfaces.
    A scene without opacity is white.
    """
    import numpy as np

    if scene.isosurfaces:
        colors = np.array([s.color for s in scene.isosurfaces])
        weights = np.array([s.opacity for s in scene.isosurfaces])
    else:
        transfer = _transfer(scene)
        # Even samples between the corners of bumps: a narrow bump gets as many as a wide one.
        edges = sorted({0.0, 1.0, *(x for b in transfer.bumps for x in (b.start, b.rise, b.fall, b.end))})
        middles, widths = [], []
        for low, high in pairwise(edges):
            step = (high - low) / _SAMPLES
            middles.append(low + step * (np.arange(_SAMPLES) + 0.5))
            widths.append(np.full(_SAMPLES, step))
        classified = transfer.classify(np.concatenate(middles))
        colors, weights = classified[:, :3], classified[:, 3] * np.concatenate(widths)
    if weights.sum() <= 0.0:
        return (1.0, 1.0, 1.0)
    r, g, b = (float(c) for c in weights @ colors / weights.sum())
    return r, g, b


def _check(scene: BasicScene, edit: Edit) -> None:
    what = f"edit of scene {scene.name}"
    if scene.views_folder is not None:
        raise DataError(
            what, "it was rendered elsewhere, so there is no truth for edits", "Edit a volume's scene"
        )
    factors = {
        name: getattr(edit, name) for name in ("opacity", "ambient", "diffuse", "specular", "shininess")
    }
    for name, factor in factors.items():
        if factor is not None and not (math.isfinite(factor) and factor >= 0.0):
            raise DataError(what, f"the factor on {name} is {factor}", "Give a number of at least 0")
    if edit.shininess == 0.0:
        raise DataError(what, "a shininess of 0 has no highlight", "Use a specular factor of 0")
    if edit.palette is not None and not all(0.0 <= c <= 1.0 for c in edit.palette):
        raise DataError(
            what, f"the palette color {edit.palette} is out of range", "Give three values in [0, 1]"
        )
    if isinstance(edit.light, tuple) and abs(math.hypot(*edit.light) - 1.0) > 1e-3:
        raise DataError(what, f"the light {edit.light} is no unit vector", "Divide it by its length")
    moves = (edit.transfer, edit.shift, edit.width)
    if scene.transfer is None and any(x is not None for x in moves):
        raise DataError(what, "it has no transfer function", "Edit its palette or opacity")
    if edit.shift is not None and not math.isfinite(edit.shift):
        raise DataError(what, f"the shift is {edit.shift}", "Give a finite number of widths")
    if edit.width is not None and not (math.isfinite(edit.width) and edit.width > 0.0):
        raise DataError(what, f"the factor on the width is {edit.width}", "Give a number above 0")
    lit = (edit.light, edit.ambient, edit.diffuse, edit.specular, edit.shininess)
    if scene.light is None and any(x is not None for x in lit):
        raise DataError(what, "the scene is unshaded", "Edit its palette or opacity only")


def _transfer(scene: BasicScene) -> TransferFunction:
    if scene.transfer is None:
        raise DataError(f"scene {scene.name}", "it has no transfer function", "Give it one in the catalogue")
    return scene.transfer


def _changed(scene: BasicScene, change: Callable[[Any], Any]) -> BasicScene:
    """The scene with each of its isosurfaces, or of its bumps, changed."""
    if scene.isosurfaces:
        return replace(scene, isosurfaces=tuple(change(surface) for surface in scene.isosurfaces))
    transfer = _transfer(scene)
    return replace(scene, transfer=replace(transfer, bumps=tuple(change(bump) for bump in transfer.bumps)))


def _widened(bump: Bump, factor: float) -> Bump:
    middle = 0.5 * (bump.rise + bump.fall)
    return _with_corners(bump, lambda corner: middle + factor * (corner - middle))


def _shifted(bump: Bump, widths: float) -> Bump:
    by = widths * (bump.end - bump.start)
    return _with_corners(bump, lambda corner: corner + by)


def _with_corners(bump: Bump, place: Callable[[float], float]) -> Bump:
    start, rise, fall, end = (
        min(max(place(corner), 0.0), 1.0) for corner in (bump.start, bump.rise, bump.fall, bump.end)
    )
    return replace(bump, start=start, rise=rise, fall=fall, end=end)


def _recolor(part: Any, shift: RGB) -> Any:
    r, g, b = (min(max(old + by, 0.0), 1.0) for old, by in zip(part.color, shift, strict=True))
    return replace(part, color=(r, g, b))


def _relight(light: Light, edit: Edit) -> Light:
    changes: dict[str, Any] = {
        name: factor * getattr(light, name)
        for name in ("ambient", "diffuse", "specular", "shininess")
        if (factor := getattr(edit, name)) is not None
    }
    if edit.light is not None:
        changes["direction"] = None if edit.light == "headlight" else edit.light
    return replace(light, **changes)
