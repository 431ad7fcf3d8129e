"""Thinned clouds: common equipment of every method that splats."""

import numpy as np
import pytest

from econgs_bench.methods.contract.scene import tiny_scene
from econgs_bench.methods.shared.start import first_of_cells, pixel_size, thinned
from tests.methods.conftest import Fits, Recorder

METHODS = (
    "3dgs",
    "3dgs-mcmc",
    "vq-3dgs",
    "3dgs-coded",
    "scaffold-gs",
    "hac",
    "hac-plus",
    "ivr-gs",
    "veg",
    "econgs",
)


@pytest.mark.parametrize("name", METHODS)
def test_every_method_starts_from_the_thinned_cloud(name):
    scene = tiny_scene("tiny", volume="transfer")
    counts = {}
    for spacing in (0.0, 4.0):
        recorder = Recorder()
        Fits(name)(scene, recorder, 1, start_spacing=spacing, start_points=0)
        counts[spacing] = recorder.counts[0]
    points = np.asarray(scene.cloud.points, dtype=np.float32)
    assert counts == {0.0: len(points), 4.0: len(thinned(points, 4.0, scene.train.cameras))}
    assert counts[4.0] < counts[0.0]


def test_no_spacing_keeps_every_point_and_an_empty_cloud_stays_empty():
    cameras = tiny_scene("tiny").train.cameras
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    np.testing.assert_array_equal(thinned(points, 0.0, cameras), np.arange(50))
    assert len(thinned(points[:0], 3.0, cameras)) == 0
    side = 3.0 * pixel_size(cameras, points)
    np.testing.assert_array_equal(thinned(points, 3.0, cameras), first_of_cells(points, side))


def test_cells_shrink_until_enough_points_are_left():
    cameras = tiny_scene("tiny").train.cameras
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (800, 3)).astype(np.float32)
    few = len(thinned(points, 30.0, cameras))
    assert few < 100
    assert len(thinned(points, 30.0, cameras, few)) == few
    assert 100 <= len(thinned(points, 30.0, cameras, 100)) < 400
    assert len(thinned(points, 30.0, cameras, 10_000)) == 800
    assert len(thinned(np.repeat(points[:7], 5, 0), 30.0, cameras, 100)) == 7
    assert len(thinned(points, 0.0, cameras, 10)) == 800


@pytest.mark.parametrize("name", METHODS)
def test_every_method_takes_the_least_number_of_points(name):
    scene = tiny_scene("tiny", volume="transfer")
    points = np.asarray(scene.cloud.points, dtype=np.float32)
    counts = {}
    for least in (0, len(points)):
        recorder = Recorder()
        Fits(name)(scene, recorder, 1, start_spacing=4.0, start_points=least)
        counts[least] = recorder.counts[0]
    assert counts[len(points)] == len(np.unique(points, axis=0)) > counts[0]
