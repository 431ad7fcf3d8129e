"""Volumes made from formulas: deterministic; a higher resolution samples the same field more finely."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.procedural import extremes, flame, front, single, spectral_sets, wake
from econgs_bench.datasets.procedural.space import Array, Slice
from econgs_bench.datasets.volume import Volume

DEFAULT_RESOLUTION = 64
_LEVELS = 65535
LADDER = (1, 2, 4, 8, 16)
"""Blobs along each axis of the complexity ladder."""


@dataclass(frozen=True)
class Family:
    """A procedural set.

    Attributes:
        variables: names of the volumes.
        make: seed -> function from the positions of a slice to values in 0...1 of every variable.
        sides: side lengths of the box, x y z; the longest is 1.
        default: default number of samples along the longest side.
    """

    variables: tuple[str, ...]
    make: Callable[[int], Callable[[Slice], dict[str, Array]]]
    sides: tuple[float, float, float] = (1.0, 1.0, 1.0)
    default: int = DEFAULT_RESOLUTION

    def dims(self, resolution: int) -> tuple[int, int, int]:
        """Samples along x, y, z."""
        nx, ny, nz = (max(round((resolution - 1) * side) + 1, 4) for side in self.sides)
        return nx, ny, nz


# Whole cubes at once: recorded figures depend on their values.
_CUBES: dict[str, Callable[[int, int], Array]] = {
    "vortices": spectral_sets.vortices,
    "shells": spectral_sets.shells,
}
_FAMILIES: dict[str, Family] = {
    "jet_flame": Family(flame.VARIABLES, flame.JetFlame, flame.SIDES, 128),
    "ionisation_like": Family(front.VARIABLES, front.IonisationFront, front.SIDES, 96),
    "ship_wake": Family(wake.VARIABLES, wake.ShipWake, wake.SIDES, 96),
    "supernova_like": Family(("supernova_like",), single.Supernova),
    "argon_bubble_like": Family(("argon_bubble_like",), single.ArgonBubble, (1.0, 0.4, 0.4), 96),
    "turbulence": Family(("turbulence",), single.Turbulence),
    "extremes": Family(extremes.VARIABLES, extremes.Extremes, default=128),
    "beetle_like": Family(("beetle_like",), single.Beetle, (1.0, 1.0, 494 / 864), 96),
    **{
        # Sixteen blobs across need eight samples each.
        f"blobs_{across**3}": Family(
            (f"blobs_{across**3}",), partial(single.Blobs, across=across), default=max(64, 8 * across)
        )
        for across in LADDER
    },
}
FIELDS: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in _CUBES},
    **{name: family.variables for name, family in _FAMILIES.items()},
}
"""Variables of every procedural set."""


def default_resolution(name: str) -> int:
    """Default number of samples along the longest side."""
    return _FAMILIES[name].default if name in _FAMILIES else DEFAULT_RESOLUTION


def make_volumes(name: str, resolution: int | None = None, seed: int = 0) -> dict[str, Volume]:
    """Every variable of a procedural set, with ``resolution`` samples along the longest side.

    Values are rounded to uint16, so that they do not depend on the last bits of a machine's arithmetic.
    Evaluation goes slice by slice: memory is that of the results.

    Args:
        name: one of :data:`FIELDS`.
        resolution: 8 to 1024; default: that of the set.
        seed: seed of the random modes.

    Raises:
        UnknownName: no such set.
        DataError: the resolution is out of range.
    """
    if name not in FIELDS:
        raise unknown("procedural set", name, FIELDS)
    n = check_resolution(name, resolution)
    source = f"procedural {name}@{n}, seed {seed}"
    full = (0.0, float(_LEVELS))
    if name in _CUBES:
        values = _levels(_CUBES[name](n, seed))
        return {name: Volume(name, values, (1.0, 1.0, 1.0), full, source)}
    family = _FAMILIES[name]
    nx, ny, nz = family.dims(n)
    x, y, z = (
        np.linspace(-0.5 * side, 0.5 * side, m) for side, m in zip(family.sides, (nx, ny, nz), strict=True)
    )
    results = {variable: np.empty((nz, ny, nx), dtype=np.uint16) for variable in family.variables}
    field = family.make(seed)
    for k, depth in enumerate(z):
        for variable, picture in field(Slice(x, y, float(depth))).items():
            results[variable][k] = _levels(picture)
    spacing = (float(x[1] - x[0]), float(y[1] - y[0]), float(z[1] - z[0]))
    return {v: Volume(v, values, spacing, full, f"{source}, {v}") for v, values in results.items()}


def _levels(field: Array) -> NDArray[np.uint16]:
    return np.rint(np.clip(field, 0.0, 1.0) * _LEVELS).astype(np.uint16)


def check_resolution(name: str, resolution: int | None) -> int:
    """The given resolution, or the default.

    Raises:
        DataError: it is out of range.
    """
    n = default_resolution(name) if resolution is None else resolution
    if not 8 <= n <= 1024:
        raise DataError(f"{name}@{n}", "the resolution is out of range", "Ask for 8 to 1024, 64 or 128 say")
    return n
