"""Writes views as folders that trainers load: NeRF's Blender format, or sparse models of COLMAP.

blender        ``transforms_train.json``, pictures in ``train/``, ``points3d.ply`` as 3DGS reads it, and an
               empty ``transforms_test.json``, which some loaders open
colmap         ``sparse/0/{cameras,images,points3D}.bin``, pictures in ``images/``
colmap-text    the same in ``.txt``

:mod:`.datasets.posed_images` reads all three back: poses and points to 1e-6, colors to 8 bits.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.datasets.png import write_png
from econgs_bench.datasets.scene import RGB, BasicScene
from econgs_bench.datasets.views import ViewSet, over

Format = Literal["blender", "colmap", "colmap-text"]
Pictures = Literal["rgba", "composited"]
FORMATS: tuple[Format, ...] = get_args(Format)
PICTURES: tuple[Pictures, ...] = get_args(Pictures)
SCENE = "scene.json"
_PINHOLE = 1
"""Number of COLMAP's camera model with fx, fy, cx, cy."""


def write_training(
    folder: Path,
    format: Format,
    views: ViewSet,
    cloud: PointCloud,
    scene: BasicScene,
    pictures: Pictures | None = None,
) -> None:
    """Write training views, initial cloud and scene definition into an empty folder.

    Args:
        folder: exists.
        format: of the files.
        views: cameras and pictures. Pictures are named ``0000.png`` by their order.
        cloud: initial points.
        scene: its definition goes into ``scene.json``, with the background of the views.
        pictures: "rgba" (straight alpha) or "composited" on the background; default: rgba in ``blender``,
            composited in COLMAP's formats, as their loaders expect.

    Raises:
        OSError: a file cannot be written.
    """
    composited = (pictures or ("rgba" if format == "blender" else "composited")) == "composited"
    names = _names(views.cameras)
    place = folder / ("train" if format == "blender" else "images")
    place.mkdir()
    for name, image in zip(names, views.images, strict=True):
        write_png(place / name, over(image, views.background) if composited else image)
    if format == "blender":
        _write_transforms(folder / "transforms_train.json", views.cameras, names, "train")
        _write_transforms(folder / "transforms_test.json", views.cameras[:0], [], "test")
        _write_points(folder / "points3d.ply", cloud)
    else:
        _write_model(folder / "sparse" / "0", format, views.cameras, names, cloud)
    _write_json(folder / SCENE, definition(scene, views.background))


def write_cameras(folder: Path, format: Format, cameras: Sequence[Camera], cloud: PointCloud | None) -> None:
    """Write cameras into an empty folder, with blank pictures.

    Loaders open each picture that they list, so there is one of the right size, transparent and black. In
    ``blender`` the cameras are both training and test views, as loaders fail on a split without any.

    Args:
        folder: exists.
        format: of the files.
        cameras: in the order of their pictures' names, ``0000.png`` and on.
        cloud: points, which loaders of COLMAP's formats need; None: one point at the origin.

    Raises:
        OSError: a file cannot be written.
    """
    names = _names(cameras)
    cloud = cloud or PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32))
    place = folder / ("test" if format == "blender" else "images")
    place.mkdir()
    for name, camera in zip(names, cameras, strict=True):
        write_png(place / name, np.zeros((camera.height, camera.width, 4), np.float32))
    if format == "blender":
        for split in ("train", "test"):
            _write_transforms(folder / f"transforms_{split}.json", cameras, names, "test")
        _write_points(folder / "points3d.ply", cloud)
    else:
        _write_model(folder / "sparse" / "0", format, cameras, names, cloud)


def definition(scene: BasicScene, background: RGB) -> dict[str, Any]:
    """A scene's definition as JSON values, without paths of this machine."""
    from pydantic import TypeAdapter

    about: dict[str, Any] = TypeAdapter(BasicScene).dump_python(scene, mode="json")
    about.pop("views_folder")
    return about | {"background": list(background)}


