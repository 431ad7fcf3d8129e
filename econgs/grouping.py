"""Which scenes are learned together: Chamfer distances of their clouds, clustered hierarchically.

ECoNGS, section "Joint Learning". The paper leaves open how the distance is defined and which linkage is used;
the defaults here reproduce its range of thresholds on the authors' own clouds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree
from scipy.spatial.distance import squareform

LINKAGES = ("average", "single", "complete")
SAMPLE = 2048
"""Points drawn of each cloud: distances within a few percent (with 512, 20 %: enough to change groups)."""


def chamfer_distances(
    clouds: Sequence[NDArray[np.floating]], *, direction: str = "mean", sample: int = SAMPLE, seed: int = 0
) -> NDArray[np.float64]:
    """(n, n) symmetric matrix of Chamfer distances between clouds of (p, 3) points.

    Squared distances to the nearest neighbour in the other cloud, averaged over the points of each cloud; the
    two directions are averaged ("mean") or added ("sum").

    Args:
        clouds: each with at least one point, in one space.
        direction: "mean" or "sum".
        sample: points drawn of each cloud, without replacement; neighbours are looked up among all.
        seed: of the drawing.

    Raises:
        ValueError: an empty cloud.
    """
    if any(len(cloud) == 0 for cloud in clouds):
        raise ValueError("an empty cloud has no distance to others")
    generator = np.random.default_rng(seed)
    trees = [cKDTree(np.asarray(cloud, dtype=np.float64)) for cloud in clouds]
    drawn = [
        tree.data if tree.n <= sample else tree.data[np.sort(generator.choice(tree.n, sample, replace=False))]
        for tree in trees
    ]
    distances = np.zeros((len(clouds), len(clouds)))
    factor = 0.5 if direction == "mean" else 1.0
    for i, points in enumerate(drawn):
        for j, tree in enumerate(trees):
            if i != j:
                nearest, _ = tree.query(points, workers=-1)
                distances[i, j] += factor * np.mean(nearest**2)
    return np.asarray(distances + distances.T)


def cluster(distances: NDArray[np.float64], threshold: float, method: str = "average") -> list[list[int]]:
    """Groups of items whose clusters merge at a distance up to the threshold.

    Args:
        distances: (n, n) symmetric with a zero diagonal.
        threshold: 0 keeps every item apart.
        method: one of :data:`LINKAGES`.

    Returns:
        Groups in the order of their first items; items ascending.
    """
    count = len(distances)
    if count < 2 or threshold <= 0.0:
        return [[i] for i in range(count)]
    labels = fcluster(linkage(squareform(distances, checks=False), method), threshold, "distance")
    groups: dict[int, list[int]] = {}
    for item, label in enumerate(labels):
        groups.setdefault(int(label), []).append(item)
    return sorted(groups.values())
