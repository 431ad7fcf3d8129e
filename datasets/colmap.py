"""Sparse models of COLMAP, binary and text: pinhole cameras, their pictures and the points.

Format: https://colmap.github.io/format.html (read 2026-11). ``pycolmap`` is the oracle in the tests. It is no
dependency: a damaged file ends its process, and it takes 38 MB for three small files.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.pictures import find_picture, named

_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "")
"""Folders of a model below that of a scene."""
_PICTURES = ("images", "input", "")
"""Folders of its pictures."""
_MODELS = {
    "SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "RADIAL": (3, 5), "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8), "FULL_OPENCV": (6, 12), "FOV": (7, 5), "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5), "THIN_PRISM_FISHEYE": (10, 12), "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16),
    "SIMPLE_DIVISION": (12, 4), "DIVISION": (13, 5), "SIMPLE_FISHEYE": (14, 3), "FISHEYE": (15, 4),
    "EUCM": (16, 6), "EQUIRECTANGULAR": (17, 2),
}  # fmt: skip
"""Name -> number and parameters."""
_NAMES = {number: name for name, (number, _) in _MODELS.items()}
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_DIVISION")
_PINHOLES = (*_ONE_FOCAL, "PINHOLE", "OPENCV", "FULL_OPENCV", "DIVISION")
"""Models that are a pinhole where all parameters after the principal point are 0."""
_UNDISTORT = "Undistort the pictures (colmap image_undistorter), which writes a model of PINHOLE cameras"
_REMEDY = "Export the model again (colmap model_converter)"


class _Lens(NamedTuple):
    """A row of ``cameras``."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class _Image(NamedTuple):
    """A row of ``images``: the transform from world to camera, OpenCV axes."""

    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    lens: int
    name: str


def model_of(folder: Path) -> Path | None:
    """The folder of the first sparse model of a scene, in itself or in ``sparse/0``; None if it has none."""
    for place in _PLACES:
        if all(_file(folder / place, part) is not None for part in ("cameras", "images")):
            return folder / place
    return None


def further_models(model: Path) -> list[Path]:
    """The models beside one of :func:`model_of`, as COLMAP writes several of pictures that do not connect."""
    if not model.name.isdigit():
        return []
    beside = sorted(path for path in model.parent.iterdir() if path.name.isdigit() and path != model)
    return [path for path in beside if all(_file(path, part) for part in ("cameras", "images"))]


def read_frames(folder: Path, model: Path) -> list[tuple[Camera, Path]]:
    """Cameras and pictures of a model, by order of the pictures' names.

    Args:
        folder: of the scene; its pictures are in ``images``, ``input`` or itself.
        model: of :func:`model_of`.

    Raises:
        DataError: a file is damaged, a camera is no pinhole (distortion, fisheye, panorama), or a picture is
            missing.
    """
    lenses = dict(_cameras(model))
    images = sorted(_images(model), key=lambda image: image.name)
    source = _file(model, "images") or model
    if not images:
        raise DataError(source, "has no images", "Give a model with registered images")
    pictures = next(
        (path for place in _PICTURES if (path := folder / place / images[0].name).is_file()),
        folder / _PICTURES[0] / images[0].name,
    )
    root = Path(str(pictures).removesuffix(images[0].name))
    frames = []
    for image in images:
        if image.lens not in lenses:
            raise DataError(source, f"{image.name} has camera {image.lens}, which is not there", _REMEDY)
        frames.append((_camera(source, image, lenses[image.lens]), find_picture(root, image.name)))
    return named(source, frames)


