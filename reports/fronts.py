"""Fronts: the points that no other beats in cost and quality, and what a curve has at a cost."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise


def pareto(points: Iterable[tuple[float, float]], better: int) -> list[tuple[float, float]]:
    """The points that none dominates, from the best x to the worst (and so from the worst y to the best).

    Args:
        points: (x, y); more y is better.
        better: 1 if more x is better, -1 if less is.
    """
    front: list[tuple[float, float]] = []
    for x, y in sorted(set(points), key=lambda point: (-better * point[0], -point[1])):
        if not front or y > front[-1][1]:
            front.append((x, y))
    return front


def interpolated(points: Sequence[tuple[float, float]], x: float) -> float:
    """Y of a curve, linear in the logarithm of x between points, level beyond the last.

    Args:
        points: (x, y), x positive and ascending; at least one.
        x: not below the first point's.
    """
    for (low, start), (high, end) in pairwise(points):
        if low <= x < high:
            return start + (end - start) * math.log(x / low) / math.log(high / low)
    return points[-1][1]
