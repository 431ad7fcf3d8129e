"""Transfer functions that no model was trained on: how far they are, and which trained scenes come near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.datasets.edits import Edit, edited, mean_color

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from econgs_bench.datasets.scene import BasicScene

_SAMPLES = 4096
_LEAST = 0.02
"""Factor on the opacity under which a scene is left out."""


def transfer_distance(before: Sequence[BasicScene], after: Sequence[BasicScene]) -> float | None:
    """Distance of two sets of transfer functions that are drawn together, in [0, 1].

    It is 1 - sum of minima / sum of maxima of extinction and extinction-weighted color over the values, both
    sets scaled to the same total extinction: 0 where both are the same at another opacity, 1 where no value
    is visible in both. How often values occur does not matter.

    Args:
        before: a scene, or all of a composition.
        after: the same for the other set.

    Returns:
        None for isosurfaces, views that were rendered elsewhere, and where nothing is visible in one.
    """
    if any(scene.transfer is None for scene in (*before, *after)):
        return None
    first, second = (np.sum([_classified(scene) for scene in scenes], axis=0) for scenes in (before, after))
    totals = [float(values[:, 0].sum()) for values in (first, second)]
    if min(totals) <= 0.0:
        return None
    first, second = first / totals[0], second / totals[1]
    return 1.0 - float(np.minimum(first, second).sum() / np.maximum(first, second).sum())


def recipe(scene: BasicScene, edit: Edit, trained: Sequence[BasicScene], *, palette: bool) -> dict[str, Edit]:
    """Trained scenes that together come nearest to an edited scene, and the edit of each.

    For methods whose models hold their transfer functions: the opacities of trained scenes are scaled so
    that the sum of their extinctions is as near as possible to that of the edited scene. Near is meant as in
    the Cramér distance: non-negative least squares of extinctions summed up to each value, because
    neighbouring values are neighbours in space. A bump that has moved is thus shown by the bump that it was,
    or by the two that it is between. Where the palette can be edited, each takes the mean color of the edited
    scene, and only extinctions count; else colors count too.

    Args:
        scene: a basic scene with a transfer function.
        edit: its changes, among them one of the transfer function.
        trained: scenes of the same variable that were learned; ``scene`` is among them.
        palette: whether the method edits palettes.

    Returns:
        Scene -> its edit. The scene alone, unchanged but for its light, where nothing comes near.
    """
    from scipy.optimize import nnls

    target = edited(scene, edit)
    usable = [one for one in trained if one.transfer is not None]
    channels = slice(0, 1) if palette else slice(0, 4)
    columns = [_summed(one)[:, channels].ravel() for one in usable]
    factors, _ = nnls(np.stack(columns, axis=1), _summed(target)[:, channels].ravel())
    chosen = {one.name: float(f) for one, f in zip(usable, factors, strict=True) if f >= _LEAST}
    light = replace(edit, palette=None, opacity=None, transfer=None, shift=None, width=None)
    if not chosen:
        return {scene.name: replace(light, opacity=1.0)}
    color = mean_color(target) if palette else None
    return {name: replace(light, opacity=factor, palette=color) for name, factor in chosen.items()}


def _summed(scene: BasicScene) -> NDArray[np.float64]:
    return np.cumsum(_classified(scene), axis=0)


def _classified(scene: BasicScene) -> NDArray[np.float64]:
    """(samples, 4) extinction, and extinction x color, at equidistant values."""
    assert scene.transfer is not None
    table = scene.transfer.classify(np.linspace(0.0, 1.0, _SAMPLES))
    return np.concatenate([table[:, 3:], table[:, 3:] * table[:, :3]], axis=1)
