"""How sure the numbers are: intervals over views, spread over seeds, paired comparison of two models.

Neighbouring test views show nearly the same picture, so their errors are not independent. Intervals
therefore come from a circular block bootstrap of runs of consecutive views. What varies between seeds is
another matter and is told apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

BLOCKS = 6
"""Blocks that the path of test views is divided into."""
RESAMPLES = 2000
LEAST_VIEWS = 4
"""With fewer there is no interval."""
_SEED = 20240607


class Interval(NamedTuple):
    """A mean over views with its 95 % confidence interval; the ends are None with too few views."""

    mean: float
    low: float | None
    high: float | None
    views: int

    def contains(self, value: float) -> bool:
        """Whether it is known and has a value between its ends."""
        return self.low is not None and self.high is not None and self.low < value < self.high

    def lies(self, side: int) -> bool:
        """Whether it is known and lies above zero (side 1), or below (-1)."""
        return self.excludes_zero and (self.mean > 0) == (side > 0)

    @property
    def excludes_zero(self) -> bool:
        """Whether it is known and lies on one side of zero. A difference of exactly nothing does not."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)


def block_length(views: int) -> int:
    """Views per block: a sixth of the path, however densely it was sampled.

    A block should outlast the correlation of errors along the path, which is a matter of angle; measured on
    `vortex_views` it is gone after a tenth of the path.
    """
    return max(1, -(-views // BLOCKS))


def bootstrap_means(values: NDArray[np.float64], length: int, resamples: int = RESAMPLES) -> NDArray[Any]:
    """Means of resampled series (circular block bootstrap; Politis & Romano 1992), always the same ones.

    Args:
        values: (n,) in the order of the path; its end is followed by its begin.
        length: of a block, 1 to n; 1 is the ordinary bootstrap.
        resamples: how many.

    Returns:
        (resamples,) means of n values each.
    """
    means: NDArray[np.float64] = _weights(len(values), length, resamples) @ values
    return means


@cache
def _weights(n: int, length: int, resamples: int) -> NDArray[np.float64]:
    """(resamples, n): how often each value is drawn, over n; one matrix serves all series of a length."""
    starts = np.random.default_rng(_SEED).integers(0, n, (resamples, -(-n // length)))
    drawn = (starts[:, :, None] + np.arange(length)) % n
    rows = np.arange(resamples)[:, None]
    weights = np.zeros((resamples, n))
    np.add.at(weights, (rows, drawn.reshape(resamples, -1)[:, :n]), 1.0 / n)
    return weights


def interval(strata: Sequence[NDArray[np.float64]], length: int | None = None) -> Interval:
    """Mean and 95 % interval: Student's t with the standard error of the block bootstrap.

    Percentiles of so few blocks would be too narrow; t with (blocks - 1) degrees of freedom, and the error
    scaled by sqrt(blocks / (blocks - 1)), makes up for that.

    Args:
        strata: values per view in the order of the path, one array per path; the mean is that of their
            means, and paths are drawn independently.
        length: of a block; None for :func:`block_length`.
    """
    from scipy.stats import t

    count = sum(map(len, strata))
    mean = float(np.mean([values.mean() for values in strata]))
    if min(map(len, strata)) < LEAST_VIEWS:
        return Interval(mean, None, None, count)
    variance, fewest = 0.0, np.inf
    for values in strata:
        size = length or block_length(len(values))
        blocks = len(values) / size
        variance += float(bootstrap_means(values, size).var()) * blocks / (blocks - 1)
        fewest = min(fewest, blocks)
    half = float(t.ppf(0.975, fewest - 1)) * variance**0.5 / len(strata)
    return Interval(mean, mean - half, mean + half, count)


@dataclass(frozen=True)
class Sample:
    """A model's values of one metric: scene -> view -> value, views in order, averaged over seeds."""

    scenes: dict[str, dict[str, float]]

    def interval(self) -> Interval | None:
        """Of the mean over scenes; None without values."""
        return _of_scenes(list(self.scenes.values()))

    def minus(self, other: Sample) -> Interval | None:
        """Of the mean paired difference over the views that both have; None if their scenes differ."""
        if set(self.scenes) != set(other.scenes):
            return None
        pairs = []
        for scene, mine in self.scenes.items():
            theirs = other.scenes[scene]
            pairs.append({view: value - theirs[view] for view, value in mine.items() if view in theirs})
        return _of_scenes(pairs)


def _of_scenes(scenes: list[dict[str, float]]) -> Interval | None:
    if not scenes or not all(scenes):
        return None
    arrays = [np.fromiter(values.values(), np.float64) for values in scenes]
    if all(list(values) == list(scenes[0]) for values in scenes):
        # One path for all scenes: what a view shows is seen in all of them, so they are drawn together.
        arrays = [np.mean(arrays, axis=0)]
    return interval(arrays)


class Views:
    """The values of a `views` table by job.

    Args:
        table: as documented, in the order of the path within a job.
    """

    def __init__(self, table: pd.DataFrame) -> None:
        self._jobs = {str(job): rows for job, rows in table.groupby("job", sort=False)}
        # A report asks for the same values hundreds of times, and pandas takes 5 ms for each answer.
        self._known: dict[tuple[str, str], tuple[str, dict[str, float]] | None] = {}

    def sample(self, jobs: Iterable[str], metric: str) -> Sample | None:
        """The values of a model's jobs (scenes, seeds); None if any of them has no views, or lacks values.

        Where seeds saw different views, those that all saw count.
        """
        by_scene: dict[str, list[dict[str, float]]] = {}
        for job in jobs:
            key = str(job), metric
            if key not in self._known:
                self._known[key] = self._values(*key)
            known = self._known[key]
            if known is None:
                return None
            by_scene.setdefault(known[0], []).append(known[1])
        averaged = {}
        for scene, seeds in by_scene.items():
            shared = [view for view in seeds[0] if all(view in seed for seed in seeds)]
            averaged[scene] = {view: float(np.mean([seed[view] for seed in seeds])) for view in shared}
        return Sample(averaged) if averaged else None

    def _values(self, job: str, metric: str) -> tuple[str, dict[str, float]] | None:
        """Of a job: its scene and view -> value; None without any."""
        rows = self._jobs.get(job)
        if rows is None or metric not in rows:
            return None
        rows = rows[rows[metric].notna()]
        if rows.empty:
            return None
        seen = dict(zip(rows["view"].astype(str), rows[metric].astype(float), strict=True))
        return str(rows["scene"].iloc[0]), seen
