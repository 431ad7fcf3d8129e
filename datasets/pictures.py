"""The picture of a camera: where it lies, and the name that tells its view from all others."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from econgs_bench.datasets.camera import Camera, with_near_planes
from econgs_bench.datasets.errors import DataError, printable

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def find_picture(folder: Path, file_path: str) -> Path:
    """The file that a list of cameras names: as it is written, else with a suffix of :data:`SUFFIXES`.

    A dot in a name ("view_az30.5") begins no suffix. Backslashes part folders where no file has them.

    Raises:
        DataError: there is no such file; the message has all names that were tried.
    """
    spellings = dict.fromkeys((file_path, file_path.replace("\\", "/")))
    tried = [
        folder / f"{spelling}{suffix}"
        for spelling in spellings
        for suffix in ("", *SUFFIXES, *(one.upper() for one in SUFFIXES))
    ]
    for path in tried:
        try:
            if path.is_file():
                return path
        except (OSError, ValueError):  # too long, or with a NUL
            continue
    likely = tried[0] if _is_suffix(tried[0].suffix) else tried[1]
    also = f"{Path(file_path).name} as it is, and with {', '.join(SUFFIXES)}"
    raise DataError(likely, f"no such picture (looked for {also})", "Check the path")


def named(source: Path, frames: Sequence[tuple[Camera, Path]]) -> list[tuple[Camera, Path]]:
    """Frames with the names of their views and near planes that fit them together.

    A name is the picture's path below the folder that all pictures share, without its suffix where the names
    are distinct then: "r_0", or "left/0000" and "right/0000".

    Args:
        source: the file that lists the cameras, for messages.
        frames: cameras with their pictures, at least one.

    Raises:
        DataError: a picture occurs twice.
    """
    paths = [os.path.normpath(picture) for _, picture in frames]
    if len(set(paths)) < len(paths):
        twice = next(path for i, path in enumerate(paths) if path in paths[:i])
        raise DataError(source, f"lists the picture {twice} twice", "List each picture once")
    root = os.path.commonpath([os.path.dirname(path) for path in paths])
    names = [Path(os.path.relpath(path, root)).as_posix() for path in paths]
    names = [printable(name).replace("\n", r"\n").replace("\t", r"\t") for name in names]
    stems = [name.removesuffix(end) if _is_suffix(end := Path(name).suffix) else name for name in names]
    if len(set(stems)) == len(stems):
        names = stems
    cameras = with_near_planes([camera for camera, _ in frames])
    return [
        (replace(camera, name=name), picture)
        for camera, name, (_, picture) in zip(cameras, names, frames, strict=True)
    ]


def _is_suffix(text: str) -> bool:
    return text.lower() in SUFFIXES