def _names(cameras: Sequence[Camera]) -> list[str]:
    digits = max(4, len(str(len(cameras) - 1)))
    return [f"{index:0{digits}d}.png" for index in range(len(cameras))]


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _write_transforms(path: Path, cameras: Sequence[Camera], names: Sequence[str], place: str) -> None:
    """``transforms_<split>.json``; intrinsics are those of each frame, and the first one's for all."""
    frames = [
        {
            "file_path": f"./{place}/{Path(name).stem}",
            "transform_matrix": (camera.camera_to_world * [1.0, -1.0, -1.0, 1.0]).tolist(),
            **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
            **{"w": camera.width, "h": camera.height},
        }
        for camera, name in zip(cameras, names, strict=True)
    ]
    angle = cameras[0].fov_x if cameras else 1.0
    _write_json(path, {"camera_angle_x": angle, "frames": frames})


def _bytes_of(cloud: PointCloud) -> NDArray[np.uint8]:
    values: NDArray[np.uint8] = np.rint(255.0 * np.clip(cloud.colors, 0.0, 1.0)).astype(np.uint8)
    return values


def _write_points(path: Path, cloud: PointCloud) -> None:
    """A binary PLY with positions, zero normals (which 3DGS's loader asks for) and 8-bit colors."""
    names = [*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz"))]
    names += [(name, "u1") for name in ("red", "green", "blue")]
    table = np.zeros(len(cloud), np.dtype(names))
    for axis, name in enumerate("xyz"):
        table[name] = cloud.points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        table[name] = _bytes_of(cloud)[:, channel]
    kinds = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    lines += [f"property {kinds[kind]} {name}" for name, kind in names]
    path.write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + table.tobytes())


def _write_model(
    folder: Path, format: Format, cameras: Sequence[Camera], names: Sequence[str], cloud: PointCloud
) -> None:
    """A sparse model: a PINHOLE camera for each set of intrinsics, and points without tracks."""
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True)
    lenses: dict[tuple[int | float, ...], int] = {}
    images = []
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True), 1):
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        pose = camera.world_to_camera
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        key = lenses.setdefault(lens, len(lenses) + 1)
        images.append((number, (w, x, y, z, *pose[:3, 3]), key, name))
    points = list(zip(cloud.points.astype(np.float64), _bytes_of(cloud), strict=True))
    if format == "colmap":
        rows = [struct.pack("<Q", len(lenses))]
        rows += [struct.pack("<IiQQ4d", key, _PINHOLE, *lens) for lens, key in lenses.items()]
        (folder / "cameras.bin").write_bytes(b"".join(rows))
        rows = [struct.pack("<Q", len(images))]
        for number, values, key, name in images:
            head = struct.pack("<I7dI", number, *values, key)
            rows.append(head + name.encode() + b"\0" + struct.pack("<Q", 0))
        (folder / "images.bin").write_bytes(b"".join(rows))
        rows = [struct.pack("<Q", len(points))]
        rows += [struct.pack("<Q3d3BdQ", i, *xyz, *rgb, 0.0, 0) for i, (xyz, rgb) in enumerate(points, 1)]
        (folder / "points3D.bin").write_bytes(b"".join(rows))
        return
    lines = [f"{key} PINHOLE {_text(lens)}" for lens, key in lenses.items()]
    _write_lines(folder / "cameras.txt", lines)
    # The second line of an image lists its points.
    lines = [f"{number} {_text(values)} {key} {name}\n" for number, values, key, name in images]
    _write_lines(folder / "images.txt", lines)
    lines = [f"{i} {_text(xyz)} {_text(rgb)} 0" for i, (xyz, rgb) in enumerate(points, 1)]
    _write_lines(folder / "points3D.txt", lines)


def _text(values: Sequence[Any] | NDArray[Any]) -> str:
    """Numbers in as many digits as give them back exactly."""
    return " ".join(repr(value.item() if isinstance(value, np.generic) else value) for value in values)


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="ascii")
