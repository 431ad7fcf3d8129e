"""Thinning of initial clouds: common equipment of methods that start from one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera

_SHRINK = 0.8
"""Factor on the side of a cell while too few points are left."""


def thinned(
    points: NDArray[np.float32], spacing: float, cameras: Sequence[Camera], least: int = 0
) -> NDArray[np.int64]:
    """Indices of the first point in each cell, in the order of the points.

    Args:
        points: (n, 3), in the cameras' units.
        spacing: side of a cell in pixels of the cameras; 0 keeps all points.
        cameras: of the training views.
        least: cells shrink until so many points are left, if there are so many.
    """
    if spacing <= 0.0 or len(points) == 0:
        return np.arange(len(points))
    side = spacing * pixel_size(cameras, points)
    kept = first_of_cells(points, side)
    least = min(least, len(np.unique(points, axis=0))) if least > len(kept) else 0
    while len(kept) < least:
        side *= _SHRINK
        kept = first_of_cells(points, side)
    return kept


def pixel_size(cameras: Sequence[Camera], points: NDArray[np.float32]) -> float:
    """Scene units that a pixel covers at the middle of the points: the median over cameras."""
    centre = points.mean(axis=0)
    return float(np.median([np.linalg.norm(one.position - centre) / one.fx for one in cameras]))


def first_of_cells(points: NDArray[np.float32], side: float) -> NDArray[np.int64]:
    """Indices of the first point (n, 3) in each cell of a lattice of this side, ascending."""
    cells = np.floor(points.astype(np.float64) / side).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.sort(first)