def read_points(model: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """(n, 3) positions and (n, 3) colors in [0, 1] of a model's points; None if it has none.

    Raises:
        DataError: the file is damaged.
    """
    path = _file(model, "points3D")
    if path is None:
        return None
    rows = list(_points_text(path) if path.suffix == ".txt" else _points_binary(path))
    if not rows:
        return None
    with np.errstate(over="ignore"):
        values = np.array(rows, dtype=np.float64).astype(np.float32)
    if not np.isfinite(values).all() or values[:, 3:].min() < 0 or values[:, 3:].max() > 255:
        raise DataError(path, "has a point without finite position and color", _REMEDY)
    return values[:, :3], values[:, 3:] / np.float32(255.0)


def _file(model: Path, part: str) -> Path | None:
    """The file of a part; the binary one where there are both, as COLMAP has it."""
    return next((path for end in (".bin", ".txt") if (path := model / f"{part}{end}").is_file()), None)


def _camera(source: Path, image: _Image, lens: _Lens) -> Camera:
    """The camera of an image.

    Raises:
        DataError: it is no pinhole, or a number is impossible.
    """
    if lens.model not in _PINHOLES:
        reason = f"{image.name} has the camera model {lens.model}, no pinhole"
        raise DataError(source, reason, _UNDISTORT)
    one = lens.model in _ONE_FOCAL
    fx, fy, cx, cy, *distortion = (lens.parameters[0], *lens.parameters) if one else lens.parameters
    if any(distortion):
        values = ", ".join(f"{value:g}" for value in distortion)
        reason = f"{image.name} has the camera model {lens.model} with distortion ({values}), no pinhole"
        raise DataError(source, reason, _UNDISTORT)
    numbers = np.array([*lens.parameters, *image.quaternion, *image.translation])
    with np.errstate(over="ignore"):
        length = np.linalg.norm(image.quaternion)
    if not (
        np.isfinite([*numbers, length]).all() and length > 0.0 and min(fx, fy, lens.width, lens.height) > 0
    ):
        raise DataError(source, f"{image.name} has an impossible camera or pose", _REMEDY)
    w, x, y, z = np.array(image.quaternion) / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T
    matrix[:3, 3] = -rotation.T @ image.translation
    return Camera(matrix, fx, fy, cx, cy, lens.width, lens.height)


class _Bytes:
    """Reads little-endian values one after the other.

    Raises:
        DataError: the file ends too early; so do all methods.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._content = path.read_bytes()
        except OSError as error:
            raise DataError(path, f"cannot be read ({error})", "Check its permissions") from error
        self._at = 0

    def take(self, layout: str) -> tuple[float, ...]:
        values = struct.Struct(f"<{layout}")
        start = self.skip(values.size)
        return values.unpack_from(self._content, start)

    def skip(self, count: int) -> int:
        """Pass some bytes; returns where they began."""
        start, self._at = self._at, self._at + count
        if self._at > len(self._content):
            raise DataError(self._path, "is truncated or damaged", "Copy it again")
        return start

    def text(self) -> str:
        end = self._content.find(b"\0", self._at)
        start = self.skip(end + 1 - self._at if end >= 0 else len(self._content) + 1)
        return self._content[start:end].decode("utf-8", "surrogateescape")


def _cameras(model: Path) -> Iterator[tuple[int, _Lens]]:
    path = _file(model, "cameras")
    assert path is not None
    if path.suffix == ".txt":
        for line in _lines(path):
            number, name, width, height, *rest = _split(path, line, 4)
            values = _floats(path, rest[0] if rest else "")
            if name in _MODELS and len(values) != _MODELS[name][1]:
                raise DataError(path, f"a camera {name} has {len(values)} parameters", _REMEDY)
            yield _whole(path, number), _Lens(name, _whole(path, width), _whole(path, height), values)
        return
    stream = _Bytes(path)
    (count,) = stream.take("Q")
    for _ in range(int(count)):
        key, kind, *size = map(int, stream.take("IiQQ"))
        if kind not in _NAMES:
            raise DataError(path, f"has the camera model {kind}, which is not known", _UNDISTORT)
        yield key, _Lens(_NAMES[kind], size[0], size[1], stream.take(f"{_MODELS[_NAMES[kind]][1]}d"))


def _images(model: Path) -> Iterator[_Image]:
    path = _file(model, "images")
    assert path is not None
    if path.suffix == ".txt":
        lines = _lines(path, every=True)
        for line in lines:
            if line:
                _, *rest, lens, name = _split(path, line, 9)
                values = _floats(path, " ".join(rest))
                if len(values) != 7:
                    raise DataError(path, f"the line {line[:60]!r} is not understood", _REMEDY)
                yield _Image(values[:4], values[4:], _whole(path, lens), name)
                next(lines, "")  # its points, which may be none
        return
    stream = _Bytes(path)
    (count,) = stream.take("Q")
    for _ in range(int(count)):
        numbers = stream.take("I7dI")
        picture = stream.text()
        (points,) = stream.take("Q")
        stream.skip(24 * int(points))
        yield _Image(numbers[1:5], numbers[5:8], int(numbers[8]), picture)


def _points_binary(path: Path) -> Iterator[tuple[float, ...]]:
    stream = _Bytes(path)
    (count,) = stream.take("Q")
    for _ in range(int(count)):
        _, *values, _, track = stream.take("Q3d3BdQ")
        stream.skip(8 * int(track))
        yield tuple(values)


def _points_text(path: Path) -> Iterator[tuple[float, ...]]:
    for line in _lines(path):
        yield _floats(path, " ".join(_split(path, line, 7)[1:7]))


def _lines(path: Path, *, every: bool = False) -> Iterator[str]:
    """The lines of a text file without comments, and without empty ones unless ``every``."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})", "Check its permissions") from error
    for line in text.split("\n"):
        if not line.startswith("#") and (every or line.strip()):
            yield line.strip()


def _split(path: Path, line: str, count: int) -> list[str]:
    """``count`` words of a line and, as one more, what follows them."""
    words = line.split(maxsplit=count)
    if len(words) < count:
        raise DataError(path, f"the line {line[:60]!r} is not understood", _REMEDY)
    return words


def _floats(path: Path, text: str) -> tuple[float, ...]:
    try:
        return tuple(map(float, text.split()))
    except ValueError as error:
        raise DataError(path, f"{text[:60]!r} are not numbers", _REMEDY) from error


def _whole(path: Path, text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise DataError(path, f"{text[:60]!r} is not a whole number", _REMEDY) from error
