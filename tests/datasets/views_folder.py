"""The files of a folder of pre-rendered views."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.cloud import PointCloud
from econgs_bench.datasets.scene import BasicScene


def write_transforms(path: Path, cameras: Sequence[Camera]) -> None:
    """Cameras as a ``transforms_<split>.json``, looking along -z with +y up; pictures lie in ``<split>``."""
    split = path.stem.removeprefix("transforms_")
    frames = [
        {
            "file_path": f"./{split}/{c.name}.png",
            "transform_matrix": (c.camera_to_world * [1.0, -1.0, -1.0, 1.0]).tolist(),
            **{"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height},
        }
        for c in cameras
    ]
    path.write_text(json.dumps({"frames": frames}), encoding="utf-8")


def write_ply(path: Path, cloud: PointCloud) -> None:
    """A binary little-endian PLY: x y z as float, red green blue as uchar."""
    fields = [*((name, "<f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    columns = [*cloud.points.T, *np.rint(255.0 * cloud.colors.T)]
    kinds = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {kinds[kind]} {name}\n" for name, kind in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + np.rec.fromarrays(columns, dtype=fields).tobytes())


def random_views(folder: Path, n: int = 12, size: int = 8, mode: str = "RGBA") -> BasicScene:
    """Random pictures with cameras, in splits train and test."""
    generator = np.random.default_rng(0)
    channels = 4 if mode == "RGBA" else 3
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
        frames = []
        for i in range(n):
            pixels = generator.integers(0, 256, (size, size, channels), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / split / f"r_{i:04d}.png")
            frames.append({"file_path": f"./{split}/r_{i:04d}", "transform_matrix": np.eye(4).tolist()})
        content = {"camera_angle_x": 0.5, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return BasicScene("s", views_folder=folder)
