"""Folders of pre-rendered views: which formats, which split, which files decide their identity."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from econgs_bench.bench.plan.inputs import absolute, request
from econgs_bench.bench.suites.suite import VIEWS
from econgs_bench.datasets.catalogue.opening import open_dataset
from econgs_bench.datasets.cloud import initial_cloud, random_cloud
from econgs_bench.datasets.content import fingerprint
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.posed_images import read_frames
from tests.datasets.views_folder import random_views, write_ply


def write(folder: Path, names: list[str], **fields) -> None:
    """A ``transforms.json`` of pictures from several sides."""
    frames = []
    for i, name in enumerate(names):
        matrix = np.eye(4)
        angle = 2 * math.pi * i / len(names)
        matrix[[0, 0, 2, 2], [0, 2, 0, 2]] = (
            math.cos(angle),
            math.sin(angle),
            -math.sin(angle),
            math.cos(angle),
        )
        matrix[:3, 3] = 3.0 * matrix[:3, 2]
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGBA", (8, 8), (i, 50, 100, 255)).save(path)
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames, **fields}))


def views(folder: Path, split: str) -> list[str]:
    return [camera.name for camera, _ in read_frames(folder, split)]  # type: ignore[arg-type]


def test_one_file_holds_every_eighth_picture_out(tmp_path: Path) -> None:
    write(tmp_path, [f"images/{i:02d}.png" for i in reversed(range(17))])
    assert views(tmp_path, "test") == ["16", "08", "00"]
    assert len(views(tmp_path, "train")) == 14
    assert not {*views(tmp_path, "test")} & {*views(tmp_path, "train")}
    assert open_dataset(tmp_path).kind == "views"


def test_one_file_may_name_its_split(tmp_path: Path) -> None:
    names = [f"images/{i}.png" for i in range(6)]
    write(tmp_path, names, train_filenames=names[:2], val_filenames=names[2:3], test_filenames=names[3:])
    assert (views(tmp_path, "train"), views(tmp_path, "test")) == (["0", "1"], ["3", "4", "5"])


def test_a_folder_of_scenes_may_mix_formats(tmp_path: Path) -> None:
    write(tmp_path / "one", [f"{i}.png" for i in range(9)])
    random_views(tmp_path / "two")
    (tmp_path / "none").mkdir()
    assert [scene.name for scene in open_dataset(tmp_path).scenes] == ["one", "two"]
    with pytest.raises(DataError, match=r"transforms_train\.json, transforms\.json or a sparse model"):
        open_dataset(tmp_path / "none")


def test_every_picture_and_only_what_is_read_decides_the_identity(tmp_path: Path) -> None:
    """Of any suffix, and outside of the folder too."""
    write(tmp_path / "scene", [f"../pictures/{i}.jpg.bmp" for i in range(16)])
    dataset = open_dataset(tmp_path / "scene")

    def identity() -> str:
        return fingerprint(dataset, dataset.scenes[0].name)

    first = identity()
    (tmp_path / "scene/notes.txt").write_text("mine")
    (tmp_path / "pictures/other.bmp").write_bytes(b"1")
    assert identity() == first
    Image.new("RGBA", (8, 8), (1, 2, 3, 255)).save(tmp_path / "pictures/3.jpg.bmp")
    assert identity() != first


def test_without_points_methods_start_at_random_and_it_is_said_once(tmp_path: Path, caplog) -> None:
    write(tmp_path, [f"{i}.png" for i in range(16)])
    dataset = open_dataset(tmp_path)
    clouds = [initial_cloud(dataset, dataset.scenes[0], 300, seed) for seed in (0, 0, 1)]
    assert [len(cloud) for cloud in clouds] == [300] * 3
    np.testing.assert_array_equal(clouds[0].points, clouds[1].points)
    assert not np.array_equal(clouds[0].points, clouds[2].points)
    assert np.abs(clouds[0].points).max() < 1.5
    (line,) = caplog.text.splitlines()
    assert str(tmp_path) in line
    assert "points3d.ply" in line


def test_nerfstudio_names_its_points(tmp_path: Path, caplog) -> None:
    write(tmp_path, [f"{i}.png" for i in range(16)], ply_file_path="sparse_pc.ply")
    cloud = random_cloud(50, 0.5)
    write_ply(tmp_path / "sparse_pc.ply", cloud)
    dataset = open_dataset(tmp_path)
    start = initial_cloud(dataset, dataset.scenes[0])
    np.testing.assert_allclose(start.points, cloud.points)
    first = fingerprint(dataset, dataset.scenes[0].name)
    write_ply(tmp_path / "sparse_pc.ply", random_cloud(50, 0.4))
    assert fingerprint(dataset, dataset.scenes[0].name) != first
    assert not caplog.text
    (tmp_path / "sparse_pc.ply").unlink()
    with pytest.raises(DataError, match=r"sparse_pc\.ply: no such point cloud"):
        initial_cloud(dataset, dataset.scenes[0])


def test_what_is_not_applied_is_said_once(tmp_path: Path, caplog) -> None:
    write(tmp_path, [f"{i}.png" for i in range(16)])
    write_ply(tmp_path / "points3d.ply", random_cloud(5, 0.5))
    path = tmp_path / "transforms.json"
    fields = json.loads(path.read_text())
    fields["frames"][3]["mask_path"] = "masks/3.png"
    path.write_text(json.dumps(fields))
    scene = open_dataset(tmp_path)
    for preset in ("quick", "standard"):
        request(scene, scene.scenes[0].name, VIEWS[preset])
    (line,) = caplog.text.splitlines()
    assert "mask_path" in line


def test_a_path_that_is_no_text_is_named_before_the_run(tmp_path: Path) -> None:
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9")
    write(Path(folder), ["0.png"])
    with pytest.raises(DataError, match="not UTF-8"):
        absolute(folder)


def test_names_of_views_hold_no_control_characters(tmp_path: Path) -> None:
    write(tmp_path, ["a\x1b[2J.png", "b\n.png"])
    assert [*views(tmp_path, "test"), *views(tmp_path, "train")] == [r"a\x1b[2J", r"b\n"]
