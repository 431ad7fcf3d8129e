"""Sparse models of COLMAP, as its own library writes them: it says where a point is in a picture."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from econgs_bench.datasets import colmap
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.catalogue.opening import open_dataset
from econgs_bench.datasets.cloud import initial_cloud
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.posed_images import read_frames, remarks
from econgs_bench.datasets.prerendered import load_views
from econgs_bench.datasets.views import ViewRequest
from tests.datasets.damage import check_damage

KINDS = ("bin", "txt")
POINTS = np.array([[0.1, 0.2, 0.3], [-0.3, 0.1, 0.0], [0.0, -0.2, 0.25]])


def model(
    folder: Path, kind: str, camera: pycolmap.Camera | None = None, names: Sequence[str] = (), points: int = 3
) -> pycolmap.Reconstruction:
    """A scene of a COLMAP model around the origin, in ``sparse/0`` and ``images``."""
    names = names or [f"cam{'AB'[i % 2]}/view {i // 2}.png" for i in range(16)]
    camera = camera or lens("PINHOLE", [50.0, 55.0, 33.0, 23.0])
    whole = pycolmap.Reconstruction()
    whole.add_camera_with_trivial_rig(camera)
    for i, name in enumerate(names):
        image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
        image.points2D = [pycolmap.Point2D(np.array([1.5, 2.5]))] * (i % 3)
        angle = 2 * math.pi * i / len(names)
        turn = pycolmap.Rotation3d(np.array([0.3, angle, 0.1 * i]))
        whole.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, np.array([0.02 * i, 0.1, 3.0])))
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGBA", (64, 48), (i, 100, 200, 255)).save(path, "PNG")
    for point, color in list(zip(POINTS, ([1, 2, 3], [255, 0, 128], [9, 9, 9]), strict=True))[:points]:
        whole.add_point3D(point, pycolmap.Track(), np.array(color, np.uint8))
    place = folder / "sparse/0"
    place.mkdir(parents=True)
    (whole.write_binary if kind == "bin" else whole.write_text)(place)
    return whole


def lens(name: str, parameters: list[float]) -> pycolmap.Camera:
    return pycolmap.Camera(model=name, width=64, height=48, params=parameters, camera_id=1)


def project(camera: Camera, point: np.ndarray) -> np.ndarray:
    x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


@pytest.mark.parametrize("kind", KINDS)
def test_points_are_in_pictures_where_colmap_has_them(tmp_path: Path, kind: str) -> None:
    whole = model(tmp_path, kind)
    views = {
        camera.name: (camera, path) for s in ("train", "test") for camera, path in read_frames(tmp_path, s)
    }
    assert len(views) == 16
    for image in whole.images.values():
        camera, path = views[image.name.removesuffix(".png")]
        assert path.samefile(tmp_path / "images" / image.name)
        assert (camera.width, camera.height) == (64, 48)
        for point in POINTS:
            np.testing.assert_allclose(project(camera, point), image.project_point(point), atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_every_eighth_picture_is_a_test_view_and_points_are_the_cloud(tmp_path: Path, kind: str) -> None:
    model(tmp_path, kind, names=[f"{i:02d}.png" for i in range(20)])
    assert [camera.name for camera, _ in read_frames(tmp_path, "test")] == ["00", "08", "16"]
    assert [camera.name for camera, _ in read_frames(tmp_path, "train")][:8] == [
        "01",
        "02",
        "03",
        "04",
        "05",
        "06",
        "07",
        "09",
    ]
    dataset = open_dataset(tmp_path)
    cloud = initial_cloud(dataset, dataset.scenes[0])
    order = np.argsort(cloud.points[:, 0])
    np.testing.assert_allclose(cloud.points[order], POINTS[[1, 2, 0]], atol=1e-7)
    np.testing.assert_allclose(cloud.colors[order] * 255, [[255, 0, 128], [9, 9, 9], [1, 2, 3]], atol=1e-4)
    views = load_views(dataset.scenes[0], ViewRequest("test", 92, 91, 32, 24))
    assert views.images[1, 0, 0, 0] == pytest.approx(8 / 255)


def test_the_pinholes_of_all_models_are_read(tmp_path: Path) -> None:
    models = {
        "SIMPLE_PINHOLE": [50, 33, 23], "PINHOLE": [50, 55, 33, 23], "SIMPLE_RADIAL": [50, 33, 23, 0],
        "RADIAL": [50, 33, 23, 0, 0], "OPENCV": [50, 55, 33, 23, 0, 0, 0, 0],
        "FULL_OPENCV": [50, 55, 33, 23, 0, 0, 0, 0, 0, 0, 0, 0], "DIVISION": [50, 55, 33, 23, 0],
        "SIMPLE_DIVISION": [50, 33, 23, 0],
    }  # fmt: skip
    for name, parameters in models.items():
        for kind in KINDS:
            whole = model(tmp_path / name / kind, kind, lens(name, list(map(float, parameters))))
            camera, _ = read_frames(tmp_path / name / kind, "test")[0]
            np.testing.assert_allclose(
                project(camera, POINTS[0]), whole.images[1].project_point(POINTS[0]), atol=1e-9
            )


NO_PINHOLES = {
    name: pycolmap.Camera.create_from_model_name(1, name, 50.0, 64, 48)
    for name in pycolmap.CameraModelId.__members__
    if name not in ("INVALID", "SIMPLE_PINHOLE", "PINHOLE")
}


@pytest.mark.parametrize("name", NO_PINHOLES)
@pytest.mark.parametrize("kind", KINDS)
def test_lenses_that_bend_lines_are_refused_by_name(tmp_path: Path, name: str, kind: str) -> None:
    camera = NO_PINHOLES[name]
    camera.params = [*camera.params[:-1], 0.1]
    model(tmp_path, kind, camera)
    with pytest.raises(DataError, match=rf"camera model {name}\b.*no pinhole") as refusal:
        read_frames(tmp_path, "train")
    assert "image_undistorter" in refusal.value.remedy


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", ""])
@pytest.mark.parametrize("pictures", ["images", "input", ""])
def test_models_lie_where_tools_put_them(tmp_path: Path, place: str, pictures: str) -> None:
    source = tmp_path / "source"
    model(source, "bin")
    target = tmp_path / "target"
    shutil.copytree(source / "sparse/0", target / place, dirs_exist_ok=True)
    shutil.copytree(source / "images", target / pictures, dirs_exist_ok=True)
    assert open_dataset(target).kind == "views"
    assert len(read_frames(target, "train")) == 14


def test_a_model_without_points_has_a_random_start(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model(tmp_path, "bin", points=0)
    dataset = open_dataset(tmp_path)
    assert len(initial_cloud(dataset, dataset.scenes[0], 500)) == 500
    assert caplog.text.count("random points") == 1


def test_a_missing_picture_is_named(tmp_path: Path) -> None:
    model(tmp_path, "bin")
    (tmp_path / "images/camB/view 3.png").unlink()
    with pytest.raises(DataError, match=r"camB/view 3\.png: no such picture"):
        read_frames(tmp_path, "train")


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_models(tmp_path: Path, part: str, kind: str) -> None:
    model(tmp_path, kind)
    whole = (tmp_path / f"sparse/0/{part}.{kind}").read_bytes()

    def check(path: Path) -> None:
        with suppress(DataError):
            for camera, _ in read_frames(tmp_path, "train"):
                rotation = camera.camera_to_world[:3, :3]
                np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
            found = colmap.read_points(tmp_path / "sparse/0")
            assert found is None or np.isfinite(found[0]).all()

    path = tmp_path / f"sparse/0/{part}.{kind}"
    check_damage(path, lambda path: path.write_bytes(whole), check, "cut", "set", many=60)


def test_text_of_another_hand(tmp_path: Path) -> None:
    """Comments between, CRLF, a byte order mark, a name with blanks, and empty lines of points."""
    model(tmp_path, "bin")
    folder = tmp_path / "sparse/0"
    for file in folder.iterdir():
        file.unlink()
    (folder / "cameras.txt").write_bytes(b"\xef\xbb\xbf# c\r\n7 PINHOLE 64 48 50 55 33 23\r\n\r\n")
    lines = ["3 1 0 0 0 0 0 3 7 camA/view 0.png", "", "# note", "9 2 0 0 0 1 0 3 7 camB/view 0.png", "1 2 -1"]
    (folder / "images.txt").write_bytes("\r\n".join(lines).encode())
    frames = [*read_frames(tmp_path, "test"), *read_frames(tmp_path, "train")]
    assert [camera.name for camera, _ in frames] == ["camA/view 0", "camB/view 0"]
    np.testing.assert_allclose(frames[1][0].camera_to_world[:3, 3], [-1, 0, -3])
    assert colmap.read_points(folder) is None


def test_of_several_models_the_first_is_taken_and_it_is_said(tmp_path: Path) -> None:
    model(tmp_path, "bin")
    assert list(remarks(tmp_path)) == []
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "sparse/1")
    (line,) = remarks(tmp_path)
    assert "2 models" in line
    assert "sparse/0" in line
