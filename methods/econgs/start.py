"""Start of a scene: points of its anchors, and the color of its palette."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from econgs_bench.methods.econgs.spec import EcongsOptions
from econgs_bench.methods.interface import SceneInput
from econgs_bench.methods.shared.anchors import start_cloud
from econgs_bench.methods.shared.start import thinned


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
    points = points[thinned(points, options.start_spacing, scene.train.cameras, options.start_points)]
    return points, np.full(3, 0.5, np.float32) if start == "positions" else color
