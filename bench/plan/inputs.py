"""Datasets as plans read them: names, and numbers and sizes of views."""

from __future__ import annotations

import os
from pathlib import Path

from econgs_bench.bench.store.records import Request
from econgs_bench.bench.suites.suite import ViewPreset
from econgs_bench.datasets.camera_paths import icosphere
from econgs_bench.datasets.catalogue.entries import built_in, own_files
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.naming import split
from econgs_bench.datasets.scene import Dataset


def absolute(name_or_path: str) -> str:
    """A catalogue name unchanged; a path (and its choices within the file) made absolute, for any process.

    Raises:
        DataError: a path is no text (bytes that are not UTF-8), which no record can hold.
    """
    try:
        os.path.abspath(name_or_path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise DataError(name_or_path, "its path is not UTF-8", "Rename the file or folder") from error
    if name_or_path in (own := own_files()):
        return str(own[name_or_path])
    path, choices = split(name_or_path)
    if name_or_path.partition("@")[0] in built_in() or not path.exists():
        return name_or_path
    return f"{path.resolve()}:{choices}" if choices else str(path.resolve())


def request(dataset: Dataset, scene_name: str, preset: ViewPreset, samples: int | None = None) -> Request:
    """The views of a dataset that a preset asks for.

    Args:
        dataset: with volumes, or pre-rendered.
        scene_name: one of its basic scenes.
        preset: numbers and size of views.
        samples: rays a pixel of rendered views; default: the dataset's.

    Raises:
        DataError: its pre-rendered views cannot be read, or have no size that the preset can use; or there
            is no such number of training cameras around a volume.
    """
    scene = dataset.scene(scene_name)
    native = None if scene.views_folder is None else _native_size(scene.views_folder)
    if native is None:
        icosphere(preset.train_views)  # raises where no cameras stand so
    width, height = view_size(preset, native)
    if native is not None:
        samples = 1
    elif samples is None:
        samples = dataset.samples
    return Request(
        train_views=preset.train_views,
        test_views=preset.test_views,
        width=width,
        height=height,
        samples=samples,
    )


def view_size(preset: ViewPreset, native: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height to ask for: the preset's, or a whole fraction of pre-rendered views' own size.

    Raises:
        DataError: no whole factor brings the views under the preset's limit.
    """
    if native is None:
        return preset.width, preset.height
    width, height = native
    limit = preset.prerendered_limit
    for factor in range(1, max(native) + 1):
        if width % factor == 0 and height % factor == 0 and max(width, height) // factor <= limit:
            return width // factor, height // factor
    raise DataError(
        f"views of {width}x{height}",
        f"no whole factor divides them to at most {limit} pixels",
        "Resize them to a size with small factors, or use a larger preset",
    )


def _native_size(folder: Path) -> tuple[int, int]:
    """Width and height of the first training picture."""
    from econgs_bench.datasets.cloud import warn_of_views
    from econgs_bench.datasets.png import open_picture
    from econgs_bench.datasets.posed_images import read_frames

    frames = read_frames(folder, "train")
    if not frames:
        raise DataError(folder, "has no training views", "Add pictures")
    _, picture = frames[0]
    warn_of_views(folder)
    with open_picture(picture) as image:
        return image.size
