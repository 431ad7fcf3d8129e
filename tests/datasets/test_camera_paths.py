from __future__ import annotations

import numpy as np
import pytest

from econgs_bench.datasets import camera_paths
from econgs_bench.datasets.camera import pixel_size
from econgs_bench.datasets.camera_paths import icosphere, spiral, training_cameras
from econgs_bench.datasets.errors import DataError


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b.T, -1.0, 1.0)))


@pytest.mark.parametrize("n", [6, 12, 42, 92, 162, 252])
def test_icosphere_has_n_evenly_spread_unit_vectors(n):
    points = icosphere(n)
    assert points.shape == (n, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(points.sum(0), 0.0, atol=1e-9)
    nearest = np.sort(degrees_between(points, points), axis=1)[:, 1]
    assert nearest.max() < 1.3 * nearest.min()


@pytest.mark.parametrize(
    ("n", "near"),
    [(0, "6 and 12"), (7, "6 and 12"), (13, "12 and 42"), (91, "42 and 92"), (100, "92 and 162")],
)
def test_other_numbers_are_refused_with_the_nearest_ones(n, near):
    with pytest.raises(DataError, match=near):
        icosphere(n)


def test_no_test_view_coincides_with_a_training_view():
    training = np.concatenate([icosphere(n) for n in (6, 12, 42, 92)])
    for n in (16, 32, 181):
        assert degrees_between(spiral(n), training).min() > 1.5


def test_the_test_path_encloses_the_object_at_constant_speed():
    path = spiral(181)
    everywhere = icosphere(10 * 20**2 + 2)
    assert degrees_between(everywhere, path).min(axis=1).max() < 14.0
    steps = np.diag(degrees_between(path[:-1], path[1:]))
    assert steps.max() < 1.25 * steps.min()


def test_a_step_makes_neighbouring_frames_in_the_middle_of_the_path():
    frames = spiral(16, step=1.0)
    np.testing.assert_allclose(np.diag(degrees_between(frames[:-1], frames[1:])), 1.0, rtol=0.01)
    assert degrees_between(spiral(20001), frames).min(axis=0).max() < 0.1
    np.testing.assert_allclose(spiral(16)[7:9].mean(axis=0)[2], frames.mean(axis=0)[2], atol=0.01)


@pytest.mark.parametrize(("width", "height"), [(64, 64), (96, 48), (40, 80)])
def test_cameras_look_inwards_and_just_see_the_bounding_sphere(width, height):
    radius = 0.7
    surface = radius * icosphere(10 * 15**2 + 2)
    for cameras in (
        training_cameras(42, radius, width, height),
        training_cameras(6, radius, width, height),  # looks along the poles
        camera_paths.test_cameras(16, radius, width, height),
    ):
        for camera in cameras:
            rotation = camera.camera_to_world[:3, :3]
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) == pytest.approx(1.0)
            local = surface @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
            u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
            v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
            assert u.min() >= 0.0
            assert u.max() <= width
            assert v.min() >= 0.0
            assert v.max() <= height
            used = max(np.ptp(u) / width, np.ptp(v) / height)
            assert used > 0.93
    names = [c.name for c in training_cameras(12, radius, width, height)]
    assert len(set(names)) == 12


def test_the_pixel_at_what_cameras_look_at():
    around = training_cameras(42, 0.7, 64, 64, (5.0, -1.0, 2.0))
    expected = np.linalg.norm(around[0].position - [5.0, -1.0, 2.0]) / around[0].fx
    for cameras in (around, around[:3], around[20:22]):
        assert pixel_size(cameras) == pytest.approx(expected)
    assert pixel_size(around[:1]) == 0.0


def test_z_points_up_in_the_picture():
    for camera in training_cameras(42, 1.0, 32, 32):
        up = -camera.camera_to_world[:3, 1]
        assert up[2] >= -1e-9


def test_no_test_views_is_refused():
    with pytest.raises(DataError, match="at least one"):
        camera_paths.test_cameras(0, 1.0, 8, 8)
