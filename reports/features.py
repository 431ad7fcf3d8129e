"""What the charts of per-primitive attributes draw: histograms, and a map of anchors by their features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reports.style import label

if TYPE_CHECKING:
    import pandas as pd

BINS = 60
_TAIL = 0.002
"""Share of the samples at each end that a histogram's axis leaves out."""
MOST_ANCHORS = 4000
_LEAST_ANCHORS = 30
VECTOR = "features"
"""Name of the attribute that the map is of."""


class Missing(Exception):
    """Why a chart is left out."""


@dataclass(frozen=True)
class Histogram:
    """Samples of one attribute on one dataset.

    Attributes:
        edges: of the bins, ascending.
        shares: series -> percent of its samples in each bin.
    """

    dataset: str
    attribute: str
    edges: list[float]
    shares: dict[str, list[float]]


def histograms(features: pd.DataFrame) -> list[Histogram]:
    """Of all attributes; scenes, seeds and the components of a vector are pooled.

    Args:
        features: the documented table.
    """
    pools: dict[tuple[str, str], dict[str, list[NDArray[np.float64]]]] = {}
    for row in features.itertuples(index=False):
        values = np.asarray(row.values, dtype=np.float64)
        name = label(row.method, row.variant)
        pools.setdefault((str(row.dataset), str(row.name)), {}).setdefault(name, []).append(
            values[np.isfinite(values)]
        )
    made = []
    for (dataset, attribute), by_name in pools.items():
        joined = {name: np.concatenate(arrays) for name, arrays in by_name.items()}
        joined = {name: values for name, values in joined.items() if len(values)}
        if not joined:
            continue
        ends = [np.quantile(values, [_TAIL, 1 - _TAIL]) for values in joined.values()]
        low, high = float(min(e[0] for e in ends)), float(max(e[1] for e in ends))
        if low == high:
            low, high = low - 0.5, high + 0.5
        edges = np.linspace(low, high, BINS + 1)
        shares = {
            name: [float(v) for v in 100.0 * np.histogram(values, edges)[0] / len(values)]
            for name, values in joined.items()
        }
        made.append(Histogram(dataset, attribute, [float(e) for e in edges], shares))
    return made


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
    """UMAP of the vectors that anchors carry (the attribute :data:`VECTOR`).

    Args:
        features: the documented table.

    Raises:
        Missing: there are none, or the package is not installed; the text says which.
    """
    vectors = _vectors(features)
    if not vectors:
        raise Missing("no method of this report offers its anchors' feature vectors")
    try:
        import umap
    except ImportError as error:
        raise Missing("the optional package umap-learn is not installed: pip install umap-learn") from error
    made = []
    for (dataset, title), scenes in vectors.items():
        each = MOST_ANCHORS // len(scenes)
        rng = np.random.default_rng(0)
        taken = {scene: rows[np.sort(rng.permutation(len(rows))[:each])] for scene, rows in scenes.items()}
        every = np.concatenate(list(taken.values()))
        if len(every) < _LEAST_ANCHORS:
            continue
        spots = umap.UMAP(random_state=0, n_jobs=1).fit_transform(every).astype(np.float64)
        ends = np.cumsum([len(rows) for rows in taken.values()])[:-1]
        made.append(Map(dataset, title, dict(zip(taken, np.split(spots, ends), strict=True))))
    return made


def _vectors(features: pd.DataFrame) -> dict[tuple[str, str], dict[str, NDArray[np.float64]]]:
    """(dataset, method) -> scene -> (n, components); of seeds the first."""
    found: dict[tuple[str, str], dict[str, NDArray[np.float64]]] = {}
    if features.empty or "width" not in features:
        return found
    for row in features[(features["name"] == VECTOR) & (features["width"] > 2)].itertuples(index=False):
        vectors = np.asarray(row.values, dtype=np.float64).reshape(-1, int(row.width))  # type: ignore[arg-type]
        scenes = found.setdefault((str(row.dataset), label(row.method, row.variant)), {})
        scenes.setdefault(str(row.scene), vectors)
    return found
