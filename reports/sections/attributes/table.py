"""Histograms of the attributes of primitives, and a map of anchors by their features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.curves import at_default_rates
from econgs_bench.reports.style import Model, model, models, named
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd

_BINS = 60
_MOST_PEAKS = 3
"""Of a histogram; more are taken for the steps of quantised values."""
_PEAK = 0.05  # share of the highest bin that a peak stands out by
_TAIL = 0.002
"""Share of the samples at each end that a histogram's axis leaves out."""
_MOST_ANCHORS = 4000
_LEAST_ANCHORS = 30
_VECTOR = "features"
"""Name of the attribute that the map is of."""
_SCALINGS = "scalings"
"""Name of the attribute whose rows of six hold three scalings of offsets and three of Gaussians."""


class Missing(Exception):
    """Why a chart is left out."""


@dataclass(frozen=True)
class Histogram:
    """Samples of one attribute on one dataset.

    Attributes:
        dataset: with its preset where there are several.
        edges: of the bins, ascending.
        shares: model -> percent of its samples in each bin.
    """

    dataset: str
    attribute: str
    edges: list[float]
    shares: dict[Model, list[float]]


def histograms(features: pd.DataFrame) -> list[Histogram]:
    """Of all attributes; scenes, seeds and the components of a vector are pooled.

    Scalings of offsets and of Gaussians are of other sizes, and two attributes.

    With many variants only the defaults are shown (:func:`.reports.style.named`), and of fits that differ
    only in a rate knob the default's.

    Args:
        features: the documented table.
    """
    panels = []
    for dataset, every in comparable(at_default_rates(features)):
        own = named(models(every))
        attributes: dict[str, dict[Model, list[NDArray[np.float64]]]] = {}
        for row in every.itertuples(index=False):
            mine = model(row.method, row.variant)
            for attribute, values in _apart(str(row.name), row.values, row.width) if mine in own else ():
                pools = attributes.setdefault(attribute, {})
                pools.setdefault(mine, []).append(values[np.isfinite(values)])
        for attribute, pools in attributes.items():
            samples = {each: np.concatenate(arrays) for each, arrays in pools.items()}
            samples = {each: values for each, values in samples.items() if len(values)}
            if samples:
                edges = _edges(list(samples.values()))
                shares = {each: _shares(values, edges).tolist() for each, values in samples.items()}
                panels.append(Histogram(dataset, attribute, edges.tolist(), shares))
    return panels


def _apart(name: str, values: Any, width: Any) -> list[tuple[str, NDArray[np.float64]]]:
    """Name and values of the parts of an attribute."""
    numbers = np.asarray(values, dtype=np.float64)
    if name != _SCALINGS or width != 6:
        return [(name, numbers)]
    rows = numbers.reshape(-1, 6)
    return [("scalings of offsets", rows[:, :3].ravel()), ("scalings of Gaussians", rows[:, 3:].ravel())]


def _edges(samples: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Of the bins, over the range of all samples."""
    ends = [np.quantile(values, [_TAIL, 1 - _TAIL]) for values in samples]
    low, high = float(min(e[0] for e in ends)), float(max(e[1] for e in ends))
    if low == high:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, _BINS + 1)


def _shares(values: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Percent of the samples in each bin; quantised values are spread until they are no comb."""
    from scipy.signal import find_peaks

    counted = 100.0 * np.histogram(values, edges)[0] / len(values)
    for reach in range(1, _BINS // 4):
        weights = 1.0 - np.abs(np.arange(1 - reach, reach)) / reach
        spread = np.convolve(np.pad(counted, reach), weights / weights.sum(), "same")
        if len(find_peaks(spread, prominence=_PEAK * spread.max())[0]) <= _MOST_PEAKS:
            break
    return spread[reach:-reach]


@dataclass(frozen=True)
class Map:
    """Anchors of one method on one dataset in two dimensions.

    Attributes:
        scenes: scene -> (n, 2) positions.
    """

    dataset: str
    title: str
    scenes: dict[str, NDArray[np.float64]]


def maps(features: pd.DataFrame) -> list[Map]:
    """UMAP of the vectors that anchors carry (the attribute `features`).

    Args:
        features: the documented table.

    Raises:
        Missing: there are none or too few, or the package is not installed; the text says which.
    """
    vectors = _vectors(features)
    if not vectors:
        raise Missing("no method of this report offers its anchors' feature vectors")
    try:
        import umap
    except ImportError as error:
        raise Missing("the optional package umap-learn is not installed: pip install umap-learn") from error
    panels = []
    for (dataset, title), scenes in vectors.items():
        each = _MOST_ANCHORS // len(scenes)
        rng = np.random.default_rng(0)
        sample = {scene: rows[np.sort(rng.permutation(len(rows))[:each])] for scene, rows in scenes.items()}
        every = np.concatenate(list(sample.values()))
        if len(every) < _LEAST_ANCHORS:
            continue
        spots = umap.UMAP(random_state=0, n_jobs=1).fit_transform(every).astype(np.float64)
        ends = np.cumsum([len(rows) for rows in sample.values()])[:-1]
        panels.append(Map(dataset, title, dict(zip(sample, np.split(spots, ends), strict=True))))
    if not panels:
        raise Missing(f"no method of this report has feature vectors of {_LEAST_ANCHORS} anchors")
    return panels


def _vectors(features: pd.DataFrame) -> dict[tuple[str, str], dict[str, NDArray[np.float64]]]:
    """(dataset, method) -> scene -> (n, components); of seeds the first, of many variants the defaults."""
    groups: dict[tuple[str, str], dict[str, NDArray[np.float64]]] = {}
    for dataset, every in comparable(at_default_rates(features)):
        rows = every[(every["name"] == _VECTOR) & (every["width"] > 2)]
        own = named(models(rows))
        for row in rows.itertuples(index=False):
            mine = model(row.method, row.variant)
            if mine not in own:
                continue
            vectors = np.asarray(row.values, dtype=np.float64).reshape(-1, int(row.width))  # type: ignore[arg-type]
            groups.setdefault((dataset, mine.title), {}).setdefault(str(row.scene), vectors)
    return groups
