"""Uncertainty of the numbers: intervals over views and seeds, and paired comparison of two models.

Neighbouring test views show nearly the same picture, so their errors are not independent. Variances over
views therefore come from a circular block bootstrap of runs of consecutive views. Where a model was fitted
with several seeds, the variance of the seeds' means is added. Both contain the noise that views and seeds
share, so intervals are rather too wide. With one seed they know nothing of the variation between seeds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

BLOCKS = 6
"""Number of blocks of the path of test views."""
RESAMPLES = 2000
LEAST_VIEWS = 4
"""Least number of views that have an interval."""
_SEED = 20240607


class Interval(NamedTuple):
    """A mean over views and seeds with its 95 % confidence interval; the ends are None with too few views.

    ``freedom`` are the degrees of freedom of Student's t behind it.
    """

    mean: float
    low: float | None
    high: float | None
    views: int
    seeds: int = 1
    freedom: float | None = None

    @property
    def half(self) -> float | None:
        """Half of its width."""
        return None if self.low is None or self.high is None else (self.high - self.low) / 2

    def p_value(self, distance: float) -> float | None:
        """Two-sided p-value of a mean that lies this far from the true one; None without an interval."""
        if self.half is None or self.freedom is None:
            return None
        return Error(self.half / t_quantile(self.freedom), self.freedom).p_value(distance)

    def contains(self, value: float) -> bool:
        """Whether the interval exists and ``value`` is between its ends."""
        return self.low is not None and self.high is not None and self.low < value < self.high

    def lies(self, side: int) -> bool:
        """Whether the interval exists and is above zero (``side`` 1) or below zero (-1)."""
        return self.excludes_zero and (self.mean > 0) == (side > 0)

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval exists and zero is outside it; [0, 0] contains zero."""
        return self.low is not None and self.high is not None and (self.low > 0 or self.high < 0)


