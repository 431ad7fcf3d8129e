"""Camera conventions: what Blender sees at a pixel is what our camera sees there."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from PIL import Image

from econgs_bench.datasets.blender import read_transforms
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.camera_paths import training_cameras
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.png import read_png
from econgs_bench.datasets.prerendered import load_views
from econgs_bench.datasets.views import ViewRequest, evenly_spaced
from tests.datasets.damage import check_damage
from tests.datasets.views_folder import random_views, write_transforms


def _picture(path: Path, size: tuple[int, int] = (4, 4)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGBA", size, (9, 8, 7, 255)).save(path, "PNG")
    return path


def test_a_blender_camera_looks_along_minus_z_with_y_up(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = [1.0, 2.0, 3.0]
    content = {"camera_angle_x": math.pi / 2, "w": 4, "h": 2}
    content["frames"] = [{"file_path": "a/b", "transform_matrix": matrix.tolist()}]
    path = tmp_path / "transforms_train.json"
    path.write_text(json.dumps(content))
    _picture(tmp_path / "a/b.png")
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
    for camera in cameras:
        _picture(tmp_path / "test" / f"{camera.name}.png")
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
    {"camera_angle_x": "x", "frames": [FRAME]},
    {"cx": 1.0, "frames": [FRAME]},
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
    _picture(tmp_path / "a.png")
    with pytest.raises(DataError, match=r"transforms_train\.json"):
        read_transforms(path)


def test_damaged_transforms(tmp_path: Path) -> None:
    def check(path: Path) -> None:
        with suppress(DataError):
            for camera, _ in read_transforms(path):
                rotation = camera.camera_to_world[:3, :3]
                np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)

    cameras = training_cameras(6, 1.0, 4, 4)
    for camera in cameras:
        _picture(tmp_path / "train" / f"{camera.name}.png")
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


def _read(folder: Path, *frames: dict, **fields) -> list[tuple[Camera, Path]]:
    """Frames of a file; those without a matrix or a path get one."""
    path = folder / "transforms_train.json"
    whole = [
        {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **frame} for frame in frames or ({},)
    ]
    path.write_text(json.dumps({**fields, "frames": whole}))
    return read_transforms(path)


ANGLE, TWICE = 2 * math.atan(0.5), 2 * math.atan(1.0)  # focal length of a side, and of half a side


@pytest.mark.parametrize(
    ("common", "own", "expected"),
    [
        ({"camera_angle_x": ANGLE}, {}, (64, 64)),
        ({"camera_angle_x": ANGLE, "camera_angle_y": ANGLE}, {}, (64, 32)),
        ({"camera_angle_y": ANGLE}, {}, (32, 32)),
        ({"x_fov": 90.0, "y_fov": 90.0}, {}, (32, 16)),
        ({"fl_x": 50.0, "camera_angle_x": ANGLE, "camera_angle_y": ANGLE}, {}, (50, 32)),
        ({"fl_x": 50.0, "fl_y": 40.0}, {"fl_x": 10.0}, (10, 40)),
        ({"fl_x": 50.0}, {"camera_angle_x": TWICE}, (32, 32)),
        ({"camera_angle_x": ANGLE}, {"fl_x": 5.0, "fl_y": 6.0}, (5, 6)),
        ({"fl_x": 50.0, "w": 32, "h": 16}, {"w": 64, "h": 32}, (50, 50)),
    ],
)
def test_each_axis_has_the_focal_length_that_its_frame_or_file_gives(
    tmp_path: Path, common: dict, own: dict, expected: tuple[float, float]
) -> None:
    _picture(tmp_path / "a.png", (64, 32))
    ((camera, _),) = _read(tmp_path, own, **common)
    assert (camera.fx, camera.fy) == pytest.approx(expected)
    assert (camera.width, camera.height, camera.cx, camera.cy) == (64, 32, 32, 16)


OTHER_LENSES = {
    "k1": {"camera_model": "OPENCV", "k1": 0.3},
    "p2": {"camera_model": "OPENCV", "k1": 0.0, "p2": -0.01},
    "k4": {"k4": 1e-9},
    "OPENCV_FISHEYE": {"camera_model": "OPENCV_FISHEYE"},
    "EQUIRECTANGULAR": {"camera_model": "EQUIRECTANGULAR"},
    "fisheye624": {"camera_model": "fisheye624"},
    "ORTHOPHOTO": {"camera_model": "ORTHOPHOTO"},
    "is_fisheye": {"is_fisheye": True},
    "rolling_shutter": {"rolling_shutter": [0.0, 0.5, 0.0]},
    "distortion_params": {"distortion_params": [0.1, 0, 0, 0, 0, 0]},
    "ftheta_p0": {"ftheta_p0": 1.0},
    "camera model 7": {"camera_model": 7},
}


@pytest.mark.parametrize("name", OTHER_LENSES)
@pytest.mark.parametrize("place", ["file", "frame"])
def test_what_is_no_pinhole_is_refused_by_name(tmp_path: Path, name: str, place: str) -> None:
    _picture(tmp_path / "a.png")
    keys = OTHER_LENSES[name]
    with pytest.raises(DataError, match=name) as refusal:
        _read(tmp_path, keys if place == "frame" else {}, fl_x=5.0, **(keys if place == "file" else {}))
    assert "Undistort" in refusal.value.remedy


def test_a_pinhole_by_any_name_is_read(tmp_path: Path) -> None:
    _picture(tmp_path / "a.png")
    zeros = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0.0)
    for model in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "perspective", "SIMPLE_RADIAL", None):
        more = {"is_fisheye": False, "rolling_shutter": [0.0, 0.0], "aabb_scale": 16}
        assert len(_read(tmp_path, fl_x=5.0, camera_model=model, **zeros, **more)) == 1


@pytest.mark.parametrize(
    ("written", "file"),
    [
        ("view_az30.5", "view_az30.5.png"),
        ("t=0.25", "t=0.25.JPG"),
        ("my view 1", "my view 1.jpeg"),
        ("bare", "bare"),
        ("bare.5", "bare.5"),
        ("sub\\dir\\a.png", "sub/dir/a.png"),
        (".//./a", "a.png"),
        ("a.png", "a.png.png"),
        ("é[1]*?", "é[1]*?.png"),
    ],
)
def test_pictures_are_found_by_any_spelling(tmp_path: Path, written: str, file: str) -> None:
    _picture(tmp_path / file)
    ((_, picture),) = _read(tmp_path, {"file_path": written}, fl_x=5.0)
    assert picture.samefile(tmp_path / file)


def test_a_missing_picture_is_named_with_what_was_tried(tmp_path: Path) -> None:
    _picture(tmp_path / "a.png")
    for written, likely in (("b", "b.png"), ("b.5", "b.5.png"), ("b.jpg", "b.jpg"), ("x" * 400, "x.png")):
        with pytest.raises(DataError, match=r"no such picture \(looked for .*\.png, \.jpg") as missing:
            _read(tmp_path, {}, {"file_path": written}, fl_x=5.0, w=4, h=4)
        assert missing.value.what.endswith(likely)


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["train/r_0.png", "train/r_1.png"], ["r_0", "r_1"]),
        (["camA/0.png", "camB/0.png"], ["camA/0", "camB/0"]),
        (["t/camA/0.png", "t/camB/0.png", "t/0.png"], ["camA/0", "camB/0", "0"]),
        (["a.png", "a.jpg"], ["a.png", "a.jpg"]),
        (["v_30.5", "v_30.5.png"], ["v_30.5", "v_30.5.png"]),
        (["v_30.5.png", "v_30.6.png"], ["v_30.5", "v_30.6"]),
        (["only/one.png"], ["one"]),
    ],
)
def test_the_name_of_a_view_is_its_path(tmp_path: Path, files: list[str], names: list[str]) -> None:
    for file in files:
        _picture(tmp_path / file)
    views = _read(tmp_path, *({"file_path": file} for file in files), fl_x=5.0)
    assert [camera.name for camera, _ in views] == names


def test_a_picture_twice_is_refused(tmp_path: Path) -> None:
    _picture(tmp_path / "a.png")
    with pytest.raises(DataError, match="twice"):
        _read(tmp_path, {}, {"file_path": "./x/../a"}, fl_x=5.0)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_json_of_any_unicode_encoding(tmp_path: Path, encoding: str) -> None:
    _picture(tmp_path / "é.png")
    path = tmp_path / "transforms_train.json"
    frame = {"file_path": "é", "transform_matrix": np.eye(4).tolist()}
    path.write_text(json.dumps({"fl_x": 5.0, "frames": [frame]}, ensure_ascii=False), encoding=encoding)
    assert read_transforms(path)[0][0].name == "é"


def test_a_picture_of_another_shape_than_its_camera_is_refused(tmp_path: Path) -> None:
    scene = random_views(tmp_path)
    path = tmp_path / "transforms_train.json"
    fields = json.loads(path.read_text())
    path.write_text(json.dumps({**fields, "w": 16, "h": 16}))
    assert load_views(scene, ViewRequest("train", 92, 91, 4, 4)).cameras[0].fx == pytest.approx(
        2 / math.tan(0.25)
    )
    path.write_text(json.dumps({**fields, "w": 16, "h": 9}))
    with pytest.raises(DataError, match="is 8x8 pixels, but its camera 16x9"):
        load_views(scene, ViewRequest("train", 92, 91, 4, 4))


GRAY = np.array([[0, 1, 2], [300, 40000, 65535]], np.uint16)
ALPHA = np.array([[0, 65535, 12345], [65535, 1, 30000]], np.uint16)
SIXTEEN = {
    "gray": (GRAY[..., None], GRAY, 65535),
    "gray and alpha": (np.stack([GRAY, ALPHA], -1), GRAY, ALPHA),
    "color": (np.stack([GRAY, GRAY[::-1], GRAY], -1), GRAY, 65535),
    "color and alpha": (np.stack([GRAY, GRAY[::-1], GRAY, ALPHA], -1), GRAY, ALPHA),
}


@pytest.mark.parametrize("form", SIXTEEN)
def test_sixteen_bits_keep_their_steps(tmp_path: Path, form: str) -> None:
    values, red, alpha = SIXTEEN[form]
    path = tmp_path / "a.png"
    path.write_bytes(imagecodecs.png_encode(values.squeeze()))
    picture = read_png(path, deep=True)
    opacity = np.broadcast_to(np.asarray(alpha) / 65535.0, GRAY.shape)
    np.testing.assert_allclose(picture[..., 3], opacity, atol=1e-7)
    np.testing.assert_allclose(picture[..., 0], red / 65535.0 * opacity, atol=1e-7)
    np.testing.assert_array_equal(picture[..., 1] == picture[..., 0], picture[..., 1] == picture[..., 2])
    with pytest.raises(DataError, match=r"16 bits|mode I;16"):
        read_png(path)  # of metrics, which count steps of 8 bits
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DataError, match=r"a\.png"):
        read_png(path, deep=True)


def _palette() -> Image.Image:
    image = Image.new("P", (2, 1))
    image.putpalette([255, 0, 0, 0, 255, 0])
    image.putdata([0, 1])
    image.info["transparency"] = b"\xff\x80"
    return image


def _keyed(mode: str, values: list, key) -> Image.Image:
    image = Image.new(mode, (2, 1))
    image.putdata(values)
    image.info["transparency"] = key
    return image


FORMS = {
    "palette": (_palette(), [(1, 0, 0, 1), (0, 128 / 255, 0, 128 / 255)]),
    "key": (_keyed("RGB", [(255, 0, 0), (0, 0, 255)], (255, 0, 0)), [(0, 0, 0, 0), (0, 0, 1, 1)]),
    "gray key": (_keyed("L", [51, 255], 51), [(0, 0, 0, 0), (1, 1, 1, 1)]),
    "one bit": (Image.fromarray(np.array([[True, False]])), [(1, 1, 1, 1), (0, 0, 0, 1)]),
    "gray alpha": (
        Image.fromarray(np.array([[[51, 255], [255, 51]]], "u1")),
        [(0.2, 0.2, 0.2, 1), (0.2,) * 4],
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_palettes_and_transparent_colors_are_alpha(tmp_path: Path, form: str) -> None:
    image, expected = FORMS[form]
    image.save(
        tmp_path / "a.png",
        **({"transparency": image.info["transparency"]} if "transparency" in image.info else {}),
    )
    for deep in (False, True):
        np.testing.assert_allclose(read_png(tmp_path / "a.png", deep=deep)[0], expected, atol=1e-6)
