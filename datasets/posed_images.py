"""Folders of pre-rendered views: cameras and pictures by split, from any of three formats.

``transforms_train.json`` and ``transforms_test.json`` (NeRF's synthetic data), ``transforms.json``
(instant-ngp, nerfstudio) or a sparse model of COLMAP. The latter two have no split of their own, unless
nerfstudio's ``train_filenames`` and ``test_filenames`` name one: every eighth picture by name is a test view.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from econgs_bench.datasets import colmap
from econgs_bench.datasets.blender import Frame, read_fields, read_transforms
from econgs_bench.datasets.errors import DataError

TRAIN, TEST, ONE = "transforms_train.json", "transforms_test.json", "transforms.json"
POINTS = "points3d.ply"
NEEDED = f"{TRAIN}, {ONE} or a sparse model of COLMAP (sparse/0)"
Split = Literal["train", "test"]
_HOLD = 8
"""Every so many pictures one is a test view, as 3DGS splits COLMAP's models."""


def holds_views(folder: Path) -> bool:
    """Whether a folder holds pre-rendered views of a scene."""
    return any((folder / name).is_file() for name in (TRAIN, ONE)) or colmap.model_of(folder) is not None


def read_frames(folder: Path, split: Split) -> list[Frame]:
    """Cameras and pictures of a split, by order of the file, or of the pictures' names in a model of COLMAP.

    Raises:
        DataError: the folder holds no views, or they cannot be used.
    """
    if (folder / TRAIN).is_file():
        return read_transforms(folder / (TEST if split == "test" else TRAIN))
    if (folder / ONE).is_file():
        frames = read_transforms(folder / ONE)
        fields = read_fields(folder / ONE)
        if isinstance(names := fields.get(f"{split}_filenames"), list):
            chosen = {os.path.normpath(folder / str(name)) for name in names}
            return [frame for frame in frames if os.path.normpath(frame[1]) in chosen]
        return _held_out(frames, split)
    if (model := colmap.model_of(folder)) is not None:
        return _held_out(colmap.read_frames(folder, model), split)
    raise DataError(folder, "holds no pre-rendered views", f"It needs {NEEDED}")


def points_file(folder: Path) -> Path | None:
    """The PLY of initial points: ``points3d.ply``, else ``ply_file_path`` of nerfstudio; None without."""
    if (folder / POINTS).exists():
        return folder / POINTS
    transforms = next((path for name in (TRAIN, ONE) if (path := folder / name).is_file()), None)
    name = None if transforms is None else read_fields(transforms).get("ply_file_path")
    return folder / name if isinstance(name, str) and name else None


def remarks(folder: Path) -> Iterator[str]:
    """What a folder has that its views do not show, a line each."""
    for name in (TRAIN, TEST, ONE):
        if (folder / name).is_file():
            frames = read_fields(folder / name).get("frames", [])
            if any("mask_path" in frame for frame in frames if isinstance(frame, dict)):
                yield f"{folder / name}: the masks of its pictures (mask_path) are not applied"
    model = None if any((folder / name).is_file() for name in (TRAIN, ONE)) else colmap.model_of(folder)
    if model is not None and (others := colmap.further_models(model)):
        yield f"{folder}: has {len(others) + 1} models; views are those of {model.relative_to(folder)}"


def files(folder: Path) -> Iterator[Path]:
    """All files that decide the views of a folder, beside others that may lie in it; some may occur twice."""
    yield from (path for name in (TRAIN, TEST, ONE) if (path := folder / name).is_file())
    if (points := points_file(folder)) is not None:
        yield points
    if (model := colmap.model_of(folder)) is not None:
        yield from sorted((*model.glob("*.bin"), *model.glob("*.txt")))
    splits: tuple[Split, ...] = ("train", "test")
    if (folder / TRAIN).is_file() and not (folder / TEST).is_file():
        splits = ("train",)
    for split in splits:
        yield from (picture for _, picture in read_frames(folder, split))


def _held_out(frames: list[Frame], split: Split) -> list[Frame]:
    test = set(sorted(camera.name for camera, _ in frames)[::_HOLD])
    return [frame for frame in frames if (frame[0].name in test) == (split == "test")]