def block_length(views: int) -> int:
    """Views per block: a sixth of the path, at any density of views.

    A block must be longer than the correlation of errors along the path. The correlation depends on the
    angle between views; on `vortex_views` it ends after a tenth of the path.
    """
    return max(1, -(-views // BLOCKS))


def _weights(n: int, length: int, resamples: int = RESAMPLES) -> NDArray[np.float64]:
    """(resamples, n) number of draws of each value, over n; the same for all series of n values.

    With the values of a path, the first of which follows the last, they give the means of resampled series
    (circular block bootstrap; Politis & Romano 1992).

    Args:
        n: number of values.
        length: length of a block, 1 to n; 1 is the ordinary bootstrap.
        resamples: number of resampled series.
    """
    starts = np.random.default_rng(_SEED).integers(0, n, (resamples, -(-n // length)))
    indices = (starts[:, :, None] + np.arange(length)) % n
    rows = np.arange(resamples)[:, None]
    weights = np.zeros((resamples, n))
    np.add.at(weights, (rows, indices.reshape(resamples, -1)[:, :n]), 1.0 / n)
    return weights


@cache
def _covariance(n: int, length: int) -> NDArray[np.float64]:
    """(n, n) covariance C of the weights: the variance of the mean of resampled v is v C v."""
    return np.cov(_weights(n, length), rowvar=False, bias=True).reshape(n, n)


class Variance(NamedTuple):
    """The sampling variance of a mean, and its degrees of freedom."""

    value: float
    freedom: float


class Error(NamedTuple):
    """The standard error of a mean, and the degrees of freedom of Student's t."""

    value: float
    freedom: float

    @classmethod
    def of(cls, terms: Iterable[Variance]) -> Error:
        """Of a mean whose variance is a sum: degrees of freedom of Welch and Satterthwaite (1946)."""
        kept = [term for term in terms if term.value > 0.0]
        total = sum(term.value for term in kept)
        if not kept:
            return cls(0.0, math.inf)
        return cls(math.sqrt(total), total**2 / sum(one.value**2 / one.freedom for one in kept))

    @property
    def half(self) -> float:
        """Half of the 95 % interval."""
        return t_quantile(self.freedom) * self.value

    def p_value(self, distance: float) -> float:
        """Two-sided p-value of a mean that lies this far from the true one."""
        from scipy.special import stdtr

        if distance == 0.0 or self.value == 0.0:
            return 1.0 if distance == 0.0 else 0.0
        return 2.0 * float(stdtr(self.freedom, -abs(distance) / self.value))


def interval(
    strata: Sequence[NDArray[np.float64]], length: int | None = None, seeds: Sequence[Sequence[float]] = ()
) -> Interval:
    """Mean and 95 % interval: Student's t with the standard errors of the block bootstrap and of seeds.

    Percentiles of so few blocks would be too narrow. The factor sqrt(blocks / (blocks - 1)) and
    Student's t with (blocks - 1) degrees of freedom correct that.

    Args:
        strata: one array per path: values per view in the order of the path, means over seeds. The result is
            the mean of the paths' means; paths are resampled independently.
        length: length of a block; None for :func:`block_length`.
        seeds: per model, the mean of each of its seeds; models with one seed add nothing.
    """
    count = sum(map(len, strata))
    mean = float(np.mean([values.mean() for values in strata]))
    fewest_seeds = min(map(len, seeds), default=1)
    if min(map(len, strata)) < LEAST_VIEWS:
        return Interval(mean, None, None, count, fewest_seeds)
    variance, fewest = 0.0, np.inf
    for values in strata:
        size = length or block_length(len(values))
        blocks = len(values) / size
        spread = values - values.mean()  # less rounding; the weights sum to one
        variance += float(spread @ _covariance(len(values), size) @ spread) * blocks / (blocks - 1)
        fewest = min(fewest, blocks)
    terms = [Variance(max(variance, 0.0) / len(strata) ** 2, float(fewest) - 1.0)]
    repeated = [one for one in seeds if len(one) > 1]
    terms += [Variance(float(np.var(one, ddof=1)) / len(one), len(one) - 1.0) for one in repeated]
    error = Error.of(terms)
    return Interval(mean, mean - error.half, mean + error.half, count, fewest_seeds, error.freedom)


@cache
def t_quantile(freedom: float) -> float:
    """97.5 % quantile of Student's t."""
    from scipy.special import stdtrit  # the one of scipy.stats takes a second to import

    return float(stdtrit(freedom, 0.975))


class Path(NamedTuple):
    """Values of one scene along the path of its test views."""

    views: tuple[str, ...]
    values: NDArray[np.float64]

    def at(self, views: tuple[str, ...]) -> NDArray[np.float64]:
        """The values of some of the views, in their order."""
        if views == self.views:
            return self.values
        places = {view: place for place, view in enumerate(self.views)}
        return self.values[[places[view] for view in views]]


@dataclass(frozen=True)
class Sample:
    """A model's values of one metric.

    Attributes:
        scenes: scene -> mean over seeds along its path.
        seeds: seed -> mean over scenes; only seeds that all scenes have.
    """

    scenes: dict[str, Path]
    seeds: dict[str, float]

    def interval(self) -> Interval | None:
        """Interval of the mean over scenes; None without values."""
        return _of_scenes(list(self.scenes.values()), [list(self.seeds.values())])

    def minus(self, other: Sample) -> Interval | None:
        """Interval of the mean paired difference over the views of both; None if their scenes differ.

        Models with the same seeds are paired by seed: the seed decides the start that both have.
        """
        if set(self.scenes) != set(other.scenes):
            return None
        pairs = []
        for scene, path in self.scenes.items():
            views = shared_views([path, other.scenes[scene]])
            pairs.append(Path(views, path.at(views) - other.scenes[scene].at(views)))
        if self.seeds.keys() == other.seeds.keys():
            return _of_scenes(pairs, [[mean - other.seeds[seed] for seed, mean in self.seeds.items()]])
        return _of_scenes(pairs, [list(self.seeds.values()), list(other.seeds.values())])


def shared_views(paths: Sequence[Path]) -> tuple[str, ...]:
    """The views that all paths have, in the order of the first."""
    first = paths[0].views
    if all(path.views == first for path in paths):
        return first
    return tuple(view for view in first if all(view in path.views for path in paths))


def _of_scenes(paths: list[Path], seeds: Sequence[Sequence[float]]) -> Interval | None:
    if not paths or not all(path.views for path in paths):
        return None
    arrays = [path.values for path in paths]
    if all(path.views == paths[0].views for path in paths):
        # All scenes share one path, and so the errors of a view: views are resampled for all scenes at once.
        arrays = [np.mean(arrays, axis=0)]
    return interval(arrays, seeds=seeds)


class Views:
    """The values of a `views` table by job, with the results of comparisons: documents repeat them.

    Args:
        table: the table `views`, in the order of the path within a job; None for no views.
    """

    def __init__(self, table: pd.DataFrame | None = None) -> None:
        self._table = table
        self._paths: dict[str, dict[str, tuple[str, str, Path]]] = {}
        self._samples: dict[tuple[str, ...], Sample | None] = {}
        self._differences: dict[tuple[tuple[str, ...], tuple[str, ...]], Interval | None] = {}

    def sample(self, jobs: Iterable[str], metric: str) -> Sample | None:
        """The values of a model's jobs (scenes, seeds); None if one of them has no values.

        Where seeds have different views, the sample has the views that all seeds have.
        """
        key = (metric, *map(str, jobs))
        if key not in self._samples:
            self._samples[key] = self._sample(key[1:], self._jobs(metric))
        return self._samples[key]

    def difference(self, first: Iterable[str], second: Iterable[str], metric: str) -> Interval | None:
        """Interval of first - second, the jobs of two models; None where views cannot be paired."""
        keys = (metric, *map(str, first)), (metric, *map(str, second))
        if keys not in self._differences:
            a, b = (self.sample(key[1:], metric) for key in keys)
            self._differences[keys] = None if a is None or b is None else a.minus(b)
        return self._differences[keys]

    def _sample(self, jobs: tuple[str, ...], paths: dict[str, tuple[str, str, Path]]) -> Sample | None:
        by_scene: dict[str, dict[str, Path]] = {}
        for job in jobs:
            if job not in paths:
                return None
            scene, seed, path = paths[job]
            by_scene.setdefault(scene, {})[seed] = path
        means: dict[str, Path] = {}
        of_seeds: dict[str, list[float]] = {}
        for scene, seeds in by_scene.items():
            views = shared_views(list(seeds.values()))
            means[scene] = Path(views, np.mean([path.at(views) for path in seeds.values()], axis=0))
            for seed, path in seeds.items():
                of_seeds.setdefault(seed, []).append(float(path.at(views).mean()) if views else np.nan)
        common = {seed: float(np.mean(one)) for seed, one in of_seeds.items() if len(one) == len(means)}
        return Sample(means, common) if means else None

    def _jobs(self, metric: str) -> dict[str, tuple[str, str, Path]]:
        """Job -> its scene, its seed and values."""
        if metric not in self._paths:
            self._paths[metric] = {}
            if self._table is not None and metric in self._table:
                rows = self._table[self._table[metric].notna()]
                columns = [rows[name].astype(str).to_numpy() for name in ("job", "scene", "view", "seed")]
                values = rows[metric].to_numpy(np.float64)
                for places in rows.groupby("job", sort=False).indices.values():
                    job, scene, seed = (columns[i][places[0]] for i in (0, 1, 3))
                    path = Path(tuple(columns[2][places].tolist()), values[places])
                    self._paths[metric][job] = scene, seed, path
        return self._paths[metric]
