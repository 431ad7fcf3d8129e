"""8-bit RGBA pictures on disk: straight alpha in the file, premultiplied in memory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from econgs_bench.datasets.errors import DataError

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM", "TGA")
"""Formats of pictures that are read, whatever their names say. For some others Pillow starts programs."""
_EIGHT_BIT = {"1", "RGB", "RGBA", "L", "LA", "P", "PA"}
"""Modes of Pillow whose conversion to RGBA loses nothing."""


def write_png(path: Path, premultiplied: NDArray[np.float32]) -> None:
    """Write a picture: a temporary file, then renamed.

    Args:
        path: the file; its folder exists.
        premultiplied: (height, width, 4) RGBA, premultiplied; or (height, width, 3) RGB. In [0, 1].
    """
    straight = np.array(premultiplied, dtype=np.float64)
    if straight.shape[-1] == 4:
        alpha = straight[..., 3:]
        # Divide by the 8-bit alpha of the file: reading multiplies by it.
        file_alpha = np.rint(np.clip(alpha, 0.0, 1.0) * 255.0) / 255.0
        straight[..., :3] /= np.where(file_alpha > 0.0, file_alpha, 1.0)
        straight[..., :3] *= file_alpha > 0.0
    pixels = np.rint(np.clip(straight, 0.0, 1.0) * 255.0).astype(np.uint8)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        Image.fromarray(pixels).save(aside, format="PNG", compress_level=4)
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def read_png(path: Path, *, deep: bool = False) -> NDArray[np.float32]:
    """(height, width, 4) float32 premultiplied RGBA of a picture; alpha is 1 in files without.

    Args:
        path: one of :data:`FORMATS` of 8 bits a channel: gray, colors, a palette; with or without alpha.
        deep: PNG of 16 bits a channel is read, too.

    Raises:
        DataError: the file is missing, not a picture, or of other depth.
    """
    if deep and (channels := _sixteen_bits(path)) is not None:
        return channels
    with open_picture(path) as image:
        layouts = [tile[3] if isinstance(tile[3], str) else tile[3][0] for tile in getattr(image, "tile", ())]
        cut = any(";16" in str(layout) for layout in layouts)  # Pillow would cut colors to 8 bits
        if image.mode not in _EIGHT_BIT or cut:
            bits = "16 bits a channel" if cut else f"mode {image.mode}"
            raise DataError(path, f"has pixels of {bits}", "Write it again as 8-bit RGB or RGBA")
        pixels = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255.0
    pixels[..., :3] *= pixels[..., 3:]
    return pixels


def _sixteen_bits(path: Path) -> NDArray[np.float32] | None:
    """As :func:`read_png`, of a PNG of 16 bits a channel; None for any other file."""
    with open_picture(path) as image:
        if image.format != "PNG":
            return None
        transparent = image.info.get("transparency")
    with path.open("rb") as file:
        header = file.read(25)
        if header[24:] != b"\x10":  # bit depth in IHDR, the first chunk
            return None
    import imagecodecs

    try:
        values = np.atleast_3d(imagecodecs.png_decode(path.read_bytes())).astype(np.float32) / 65535.0
    except (imagecodecs.PngError, ValueError) as error:
        raise DataError(path, f"cannot be read as a picture ({error})", "Write it again") from error
    if transparent is not None and values.shape[2] in (1, 3):
        raise DataError(path, "has one transparent color beside 16 bits a channel", "Write it with alpha")
    alpha = values[..., -1:] if values.shape[2] in (2, 4) else np.ones_like(values[..., :1])
    colors = np.broadcast_to(values[..., : 3 if values.shape[2] > 2 else 1], (*alpha.shape[:2], 3))
    return np.concatenate([colors * alpha, alpha], axis=2)


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """An open picture file.

    Raises:
        DataError: the file is missing or not a picture.
    """
    try:
        with Image.open(path, formats=FORMATS) as image:
            yield image
    except FileNotFoundError as error:
        raise DataError(path, "no such picture", "Check the path") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(
            path, f"cannot be read as a picture ({error})", "Write it again as an 8-bit PNG"
        ) from error
