"""Difference pictures: CIELUV ΔE*uv in one fixed color scale, the same in every report."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.pictures.cieluv import cieluv

DELTA_E_MAX = 20.0
"""Upper end of the fixed color scale of difference maps."""
# Blue is low and red is high, as in the figures of the field. Unlike in their rainbow scale, lightness grows
# monotonically (L* 13 to 61), so that the order is visible in gray and to color-blind readers.
_STOPS = ("#0a1a5c", "#1f5fd6", "#7d6bd8", "#d3608c", "#ff5a3c")


@cache
def scale() -> NDArray[np.uint8]:
    """(256, 3) uint8 color scale in perceptually equal steps (equal distances in CIELUV)."""
    stops = np.array([[int(stop[i : i + 2], 16) for i in (1, 3, 5)] for stop in _STOPS]) / 255.0
    places = np.linspace(0.0, len(stops) - 1.0, 4001)
    fine = np.stack([np.interp(places, range(len(stops)), stops[:, c]) for c in range(3)], axis=-1)
    steps = np.linalg.norm(np.diff(cieluv(fine), axis=0), axis=-1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    indices = np.searchsorted(length, np.linspace(0.0, length[-1], 256)).clip(0, len(fine) - 1)
    table: NDArray[np.uint8] = np.rint(fine[indices] * 255.0).astype(np.uint8)
    return table


def colored(difference: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(..., 3) uint8 colors of a difference map on the fixed scale, 0 to :data:`DELTA_E_MAX`."""
    levels = np.rint(np.clip(difference / DELTA_E_MAX, 0.0, 1.0) * 255.0).astype(np.uint8)
    picture: NDArray[np.uint8] = scale()[levels]
    return picture


def largest_window(difference: NDArray[np.float64], side: int) -> tuple[int, int]:
    """Top and left of the square window of ``side`` pixels with the largest mean of a (height, width) map."""
    sums = np.pad(difference, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    windows = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    top, left = np.unravel_index(int(windows.argmax()), windows.shape)
    return int(top), int(left)
