"""Harder conditions: what they change, and that they change nothing else."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from econgs_bench.datasets import stress
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.camera_paths import training_cameras
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.cloud import PointCloud, random_cloud
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.units import camera_in_units, scene_in_units

CAMERAS = training_cameras(42, 0.5, 16, 12, (0.2, 0.0, 0.1))


def test_chosen_views_surround_the_scene() -> None:
    chosen = stress.spread_out(CAMERAS, 6)
    assert chosen == sorted(set(chosen))
    places = np.stack([CAMERAS[i].position for i in chosen]) - [0.2, 0.0, 0.1]
    angles = np.degrees(np.arccos(np.clip(places @ places.T / np.linalg.norm(places[0]) ** 2, -1, 1)))
    assert angles[~np.eye(6, dtype=bool)].min() > 55.0  # of the octahedron: 90
    assert set(stress.spread_out(CAMERAS, 3)) < set(chosen)
    assert stress.spread_out(CAMERAS, 42) == list(range(42))
    with pytest.raises(DataError, match="there are 42"):
        stress.spread_out(CAMERAS, 43)


def test_hemisphere_and_ring() -> None:
    height = np.array([camera.position[2] for camera in CAMERAS]) - 0.1
    distance = np.linalg.norm(CAMERAS[0].position - [0.2, 0.0, 0.1])
    upper, ring = (stress.one_sided(CAMERAS, side) for side in ("hemisphere", "ring"))
    assert len(upper) + (height < -1e-6).sum() == 42
    assert (height[upper] > -1e-6).all()
    assert 4 <= len(ring) < len(upper)
    assert (np.abs(height[ring]) < math.sin(math.radians(20.001)) * distance).all()
    poles = [replace(CAMERAS[0], camera_to_world=_at(z)) for z in (-1.0, 1.0)]
    with pytest.raises(DataError, match="1 of 2"):
        stress.one_sided(poles, "hemisphere")


def _at(z: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[2, 3] = z
    return matrix


def test_noise_has_its_deviation_and_leaves_valid_pictures() -> None:
    images = np.full((3, 64, 64, 4), (0.3, 0.4, 0.5, 0.8), np.float32)
    result = stress.noisy(images, 4.0, np.random.default_rng(0))
    levels = 255.0 * result
    assert np.abs(levels - np.rint(levels)).max() < 1e-4
    assert np.allclose(levels.std(axis=(0, 1, 2)), math.sqrt(16 + 1 / 12), rtol=0.05)
    assert np.allclose(levels.mean(axis=(0, 1, 2)), 255.0 * images[0, 0, 0], atol=0.2)
    for empty in (np.zeros_like(images), np.ones_like(images)):
        result = stress.noisy(empty, 40.0, np.random.default_rng(0))
        assert result.min() >= 0.0
        assert result.max() <= 1.0
        assert (result[..., :3] <= result[..., 3:]).all()


def test_turned_cameras_stay_in_place() -> None:
    generator = np.random.default_rng(0)
    for camera in CAMERAS[:5]:
        turned = stress.turned(camera, 2.0, generator)
        assert (turned.position == camera.position).all()
        change = turned.camera_to_world[:3, :3] @ camera.camera_to_world[:3, :3].T
        assert math.degrees(Rotation.from_matrix(change).magnitude()) == pytest.approx(2.0)


def test_clouds() -> None:
    centre, radius = stress.seen_sphere(CAMERAS)
    assert centre == pytest.approx([0.2, 0.0, 0.1], abs=1e-9)
    assert radius == pytest.approx(0.5 * 1.02)  # with the margin of training cameras
    cloud = stress.scattered_cloud(CAMERAS, 1000, 0)
    assert len(cloud) == 1000
    assert np.linalg.norm(cloud.points - centre, axis=1).max() <= radius
    own = random_cloud(200, 0.1)
    worse = stress.with_outliers(own, CAMERAS, 0)
    moved = (worse.points != own.points).any(axis=1)
    assert moved.sum() == 20
    assert np.abs(worse.points[moved] - centre).max() > 5.0 * radius
    assert (worse.colors[~moved] == own.colors[~moved]).all()
    assert isinstance(stress.with_outliers(random_cloud(1, 0.1), CAMERAS, 0), PointCloud)


def test_other_units_are_the_same_picture() -> None:
    camera = camera_in_units(CAMERAS[3], 1000.0)
    point = np.array([0.1, 0.2, -0.3])

    def pixel(camera: Camera, at: np.ndarray) -> np.ndarray:
        x, y, z = camera.world_to_camera[:3, :3] @ at + camera.world_to_camera[:3, 3]
        return np.array([camera.fx * x / z, camera.fy * y / z])

    assert pixel(camera, 1000.0 * point) == pytest.approx(pixel(CAMERAS[3], point))
    scene = open_dataset("vortices").scene("cores")
    bigger = scene_in_units(scene, 10.0)
    values = np.linspace(0, 1, 50)
    small, large = (one.transfer.classify(values)[:, 3] for one in (scene, bigger))
    assert large == pytest.approx(small / 10.0)
