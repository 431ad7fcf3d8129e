"""Start of a scene: points of its anchors, and the color of its palette."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from datasets.camera import Camera
from methods.econgs.spec import EcongsOptions
from methods.interface import SceneInput
from methods.shared.anchors import start_cloud


def starting_points(
    scene: SceneInput, options: EcongsOptions, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Points that become anchors, and the first palette color.

    An anchor carries several Gaussians; closer together than a few pixels they compete for the same ones. So
    the cloud is thinned to one point per cell of ``start_spacing`` pixels, and growth adds what is missing.

    Returns:
        (n, 3) points, scene units; (3,) displayed sRGB in [0, 1].

    Raises:
        Refused: the cloud is empty.
    """
    cloud, start = start_cloud(scene, options, seed), options.start
    points = np.array(cloud.points, dtype=np.float32)
    color = np.array(cloud.colors, dtype=np.float32).mean(axis=0)
    if start == "random":
        return points, color
    many = options.cloud_points
    if 0 < many < len(points):
        points = points[np.random.default_rng(seed).permutation(len(points))[:many]]
    side = options.start_spacing * pixel_size(scene.train.cameras, points)
    points = one_per_cell(points, side)
    return points, np.full(3, 0.5, np.float32) if start == "positions" else color


def pixel_size(cameras: Sequence[Camera], points: NDArray[np.float32]) -> float:
    """Scene units that a pixel covers at the middle of the points: the median over cameras."""
    centre = points.mean(axis=0)
    return float(np.median([np.linalg.norm(one.position - centre) / one.fx for one in cameras]))


def one_per_cell(points: NDArray[np.float32], side: float) -> NDArray[np.float32]:
    """The first point in each cell of a lattice of this side, in the order of the points; all if it is 0."""
    if side <= 0.0:
        return points
    cells = np.floor(points.astype(np.float64) / side).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(first)]
