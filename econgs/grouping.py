"""Groups of scenes for joint learning: hierarchical clusters by Chamfer distances of their clouds.

ECoNGS, section "Joint Learning". The paper leaves the definition of the distance and the linkage open;
the defaults here reproduce its range of thresholds on the authors' own clouds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import squareform

from econgs_bench.econgs.codec.positions import morton_order

SAMPLE = 512
"""Sampled points of each cloud: distances within 3 %, as with 2,048 random points."""


def chamfer_distances(
    clouds: Sequence[NDArray[np.floating]], *, direction: str = "mean", sample: int = SAMPLE
) -> NDArray[np.float64]:
    """(n, n) symmetric matrix of Chamfer distances between clouds of (p, 3) points.

    A distance is the mean squared distance to the nearest neighbour in the other cloud, over points spread
    evenly over each cloud; the two directions are averaged ("mean") or added ("sum").

    Args:
        clouds: clouds of at least one point each, in one space.
        direction: "mean" or "sum".
        sample: number of points of each cloud that look for neighbours among all points of the other.

    Raises:
        ValueError: an empty cloud.
    """
    if any(len(cloud) == 0 for cloud in clouds):
        raise ValueError("an empty cloud has no distance to others")
    points = [np.asarray(cloud, dtype=np.float64) for cloud in clouds]
    samples = [_spread(cloud, sample) for cloud in points]
    owner = np.repeat(np.arange(len(samples)), [len(some) for some in samples])
    queries = np.concatenate(samples) if samples else np.zeros((0, 3))
    factor = 0.5 if direction == "mean" else 1.0
    distances = np.zeros((len(clouds), len(clouds)))
    for j, cloud in enumerate(points):
        others = owner != j
        nearest, _ = cKDTree(cloud).query(queries[others], workers=-1)
        sums = np.bincount(owner[others], weights=nearest**2, minlength=len(samples))
        distances[:, j] = factor * sums / [len(some) for some in samples]
    return np.asarray(distances + distances.T)


def _spread(cloud: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Points at equal steps along a Z-order curve, which keeps neighbours together; all of a small cloud."""
    if len(cloud) <= count:
        return cloud
    extent = max(float(np.ptp(cloud, axis=0).max()), 1e-12)
    cells = ((cloud - cloud.min(axis=0)) * (1023.0 / extent)).astype(np.int64)
    order = morton_order(cells)
    indices = order[((np.arange(count) + 0.5) * (len(cloud) / count)).astype(int)]
    return np.asarray(cloud[indices])


def cluster(distances: NDArray[np.float64], threshold: float, method: str = "average") -> list[list[int]]:
    """Groups of items whose clusters merge up to a distance.

    Args:
        distances: (n, n) symmetric with a zero diagonal.
        threshold: largest distance of a merge; 0 keeps every item apart.
        method: linkage of SciPy: "average", "single" or "complete".

    Returns:
        Groups in the order of their first items; items ascending.
    """
    count = len(distances)
    if count < 2 or threshold <= 0.0:
        return [[i] for i in range(count)]
    from scipy.cluster.hierarchy import fcluster, linkage  # only partitions need it; its import takes long

    labels = fcluster(linkage(squareform(distances, checks=False), method), threshold, "distance")
    groups: dict[int, list[int]] = {}
    for item, label in enumerate(labels):
        groups.setdefault(int(label), []).append(item)
    return sorted(groups.values())
