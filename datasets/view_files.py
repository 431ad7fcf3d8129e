"""Pictures of views in one file: a zstd frame each, 16 bits a channel where that is exact, else float32."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.scratch import new_array

_LEVELS = 65535
_SIXTEEN_BITS = "<u2"
_LEAST, _RATIO = 2**32, 1000
"""Bytes that pictures may always have, and those for each of their file: empty ones shrink a thousandfold."""
INDEX = ("shape", "dtype", "frames", "sha256")
"""Keys of the index of a file."""


def rounded(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Images of 16 bits a channel, as float32 in [0, 1] (error at most 7.7e-6)."""
    return _levels(images).astype(np.float32) / np.float32(_LEVELS)


def write_views(file: Path, images: NDArray[np.float32]) -> dict[str, Any]:
    """Write (n, height, width, 4) images, so that :func:`read_views` gives the same values bit for bit.

    Returns:
        The index that reading needs, as plain JSON values.

    Raises:
        OSError: the file cannot be written.
    """
    import pyarrow

    codec = pyarrow.Codec("zstd", compression_level=1)
    exact = all(np.array_equal(rounded(image), image) for image in images)
    checksum, frames = hashlib.sha256(), []
    with file.open("wb") as stream:
        for image in images:
            frame = codec.compress((_levels(image) if exact else image.astype("<f4")).tobytes(), asbytes=True)
            frames.append(len(frame))
            checksum.update(frame)
            stream.write(frame)
    dtype = _SIXTEEN_BITS if exact else "<f4"
    return dict(zip(INDEX, (list(images.shape), dtype, frames, checksum.hexdigest()), strict=True))


def read_views(
    file: Path, index: Mapping[str, Any], which: Sequence[int] | None = None, together: int = 0
) -> NDArray[np.float32]:
    """Images of a file, all or those of some positions, in a :func:`.datasets.scratch.new_array`.

    Args:
        file: of :func:`write_views`.
        index: what that gave.
        which: positions; default: all.
        together: bytes of all images that are held with these (:func:`images_bytes`).

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not the one that the index describes.
        KeyError, TypeError: the index is none.
    """
    import pyarrow

    codec = pyarrow.Codec("zstd")
    dtype = np.dtype(index.get("dtype", _SIXTEEN_BITS))
    shape = tuple(index["shape"])
    if len(shape) != 4 or min(shape) < 0 or str(dtype) not in ("uint16", "float32"):
        raise ValueError(f"pictures of shape {shape} and type {dtype}")
    if images_bytes(index) > max(_LEAST, _RATIO * file.stat().st_size):
        raise ValueError(f"pictures of shape {shape} in {file.stat().st_size} bytes")
    size = math.prod(shape[1:]) * dtype.itemsize
    ends = np.cumsum(index["frames"])
    places = range(shape[0]) if which is None else which
    images = new_array((len(places), *shape[1:]), np.float32, together)
    with file.open("rb") as stream:
        if hashlib.file_digest(stream, "sha256").hexdigest() != index["sha256"]:
            raise ValueError("checksum")
        for image, place in zip(images, places, strict=True):
            length = index["frames"][place]
            stream.seek(int(ends[place]) - length)
            frame = codec.decompress(stream.read(length), size, asbytes=True)
            values = np.frombuffer(frame, dtype).reshape(shape[1:])
            if dtype.kind == "u":
                np.divide(values, np.float32(_LEVELS), out=image)
            else:
                image[:] = values
    return images


def images_bytes(index: Mapping[str, Any]) -> int:
    """Size of all images of a file in memory."""
    return 4 * math.prod(map(int, index["shape"]))


def _levels(images: NDArray[np.float32]) -> NDArray[np.uint16]:
    return np.rint(np.clip(images, 0.0, 1.0) * _LEVELS).astype(_SIXTEEN_BITS)
