"""Intervals of BD-rate and BD-PSNR over views and seeds.

Near the measured curves both are linear in the PSNR of the points and in the logarithm of their bytes. So
their variance is that of a weighted sum of the points (delta method). Such a sum has a value per view and per
seed, as a metric has.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from econgs_bench.reports.statistics import Path, Sample, shared_views

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.reports.statistics import Interval, Views

Delta = Callable[[list[float], list[float], list[float], list[float]], float]
"""A number that compares two curves: from bytes and PSNR of the reference, then of the other one."""
Sizes = Mapping[str, tuple[str, float]]
"""Job -> its seed, and the bytes of its model."""
_STEP, _SHARE = 1e-5, 1e-3
"""Of derivatives, in dB and in log10 of bytes; at most this share of the distance to the next point, within
which slopes change."""


class RatePoint(NamedTuple):
    """A point of a curve.

    Attributes:
        psnr: mean over scenes and seeds, dB.
        bytes: per scene, mean over seeds.
        jobs: the jobs behind it.
    """

    psnr: float
    bytes: float
    jobs: tuple[str, ...]


def interval(
    reference: Sequence[RatePoint],
    test: Sequence[RatePoint],
    delta: Delta,
    views: Views,
    sizes: Sizes,
) -> Interval | None:
    """Interval of a number that compares two curves; None where test views are missing or not the same.

    Its mean is that of the linear part alone, so only its width counts.

    Args:
        reference: points of a curve, by size.
        test: those of another one.
        delta: the number.
        views: values of test views.
        sizes: of the jobs of the points, as :func:`sizes` gives them.
    """
    curves = (reference, test)
    psnr = [[point.psnr for point in curve] for curve in curves]
    size = [[float(np.log10(point.bytes)) for point in curve] for curve in curves]

    def number(sizes: list[list[float]], qualities: list[list[float]]) -> float:
        ours, theirs = ([10**value for value in values] for values in sizes)
        return delta(ours, qualities[0], theirs, qualities[1])

    by_psnr = _slopes(lambda values: number(size, values), psnr)
    by_size = _slopes(lambda values: number(values, psnr), size)
    parts = [
        _part(curve, sign * by_psnr[i], sign * by_size[i], views, sizes)
        for i, (curve, sign) in enumerate(zip(curves, (-1.0, 1.0), strict=True))
    ]
    first, second = parts
    return None if first is None or second is None else second.minus(first)


def _slopes(
    number: Callable[[list[list[float]]], float], values: list[list[float]], share: float = _SHARE
) -> list[np.ndarray]:
    """Derivative by each value of both curves, by central differences that keep the values in order."""
    slopes = []
    for i, curve in enumerate(values):
        h = min(_STEP, *(share * abs(b - a) for a, b in pairwise(curve) if a != b))
        row = []
        for j in range(len(curve)):
            ends = []
            for side in (h, -h):
                moved = [list(one) for one in values]
                moved[i][j] += side
                ends.append(number(moved))
            row.append((ends[0] - ends[1]) / (2 * h))
        slopes.append(np.array(row))
    return slopes


def _part(
    curve: Sequence[RatePoint], by_psnr: np.ndarray, by_size: np.ndarray, views: Views, sizes: Sizes
) -> Sample | None:
    """What a curve adds to the linear part: the weighted sum over its points, per view and per seed."""
    samples = []
    for point in curve:
        sample = views.sample(point.jobs, "psnr")
        if sample is None:
            return None
        samples.append(sample)
    scenes = set(samples[0].scenes)
    if any(set(sample.scenes) != scenes for sample in samples):
        return None
    paths = {}
    for scene in scenes:
        common = shared_views([sample.scenes[scene] for sample in samples])
        rows = [sample.scenes[scene].at(common) for sample in samples]
        paths[scene] = Path(common, by_psnr @ np.array(rows))
    bytes_of_seeds = [_bytes(sizes, point.jobs) for point in curve]
    seeds = {}
    for seed in samples[0].seeds:
        if all(seed in sample.seeds for sample in samples) and all(seed in one for one in bytes_of_seeds):
            quality = np.array([sample.seeds[seed] for sample in samples])
            size = np.log10([one[seed] for one in bytes_of_seeds])
            seeds[seed] = float(by_psnr @ quality + by_size @ size)
    return Sample(paths, seeds)


def sizes(results: pd.DataFrame) -> Sizes:
    """Job -> its seed, and the bytes of its scenes, from the documented table."""
    found: dict[str, tuple[str, float]] = {}
    columns = (results["job"], results["seed"].astype(str), results["size_bytes"].astype(float))
    for job, seed, size in zip(*columns, strict=True):
        if size > 0:
            found[job] = (seed, found.get(job, (seed, 0.0))[1] + size)
    return found


def _bytes(sizes: Sizes, jobs: tuple[str, ...]) -> dict[str, float]:
    """Seed -> bytes of its scenes."""
    sums: dict[str, float] = {}
    for seed, size in (sizes[job] for job in jobs if job in sizes):
        sums[seed] = sums.get(seed, 0.0) + size
    return sums
