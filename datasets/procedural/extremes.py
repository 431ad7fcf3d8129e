"""Scenes at the limits of what a method may meet: nothing, a single point, hairs, a full box."""

from __future__ import annotations

import numpy as np

from econgs_bench.datasets.procedural.space import Array, Slice, Waves

VARIABLES = ("full", "hairs", "point", "nothing")
_POINT = 0.02
"""Radius of the point: a pixel and a half of a view of 128 x 128."""
_HAIR = 0.004
"""Radius of a hair: a third of such a pixel."""
_HAIRS = 8
"""Hairs along each axis."""


class Extremes:
    """Four fields: zero; a tiny blob; thin straight hairs along the axes; values in the whole box."""

    def __init__(self, seed: int) -> None:
        self._places = np.random.default_rng(seed * 41 + 1).uniform(-0.4, 0.4, (3, _HAIRS, 2))
        self._waves = Waves(seed * 41 + 2, 2.0, 10.0)

    def __call__(self, at: Slice) -> dict[str, Array]:
        """Values in 0...1."""
        x, y, z = at.columns, at.rows, np.array(at.z)
        empty = np.zeros((len(at.y), len(at.x)))
        hairs = empty
        for (across, along), places in zip(((y, z), (x, z), (x, y)), self._places, strict=True):
            for a, b in places:
                hair = np.exp(-0.5 * ((across - a) ** 2 + (along - b) ** 2) / _HAIR**2)
                hairs = np.maximum(hairs, hair)
        point = np.exp(-0.5 * (x**2 + y**2 + z**2) / _POINT**2)
        full = 0.6 + 0.12 * self._waves(at)
        return {"nothing": empty, "point": point + empty, "hairs": hairs, "full": full}
