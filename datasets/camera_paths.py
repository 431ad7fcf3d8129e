"""Camera positions: icospheres for training, a spherical spiral for testing."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import NEAR, Camera
from econgs_bench.datasets.errors import DataError

FIELD_OF_VIEW = math.pi / 6
"""30 degrees, as in the views published with the paper."""

Position = tuple[float, float, float]

_MARGIN = 1.02
_TURNS = 10.0
# Phase of the spiral with the largest distance between the 181 test views and the training views of
# 6, 12, 42 and 92 cameras together (found by a scan; the tests hold the bound).
_PHASE = 1.7048


def training_cameras(
    n: int, bounding_radius: float, width: int, height: int, centre: Position | None = None
) -> tuple[Camera, ...]:
    """Cameras on the vertices of an icosphere, all looking at one point.

    Args:
        n: 6 (octahedron) or 10 f^2 + 2 (an icosahedron whose edges are cut in f parts: 12, 42, 92, ...).
        bounding_radius: radius of a sphere around the object.
        width: image width in pixels.
        height: image height in pixels; the sphere fits the shorter side.
        centre: of the sphere, x, y, z; default: the origin.

    Raises:
        DataError: no icosphere has n vertices; the remedy names the nearest numbers.
    """
    return _looking_inwards(icosphere(n), bounding_radius, width, height, centre, "train")


def test_cameras(
    n: int,
    bounding_radius: float,
    width: int,
    height: int,
    centre: Position | None = None,  # noqa: PT028
    *,
    step: float = 0.0,  # noqa: PT028
) -> tuple[Camera, ...]:
    """Cameras along a spiral from pole to pole that encloses the object (181 in the paper).

    The path has constant speed, so that frame times along it weigh all directions alike, and keeps
    away from the training cameras.

    Args:
        n: number of views.
        bounding_radius: radius of a sphere around the object.
        width: image width in pixels.
        height: image height in pixels; the sphere fits the shorter side.
        centre: of the sphere, x, y, z; default: the origin.
        step: degrees between successive cameras, around the middle of the path; 0 spreads them over the path.

    Raises:
        DataError: n < 1.
    """
    if n < 1:
        raise DataError(f"{n} test views", "there must be at least one", "Ask for 16 or 181, say")
    return _looking_inwards(spiral(n, step=step), bounding_radius, width, height, centre, "test")


test_cameras.__test__ = False  # type: ignore[attr-defined]  # pytest: no test case


def icosphere(n: int) -> NDArray[np.float64]:
    """(n, 3) unit vectors: the octahedron for 6, else 10 f^2 + 2 vertices of the icosphere.

    Raises:
        DataError: no such polyhedron has n vertices.
    """
    if n == 6:
        return np.concatenate([np.eye(3), -np.eye(3)])
    frequency = math.isqrt(max(n - 2, 0) // 10)
    if frequency < 1 or 10 * frequency**2 + 2 != n:
        near = [6, 12] if n < 12 else [10 * f**2 + 2 for f in (frequency, frequency + 1)]
        raise DataError(
            f"{n} training views",
            "training cameras stand on an octahedron (6) or an icosphere of 10 f^2 + 2 vertices",
            f"The nearest numbers are {near[0]} and {near[1]}",
        )
    vertices, faces = _icosahedron()
    points: list[NDArray[np.float64]] = []
    keys: set[tuple[int, ...]] = set()
    for a, b, c in faces:
        for i in range(frequency + 1):
            for j in range(frequency + 1 - i):
                weights = np.array([i, j, frequency - i - j]) / frequency
                point = weights @ vertices[[a, b, c]]
                point /= np.linalg.norm(point)
                key = tuple(np.round(point * 1e6).astype(int))
                if key not in keys:
                    keys.add(key)
                    points.append(point)
    return np.array(points)


def spiral(n: int, step: float = 0.0) -> NDArray[np.float64]:
    """(n, 3) unit vectors spaced evenly along a spherical spiral from pole to pole around z.

    A step in degrees places them that far apart on either side of its middle.
    """
    theta = np.linspace(0.0, math.pi, 20001)
    slope = 2.0 * _TURNS  # azimuth per polar angle
    speed = np.sqrt(1.0 + (slope * np.sin(theta)) ** 2)
    length = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])  # / spacing of theta
    places = (np.arange(n) + 0.5) / n * length[-1]
    if step:
        places = 0.5 * length[-1] + math.radians(step) / theta[1] * (np.arange(n) - 0.5 * (n - 1))
    at = np.interp(places, length, theta)
    azimuth = slope * at + _PHASE
    return np.stack([np.sin(at) * np.cos(azimuth), np.sin(at) * np.sin(azimuth), np.cos(at)], axis=-1)


def look_at_origin(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) camera-to-world with z up in the picture, or y up where the view runs along z."""
    forward = -position / np.linalg.norm(position)
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 0.999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0] = right
    matrix[:3, 1] = np.cross(forward, right)
    matrix[:3, 2] = forward
    matrix[:3, 3] = position
    return matrix


def _looking_inwards(
    directions: NDArray[np.float64],
    bounding_radius: float,
    width: int,
    height: int,
    centre: Position | None,
    prefix: str,
) -> tuple[Camera, ...]:
    """Cameras whose shorter image side spans :data:`FIELD_OF_VIEW`, which the sphere just fits."""
    distance = _MARGIN * bounding_radius / math.sin(0.5 * FIELD_OF_VIEW)
    focal = 0.5 * min(width, height) / math.tan(0.5 * FIELD_OF_VIEW)
    fov_x = 2.0 * math.atan(0.5 * width / focal)
    cameras = []
    for i, direction in enumerate(directions):
        matrix = look_at_origin(distance * direction)
        if centre is not None:
            matrix[:3, 3] += centre
        name = f"{prefix}_{i:03d}"
        cameras.append(Camera.with_fov(matrix, fov_x, width, height, name, NEAR * distance))
    return tuple(cameras)


def _icosahedron() -> tuple[NDArray[np.float64], list[tuple[int, int, int]]]:
    """Vertices (12, 3) and the 20 faces (triples of mutually nearest vertices)."""
    golden = 0.5 * (1.0 + math.sqrt(5.0))
    corners = [(0.0, s, t * golden) for s in (-1.0, 1.0) for t in (-1.0, 1.0)]
    vertices = np.array([np.roll(c, k) for k in range(3) for c in corners])
    near = np.isclose(np.linalg.norm(vertices[:, None] - vertices[None], axis=-1), 2.0)
    faces = [
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    return vertices, faces
