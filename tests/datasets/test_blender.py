"""Camera conventions: what Blender sees at a pixel is what our camera sees there."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datasets.blender import read_transforms
from datasets.camera import Camera
from datasets.camera_paths import training_cameras
from datasets.errors import DataError
from datasets.prerendered import load_views
from datasets.views import ViewRequest, evenly_spaced
from tests.datasets.damage import check_damage
from tests.datasets.views_folder import random_views, write_transforms


def test_a_blender_camera_looks_along_minus_z_with_y_up(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = [1.0, 2.0, 3.0]
    content = {"camera_angle_x": math.pi / 2, "w": 4, "h": 2}
    content["frames"] = [{"file_path": "a/b", "transform_matrix": matrix.tolist()}]
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps(content))
    ((camera, file),) = read_transforms(path)
    assert file == tmp_path / "a/b.png"
    origin, directions = camera.rays()
    np.testing.assert_allclose(origin, [1, 2, 3])
    # In NeRF's convention a pixel (u, v) looks along ((u - cx) / f, -(v - cy) / f, -1).
    expected = np.array([(0.5 - 2) / 2, -(0.5 - 1) / 2, -1.0])
    np.testing.assert_allclose(directions[0, 0], expected / np.linalg.norm(expected), atol=1e-12)


@pytest.mark.parametrize(
    "cameras", [training_cameras(12, 0.7, 20, 10), (Camera(np.eye(4), 10.0, 12.0, 3.0, 4.5, 8, 8, "x"),)]
)
def test_cameras_of_any_intrinsics(tmp_path: Path, cameras: tuple[Camera, ...]) -> None:
    path = tmp_path / "transforms_test.json"
    write_transforms(path, cameras)
    for before, (after, file) in zip(cameras, read_transforms(path), strict=True):
        np.testing.assert_allclose(after.camera_to_world, before.camera_to_world, atol=1e-12)
        assert (after.fx, after.fy, after.cx, after.cy) == (before.fx, before.fy, before.cx, before.cy)
        assert (after.width, after.height, after.name) == (before.width, before.height, before.name)
        assert file == tmp_path / "test" / f"{before.name}.png"


FRAME = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
CAMERA = {"camera_angle_x": 0.5, "w": 4, "h": 4}
BAD = [
    {},
    {"frames": []},
    {"frames": [FRAME]},
    {**CAMERA, "frames": [{"file_path": "a"}]},
    *(
        {**CAMERA, "frames": [{**FRAME, "transform_matrix": matrix}]}
        for matrix in ([[1, 2]], (2 * np.eye(4)).tolist(), "x")
    ),
    *({**CAMERA, **wrong, "frames": [FRAME]} for wrong in ({"camera_angle_x": 9.0}, {"w": "4"}, {"w": -4})),
    {**CAMERA, "frames": [{"transform_matrix": np.eye(4).tolist()}]},
]


@pytest.mark.parametrize("content", BAD)
def test_bad_transforms(tmp_path: Path, content: dict) -> None:
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps(content))
    with pytest.raises(DataError):
        read_transforms(path)


def test_damaged_transforms(tmp_path: Path) -> None:
    def check(path: Path) -> None:
        with suppress(DataError):
            for camera, _ in read_transforms(path):
                rotation = camera.camera_to_world[:3, :3]
                np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)

    cameras = training_cameras(6, 1.0, 4, 4)
    path = tmp_path / "transforms_train.json"
    check_damage(path, lambda path: write_transforms(path, cameras), check, "cut", "set", many=60)


@pytest.mark.parametrize(
    ("split", "expected"), [("train", [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 11]), ("val", [9])]
)
def test_splits_and_premultiplied_area_average(tmp_path: Path, split: str, expected: list[int]) -> None:
    scene = random_views(tmp_path)
    views = load_views(scene, ViewRequest(split, 92, 91, 4, 4))
    assert [camera.name for camera in views.cameras] == [f"r_{i:04d}" for i in expected]
    pixels = np.asarray(Image.open(tmp_path / "train" / f"r_{expected[0]:04d}.png")) / 255.0
    pixels[..., :3] *= pixels[..., 3:]
    by_hand = np.stack(
        [pixels[i : i + 2, j : j + 2].mean((0, 1)) for i in (0, 2, 4, 6) for j in (0, 2, 4, 6)]
    )
    np.testing.assert_allclose(views.images[0].reshape(-1, 4), by_hand, atol=1e-6)
    assert views.cameras[0].width == 4
    assert views.cameras[0].fov_x == pytest.approx(0.5)


def test_fewer_views_are_evenly_spaced(tmp_path: Path) -> None:
    scene = random_views(tmp_path, n=20)
    views = load_views(scene, ViewRequest("test", 92, 5, 8, 8))
    assert [camera.name for camera in views.cameras] == ["r_0000", "r_0004", "r_0008", "r_0012", "r_0016"]
    assert len(load_views(scene, ViewRequest("trainval", 10, 5, 8, 8))) == 10
    assert len(set(evenly_spaced(92, 42))) == 42
    train, test = (load_views(scene, ViewRequest(s, 10, 5, 8, 8)).key for s in ("train", "test"))
    assert train != test


def test_pictures_without_alpha_are_opaque(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    views = load_views(random_views(tmp_path, mode="RGB"), ViewRequest("train", 92, 91, 8, 8))
    assert (views.images[..., 3] == 1.0).all()
    assert "transparency" in caplog.text


@pytest.mark.parametrize("size", [(3, 3), (16, 16), (4, 8), (0, 0)])
def test_sizes_that_do_not_divide(tmp_path: Path, size: tuple[int, int]) -> None:
    with pytest.raises(DataError, match="do not divide evenly"):
        load_views(random_views(tmp_path), ViewRequest("train", 92, 91, *size))


def test_missing_and_damaged_pictures(tmp_path: Path) -> None:
    scene = random_views(tmp_path)
    with pytest.raises(DataError, match="empty"):
        load_views(scene, ViewRequest("val", 6, 91, 8, 8))
    (tmp_path / "train/r_0003.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match=r"r_0003\.png"):
        load_views(scene, ViewRequest("train", 92, 91, 8, 8))
    (tmp_path / "train/r_0003.png").unlink()
    with pytest.raises(DataError, match=r"r_0003\.png: no such picture"):
        load_views(scene, ViewRequest("train", 92, 91, 8, 8))
