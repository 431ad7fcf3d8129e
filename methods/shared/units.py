"""Scene units: fits work in units in which a scene is about as large as those that methods were published on.

Published step sizes, lattices and thresholds are lengths in scene units, so a volume in millimetres or in
metres would be another problem. Factors are powers of two, which change no digit of a number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from econgs_bench.datasets.units import cloud_in_units, scene_in_units, views_in_units
from econgs_bench.methods.interface import SceneInput

USUAL = (1.0, 16.0)
"""Extents of scenes that are fitted as they are."""
_TYPICAL = 4.0


def units_of(group: Sequence[SceneInput]) -> float:
    """Scene units / units of the fit of a group: 1 for scenes of usual extent."""
    extent = max((scene.extent for scene in group), default=_TYPICAL)
    if USUAL[0] <= extent <= USUAL[1] or not (math.isfinite(extent) and extent > 0.0):
        return 1.0
    return float(2.0 ** round(math.log2(extent / _TYPICAL)))


def in_units(scene: SceneInput, units: float) -> SceneInput:
    """The scene with all coordinates multiplied by ``units``; its volume stays as it is."""
    if units == 1.0:
        return scene
    return replace(
        scene,
        scene=scene_in_units(scene.scene, units),
        train=views_in_units(scene.train, units),
        validation=views_in_units(scene.validation, units),
        cloud=cloud_in_units(scene.cloud, units),
        extent=units * scene.extent,
        units=scene.units / units,
    )
