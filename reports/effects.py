"""How much better one method is than another, with an interval over scenes and seeds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from econgs_bench.reports.statistics import Error, Variance

Cells = dict[str, dict[str, dict[Any, float]]]
"""Dataset -> scene -> seed -> value, of one method."""
LEAST_DATASETS = 3
"""Datasets from which their differences are the sample; with fewer it is the scenes."""
LEAST_SHARE = 0.5
"""Share of the datasets, and of the scenes of each, that a method needs to be ranked."""
_ROUNDING = 1e-9
"""Differences of means that are none."""
NO_SEED = "none in common"
"""In place of a seed: the mean over those of a method, of a scene of which the methods share no seed."""


@dataclass(frozen=True)
class Effect:
    """The mean paired difference of two methods; positive where the first is better.

    Attributes:
        mean: mean over datasets of the mean over their scenes and seeds; of ratios the natural logarithm.
        half: half width of the 95 % interval; None where neither datasets, scenes nor seeds repeat, or only
            seeds that change nothing.
        p: two-sided p-value of Student's t with the same standard error; None as ``half``.
        wins: number of datasets on which the first is better.
        datasets, scenes: that were compared.
        seeds: least and largest number of common seeds of a scene; 0 where its means are compared.
        ratio: whether ``mean`` and ``half`` are logarithms.
    """

    mean: float
    half: float | None
    p: float | None
    wins: int
    datasets: int
    scenes: int
    seeds: tuple[int, int]
    ratio: bool

    @property
    def ends(self) -> tuple[float, float] | None:
        """The interval, of a ratio as factors."""
        if self.half is None:
            return None
        low, high = self.mean - self.half, self.mean + self.half
        return (math.exp(low), math.exp(high)) if self.ratio else (low, high)


def at_shared_seeds(cells: Mapping[str, Cells], ratio: bool) -> dict[str, Cells]:
    """Values of methods with the same scenes: of each scene those of the seeds that all methods have.

    Where they share none, the means over their own seeds stand under :data:`NO_SEED`. Means of the result,
    and their differences, are of the same seeds, so a better mean never has a negative lead.

    Args:
        cells: method -> values.
        ratio: means are geometric.
    """
    shared: dict[str, Cells] = {name: {} for name in cells}
    for dataset, scenes in next(iter(cells.values()), {}).items():
        for scene in scenes:
            own = {name: values[dataset][scene] for name, values in cells.items()}
            common = set.intersection(*map(set, own.values()))
            for name, seeds in own.items():
                kept = {seed: value for seed, value in seeds.items() if seed in common}
                shared[name].setdefault(dataset, {})[scene] = kept or {NO_SEED: mean(seeds.values(), ratio)}
    return shared


def leads(
    order: Sequence[str],
    cells: Mapping[str, Cells],
    better: int,
    ratio: bool,
    paces: Mapping[str, float] = MappingProxyType({}),
) -> tuple[tuple[Effect, ...], Mapping[str, Cells]]:
    """How far the first of some methods is ahead of each other one, never less than nothing.

    Each lead is over the seeds that the two methods share. If the first one is behind on those, they are over
    the seeds that all methods share, by whose means it is first.

    Args:
        order: methods by their means of :func:`at_shared_seeds`, the best first.
        cells: method -> values; all have the same scenes.
        better: 1 if higher is better, -1 if lower is.
        ratio: compare by quotient instead of difference.
        paces: method -> time of a fixed piece of work where its values were measured. A lead that the
            quotient of two explains is not significant.

    Returns:
        The leads, and the values that they are of.
    """
    for values in (cells, at_shared_seeds(cells, ratio)):
        found = [
            effect(values[order[0]], values[name], better, ratio, pace_between(paces, order[0], name))
            for name in order[1:]
        ]
        known = tuple(one for one in found if one is not None)
        assert len(known) == len(found)  # all methods have the same scenes
        if all(one.mean >= 0.0 for one in known):
            break
    return known, values


def pace_between(paces: Mapping[str, float], first: str, second: str) -> float:
    """Quotient of two methods' paces, at least 1; 1 where one is not known."""
    pair = [paces.get(name, math.nan) for name in (first, second)]
    return max(pair) / min(pair) if all(value > 0 for value in pair) else 1.0


def mean(values: Iterable[float], ratio: bool = False) -> float:
    """Arithmetic mean, or the geometric one."""
    numbers = np.fromiter(values, dtype=np.float64)
    return math.exp(float(np.log(numbers).mean())) if ratio else float(numbers.mean())


