"""Folders of views for other trainers, read by ``pycolmap`` and by this project's own readers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from econgs_bench.datasets import colmap
from econgs_bench.datasets.blender import read_transforms
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.cloud import random_cloud, read_ply
from econgs_bench.datasets.png import read_png
from econgs_bench.datasets.posed_images import read_frames
from econgs_bench.datasets.scene import BasicScene
from econgs_bench.datasets.view_folders import FORMATS, write_cameras, write_training
from econgs_bench.datasets.views import ViewSet, over

BACKGROUND = (0.25, 0.5, 1.0)
SCENE = BasicScene("a", views_folder=Path("/secret"), background=BACKGROUND)
CLOUD = random_cloud(30, 0.5)


@pytest.fixture(scope="module")
def views() -> ViewSet:
    """Cameras with unlike intrinsics, principal points aside of the middle, and any rotation."""
    generator = np.random.default_rng(3)
    cameras = []
    for i in range(11):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.random(rng=generator).as_matrix()
        matrix[:3, 3] = generator.uniform(-2.0, 2.0, 3)
        cameras.append(Camera(matrix, 9.0 + i % 2, 11.0, 4.25, 2.75, 8, 6))
    alpha = generator.random((11, 6, 8, 1), dtype=np.float32)
    images = np.concatenate([alpha * generator.random((11, 6, 8, 3), dtype=np.float32), alpha], axis=-1)
    return ViewSet(tuple(cameras), images, BACKGROUND, "key")


def _same_cameras(read: list[Camera], written: tuple[Camera, ...]) -> None:
    assert [camera.name for camera in read] == [f"{i:04d}" for i in range(len(written))]
    for one, other in zip(read, written, strict=True):
        np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, rtol=0, atol=1e-6)
        numbers = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in (one, other)]
        np.testing.assert_allclose(*numbers, rtol=0, atol=1e-6)


@pytest.mark.parametrize("format", FORMATS)
def test_what_is_written_is_read_back(tmp_path: Path, views: ViewSet, format) -> None:
    write_training(tmp_path, format, views, CLOUD, SCENE, "rgba")
    if format == "blender":
        frames, (points, colors) = read_frames(tmp_path, "train"), (None, None)
        cloud = read_ply(tmp_path / "points3d.ply")
        points, colors = cloud.points, cloud.colors
    else:
        model = colmap.model_of(tmp_path)
        assert model is not None
        frames = colmap.read_frames(tmp_path, model)
        found = colmap.read_points(model)
        assert found is not None
        points, colors = found
    _same_cameras([camera for camera, _ in frames], views.cameras)
    np.testing.assert_allclose(points, CLOUD.points, rtol=0, atol=1e-6)
    np.testing.assert_allclose(colors, CLOUD.colors, rtol=0, atol=0.5 / 255 + 1e-6)
    for (_, picture), image in zip(frames, views.images, strict=True):
        np.testing.assert_allclose(read_png(picture), image, rtol=0, atol=1.01 / 255)
    about = json.loads((tmp_path / "scene.json").read_text())
    assert about["background"] == list(BACKGROUND)
    assert "secret" not in json.dumps(about)


@pytest.mark.parametrize("format", ["colmap", "colmap-text"])
def test_pycolmap_reads_the_same(tmp_path: Path, views: ViewSet, format) -> None:
    write_training(tmp_path, format, views, CLOUD, SCENE)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert (model.num_cameras(), model.num_images(), model.num_points3D()) == (2, 11, 30)
    by_name = {image.name: image for image in model.images.values()}
    for index, camera in enumerate(views.cameras):
        image = by_name[f"{index:04d}.png"]
        pose = image.cam_from_world()
        np.testing.assert_allclose(pose.matrix(), camera.world_to_camera[:3], rtol=0, atol=1e-6)
        lens = model.cameras[image.camera_id]
        assert lens.model.name == "PINHOLE"
        assert (lens.width, lens.height) == (8, 6)
        np.testing.assert_allclose(lens.params, [camera.fx, camera.fy, camera.cx, camera.cy], atol=1e-6)
        point = camera.camera_to_world[:3] @ [0.3, -0.2, 2.0, 1.0]
        pixel = lens.img_from_cam(pose * point)
        np.testing.assert_allclose(pixel, [camera.fx * 0.15 + camera.cx, camera.fy * -0.1 + camera.cy])
    points = np.stack([model.points3D[i].xyz for i in range(1, 31)])
    np.testing.assert_allclose(points, CLOUD.points, rtol=0, atol=1e-6)
    colors = np.stack([model.points3D[i].color for i in range(1, 31)])
    np.testing.assert_allclose(colors, np.rint(255 * CLOUD.colors), rtol=0, atol=0)


def test_pictures_without_alpha_are_on_the_background(tmp_path: Path, views: ViewSet) -> None:
    write_training(tmp_path, "colmap", views, CLOUD, SCENE)
    with Image.open(tmp_path / "images" / "0002.png") as picture:
        assert picture.mode == "RGB"
        pixels = np.asarray(picture) / 255.0
    np.testing.assert_allclose(pixels, over(views.images[2], BACKGROUND), rtol=0, atol=0.51 / 255)


@pytest.mark.parametrize("format", FORMATS)
def test_cameras_come_with_blank_pictures(tmp_path: Path, views: ViewSet, format) -> None:
    cameras = tuple(replace(camera, name="") for camera in views.cameras)
    write_cameras(tmp_path, format, cameras, None)
    if format == "blender":
        frames = read_transforms(tmp_path / "transforms_test.json")
        _same_cameras([camera for camera, _ in read_frames(tmp_path, "train")], cameras)
    else:
        model = colmap.model_of(tmp_path)
        assert model is not None
        frames = colmap.read_frames(tmp_path, model)
    _same_cameras([camera for camera, _ in frames], cameras)
    assert not any(read_png(picture).any() for _, picture in frames)
