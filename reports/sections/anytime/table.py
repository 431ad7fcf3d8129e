"""PSNR while models are trained, and the time to a quality.

Of fits that differ only in a rate knob the default's are shown: others are points of rate-distortion curves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from econgs_bench.reports.charts.lines import Line
from econgs_bench.reports.curves import at_default_rates
from econgs_bench.reports.style import model
from econgs_bench.reports.tables.columns import places
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

LEVELS = (30.0, 32.0, 34.0)
"""Levels of PSNR, dB, whose times are reported."""


def anytime(curve: pd.DataFrame, results: pd.DataFrame) -> dict[str, list[Line]]:
    """Dataset (with its preset where there are several) -> a line per method over seconds per scene.

    Values are means over scenes and seeds.

    A fit of n scenes counts for each of them with its time / n, as in `results`, so that joint and single
    fits compare. A mean begins where all fits have been evaluated; a finished fit keeps its
    last value.

    Args:
        curve: the documented table.
        results: the documented table: which scenes there are, so that a mean of fewer is titled so.
    """
    panels: dict[str, list[Line]] = {}
    for panel, every in comparable(at_default_rates(curve)):
        columns = ["job", "method", "variant", "scene", "iteration", "train_seconds", "psnr"]
        evaluations = every.loc[every["psnr"].notna() & every["train_seconds"].notna(), columns]
        first = every.iloc[0]
        basic = (results["kind"] == "basic") & (results["dataset"] == first["dataset"])
        scenes = set(results.loc[basic & (results["preset"] == first["preset"]), "scene"])
        for names, rows in evaluations.groupby(["method", "variant"], dropna=False, sort=False):
            scene, *numbers = (
                rows[name].to_numpy() for name in ("scene", "iteration", "train_seconds", "psnr")
            )
            iteration, seconds, values = (column.astype(float) for column in numbers)
            x, y = _mean(
                [
                    _shares(len(set(scene[fit])), iteration[fit], seconds[fit], values[fit])
                    for fit in places(rows, ["job"]).values()
                ]
            )
            if not x:
                continue
            mine = model(*names)
            have = scenes & set(rows["scene"])
            missing = f" ({len(have)} of {len(scenes)} scenes)" if scenes - have else ""
            panels.setdefault(panel, []).append(Line(mine, mine.title + missing, x, y))
    return panels


def _shares(
    scenes: int,
    iteration: NDArray[np.float64],
    seconds: NDArray[np.float64],
    values: NDArray[np.float64],
) -> tuple[list[float], list[float], int]:
    """Seconds and values of a fit, mean over its scenes, and their number."""
    _, at, counts = np.unique(iteration, return_inverse=True, return_counts=True)
    x, y = (np.bincount(at, column) / counts for column in (seconds, values))
    return (x / scenes).tolist(), y.tolist(), scenes


def _mean(fits: list[tuple[list[float], list[float], int]]) -> tuple[list[float], list[float]]:
    """Mean of fits, each weighted by its scenes, at all times (or iterations) at which any was evaluated.

    It begins where all have been; a finished fit keeps its last value.
    """
    begin = max(x[0] for x, _, _ in fits)
    times = sorted({t for x, _, _ in fits for t in x if t >= begin and t > 0})
    weights = np.array([scenes for _, _, scenes in fits], dtype=float)
    values = np.array([np.interp(times, x, y) for x, y, _ in fits])
    return times, [float(v) for v in weights @ values / weights.sum()]


def time_to_quality(curve: Line, level: float) -> float | None:
    """Seconds per scene at which a curve first reaches a level, linear between evaluations; None if never.

    A curve that begins above a level has reached it by its first evaluation.
    """
    for i, (x, y) in enumerate(zip(curve.x, curve.y, strict=True)):
        if y >= level:
            if i == 0:
                return x
            before, low = curve.x[i - 1], curve.y[i - 1]
            return before + (x - before) * (level - low) / (y - low)
    return None
