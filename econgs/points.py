"""Distances within point clouds."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

_LEAST_SQUARED_DISTANCE = 1e-7


def neighbour_distances(points: Tensor, fallback: float) -> Tensor:
    """(N,) root mean square distance to the three nearest neighbours (in small clouds to all).

    Args:
        points: (N, 3), N >= 1.
        fallback: distance of a lone point.
    """
    if len(points) == 1:
        return torch.full((1,), fallback)
    table = points.cpu().numpy().astype(np.float64)
    distances, _ = cKDTree(table).query(table, k=min(4, len(table)))
    squared = np.square(distances[:, 1:]).mean(axis=1)  # column 0 is the point itself
    return torch.from_numpy(np.sqrt(np.maximum(squared, _LEAST_SQUARED_DISTANCE)).astype(np.float32))


def median_neighbour_distance(points: Tensor, fallback: float) -> float:
    """Median distance of (N, 3) points to their nearest neighbours; ``fallback`` if it is 0 or N = 1."""
    table = points.cpu().numpy().astype(np.float64)
    if len(table) == 1:
        return fallback
    distances, _ = cKDTree(table).query(table, k=2)
    return float(np.median(distances[:, 1])) or fallback