def mean_of(cells: Cells, ratio: bool) -> float:
    """Mean over datasets of the means over their scenes of the means over seeds."""
    return mean(
        (
            mean((mean(seeds.values(), ratio) for seeds in scenes.values()), ratio)
            for scenes in cells.values()
        ),
        ratio,
    )


def effect(first: Cells, second: Cells, better: int, ratio: bool, pace: float = 1.0) -> Effect | None:
    """Compare two methods on the datasets, scenes and seeds that both have; None if there are none.

    The sampling variance is that of the datasets' means if there are at least three, else that of the scenes
    within each dataset; with several common seeds, that of the seeds' means is added. Both count the noise
    that scenes and seeds share, so the interval is rather too wide.

    Args:
        first: values of a method, by dataset, scene and seed. Ratios need positive ones.
        second: those of the other.
        better: 1 if higher is better, -1 if lower is.
        ratio: compare by quotient instead of difference.
        pace: a quotient of the values that the methods did not cause, at least 1.
    """
    differences = {
        dataset: scenes
        for dataset in first
        if dataset in second and (scenes := _differences(first[dataset], second[dataset], better, ratio))
    }
    if not differences:
        return None
    of_scenes = [[mean(seeds.values()) for seeds in scenes.values()] for scenes in differences.values()]
    of_datasets = [mean(values) for values in of_scenes]
    middle = _beyond(mean(of_datasets), 0.0)
    of_data = _sampling([of_datasets]) if len(of_datasets) >= LEAST_DATASETS else _sampling(of_scenes)
    by_seed = _sampling([_of_seeds(differences)])
    if of_data is None and by_seed is not None and by_seed.value == 0.0:
        by_seed = None  # seeds change nothing, so they repeat nothing
    counts = [
        0 if NO_SEED in seeds else len(seeds) for scenes in differences.values() for seeds in scenes.values()
    ]
    known = [term for term in (of_data, by_seed) if term is not None]
    error = Error.of(known) if known else None
    return Effect(
        middle,
        error.half if error is not None else None,
        error.p_value(abs(_beyond(middle, math.log(pace)))) if error is not None else None,
        sum(value > _ROUNDING for value in of_datasets),
        len(of_datasets),
        sum(map(len, of_scenes)),
        (min(counts), max(counts)),
        ratio,
    )


def _beyond(difference: float, explained: float) -> float:
    """How far a difference exceeds what is explained, with its sign; 0 within rounding."""
    excess = abs(difference) - explained
    return math.copysign(excess, difference) if excess > _ROUNDING else 0.0


def _differences(
    first: dict[str, dict[Any, float]], second: dict[str, dict[Any, float]], better: int, ratio: bool
) -> dict[str, dict[Any, float]]:
    """Scene -> seed -> difference; that of the means under :data:`NO_SEED` where no seed is common."""

    def value(number: float) -> float:
        return better * (math.log(number) if ratio else number)

    scenes: dict[str, dict[Any, float]] = {}
    for scene in first:
        if scene in second:
            a, b = first[scene], second[scene]
            common = [seed for seed in a if seed in b]
            scenes[scene] = {seed: value(a[seed]) - value(b[seed]) for seed in common} or {
                NO_SEED: mean(map(value, a.values())) - mean(map(value, b.values()))
            }
    return scenes


def _of_seeds(differences: dict[str, dict[str, dict[Any, float]]]) -> list[float]:
    """The mean over datasets and scenes of each seed that all scenes have."""
    cells = [seeds for scenes in differences.values() for seeds in scenes.values()]
    common = [seed for seed in cells[0] if all(seed in cell for cell in cells)]
    return [
        mean(mean(seeds[seed] for seeds in scenes.values()) for scenes in differences.values())
        for seed in common
    ]


def _sampling(strata: Sequence[Sequence[float]]) -> Variance | None:
    """Variance of the mean of some strata's means; None without repetition.

    A stratum of one value has the variance that the others have together.
    """
    repeated = [np.asarray(values) for values in strata if len(values) > 1]
    degrees = sum(len(values) - 1 for values in repeated)
    if not degrees:
        return None
    pooled = sum(float(values.var(ddof=1)) * (len(values) - 1) for values in repeated) / degrees
    terms = [float(np.var(values, ddof=1)) / len(values) if len(values) > 1 else pooled for values in strata]
    return Variance(sum(terms) / len(strata) ** 2, degrees)
