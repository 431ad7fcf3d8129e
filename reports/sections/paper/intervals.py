"""Intervals of ratios of two rows: bytes, times and frame rates vary between scenes and seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.reports.sections.paper.values import QUANTITIES
from econgs_bench.reports.statistics import Error, Interval, Variance

if TYPE_CHECKING:
    from econgs_bench.reports.sections.paper.values import PaperRow, Parts


def ratio(above: PaperRow, below: PaperRow, column: str) -> Interval | None:
    """A table's value of one row over that of another; None where nothing is repeated.

    Both values are sums or means over the same scenes. On the logarithm, the variance over n scenes is that
    of a ratio of two means (delta method; Cochran 1977, Sampling Techniques, 6.4); that of the seeds' ratios
    is added, and Student's t has the degrees of freedom of both. Scenes and seeds are paired.

    Args:
        above: a row.
        below: the row that it is divided by.
        column: one whose scenes are summed or averaged.

    Returns:
        An interval of factors; its views are scenes.
    """
    first, second = (_by_scene(row.parts.get(column, {})) for row in (above, below))
    if QUANTITIES[column].across == "max" or not first or set(first) != set(second):
        return None
    means = [np.array([np.mean(list(own[scene].values())) for scene in first]) for own in (first, second)]
    sums = [float(one.sum()) for one in means]
    if min(sums) <= 0.0:
        return None
    terms = []
    if len(first) > 1:
        shares = means[0] / sums[0] - means[1] / sums[1]
        n = len(first)
        terms.append(Variance(float(shares @ shares) * n / (n - 1), n - 1.0))
    logs = [_of_seeds(own) for own in (first, second)]
    common = [logs[0][seed] - logs[1][seed] for seed in logs[0] if seed in logs[1]]
    paired = logs[0].keys() == logs[1].keys()
    repeated = [common] if paired else [list(one.values()) for one in logs]
    terms += [
        Variance(float(np.var(each, ddof=1)) / len(each), len(each) - 1.0)
        for each in repeated
        if len(each) > 1
    ]
    if not terms:
        return None
    error, log = Error.of(terms), math.log(sums[0] / sums[1])
    ends = (math.exp(log - error.half), math.exp(log + error.half))
    return Interval(math.exp(log), *ends, len(first), min(map(len, logs)), error.freedom)


def same(first: PaperRow, second: PaperRow) -> bool:
    """Whether two rows are of the same models: in all scenes and seeds equal in all that is no time."""
    columns = [
        name
        for name, own in first.parts.items()
        if not QUANTITIES[name].clock and own and second.parts.get(name)
    ]
    if not {"psnr", "size_bytes"} <= set(columns):
        return False
    return all(
        set(first.parts[name]) == set(second.parts[name])
        and all(second.parts[name][place] == value for place, value in first.parts[name].items())
        for name in columns
    )


def _by_scene(parts: Parts) -> dict[str, dict[str, float]]:
    scenes: dict[str, dict[str, float]] = {}
    for (scene, seed), value in parts.items():
        scenes.setdefault(scene, {})[seed] = value
    return scenes


def _of_seeds(scenes: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Seed -> logarithm of its sum over scenes; only seeds that all scenes have."""
    each: Sequence[Mapping[str, float]] = list(scenes.values())
    common = [seed for seed in each[0] if all(seed in own for own in each)]
    return {seed: math.log(sum(own[seed] for own in each)) for seed in common}
