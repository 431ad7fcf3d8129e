"""Harder conditions for methods: fewer and worse training views, worse initial clouds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera, rotation
from econgs_bench.datasets.cloud import PointCloud, random_cloud
from econgs_bench.datasets.errors import DataError

Side = Literal["hemisphere", "ring"]
RING = 20.0
"""Greatest elevation of a ring's cameras in degrees."""
OUTLIERS = 0.1
"""Share of outliers among the points of a cloud."""
OUTLIER_REACH = 10.0
"""Half-side of the outliers' cube / radius of what the cameras see."""


def spread_out(cameras: Sequence[Camera], count: int) -> list[int]:
    """Indices of ``count`` cameras, in order, chosen one by one as far as possible from those before.

    Raises:
        DataError: there are fewer.
    """
    if count > len(cameras):
        raise DataError(f"views={count}", f"there are {len(cameras)} training views", "Ask for fewer")
    places = np.stack([camera.position for camera in cameras])
    chosen = [0]
    while len(chosen) < count:
        apart = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(apart.argmax()))
    return sorted(chosen)


def one_sided(cameras: Sequence[Camera], side: Side) -> list[int]:
    """Indices of the cameras at or above the middle of all, or of those near the horizontal plane through it.

    Raises:
        DataError: fewer than two are there.
    """
    places = np.stack([camera.position for camera in cameras])
    offsets = places - places.mean(axis=0)
    elevation = np.degrees(np.arcsin(offsets[:, 2] / np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)))
    kept = elevation > -1e-6 if side == "hemisphere" else np.abs(elevation) <= RING
    if kept.sum() < 2:
        raise DataError(
            f"cameras={side}",
            f"{kept.sum()} of {len(cameras)} training views are there",
            "Ask for more training views",
        )
    return [int(index) for index in np.flatnonzero(kept)]


def noisy(
    images: NDArray[np.float32], deviation: float, generator: np.random.Generator
) -> NDArray[np.float32]:
    """Pictures with normal noise on all four channels, rounded to 8 bits; no color exceeds its alpha.

    Args:
        images: (n, height, width, 4) premultiplied RGBA in [0, 1].
        deviation: standard deviation of the noise in steps of 1/255.
        generator: source of the noise.
    """
    result = np.empty_like(images)
    for image, out in zip(images, result, strict=True):
        noise = generator.standard_normal(image.shape, dtype=np.float32)
        levels = np.rint(np.clip(255.0 * image + deviation * noise, 0.0, 255.0)) / 255.0
        out[..., 3] = levels[..., 3]
        out[..., :3] = np.minimum(levels[..., :3], levels[..., 3:])
    return result


def turned(camera: Camera, degrees: float, generator: np.random.Generator) -> Camera:
    """A camera turned about its own centre by an angle, around a random axis."""
    axis = generator.standard_normal(3)
    matrix = camera.camera_to_world.copy()
    matrix[:3, :3] = rotation(axis / np.linalg.norm(axis), math.radians(degrees)) @ matrix[:3, :3]
    return replace(camera, camera_to_world=matrix)


def seen_sphere(cameras: Sequence[Camera]) -> tuple[NDArray[np.float64], float]:
    """Centre and radius of the sphere around the middle of all cameras that their shorter sides show."""
    places = np.stack([camera.position for camera in cameras])
    centre = places.mean(axis=0)
    first = cameras[0]
    half = math.atan(min(0.5 * first.width / first.fx, 0.5 * first.height / first.fy))
    return centre, float(np.linalg.norm(places - centre, axis=1).mean() * math.sin(half))


def scattered_cloud(cameras: Sequence[Camera], points: int, seed: int) -> PointCloud:
    """A cloud of random points and colors in the cube within the sphere that cameras see."""
    centre, radius = seen_sphere(cameras)
    cloud = random_cloud(points, radius / math.sqrt(3.0), seed)
    return PointCloud((cloud.points + centre).astype(np.float32), cloud.colors)


def with_outliers(cloud: PointCloud, cameras: Sequence[Camera], seed: int) -> PointCloud:
    """A cloud with :data:`OUTLIERS` of its points, at least one, moved far away, with random colors."""
    centre, radius = seen_sphere(cameras)
    count = max(1, round(OUTLIERS * len(cloud)))
    far = random_cloud(count, OUTLIER_REACH * radius, seed)
    moved = np.random.default_rng(seed).choice(len(cloud), count, replace=False)
    points, colors = cloud.points.copy(), cloud.colors.copy()
    points[moved] = far.points + centre
    colors[moved] = far.colors
    return PointCloud(points, colors)
