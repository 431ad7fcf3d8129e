"""Picture files of a run store: reading, compositing, and data URIs for the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.style import absent

if TYPE_CHECKING:
    import pandas as pd
    from PIL import Image

_SIDE = 400  # pixels; the page reduces larger pictures
_THUMBNAIL = 144  # pixels
_MOST = 2**26  # pixels of a picture that is read
_LOSSLESS = 256  # pixels; the page keeps every pixel of pictures up to this side


def inside(root: Path, name: Any) -> Path:
    """Path of a file in a store, from its name in a table.

    Raises:
        ValueError: the name is empty, or its path is not in the store.
    """
    if absent(name) or not name:
        raise ValueError("the table has no file name")
    path = (root / str(name)).resolve()
    if not path.is_relative_to(root.resolve()):
        raise ValueError(f"{name} is outside the run store")
    return path


def pictures(views: pd.DataFrame, root: Path) -> bool:
    """Whether any picture that the table `views` names exists."""
    return any((root / name).is_file() for name in views["render_file"].dropna())


def background(value: Any) -> tuple[float, float, float]:
    """RGB in [0, 1] of a color "#rrggbb".

    Raises:
        ValueError: the color is missing. (A guess would give other pictures than the measured ones.)
    """
    if absent(value):
        raise ValueError("the table has no background color")
    text = str(value)
    return (int(text[1:3], 16) / 255.0, int(text[3:5], 16) / 255.0, int(text[5:7], 16) / 255.0)


def read(path: Path, color: Iterable[float]) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 of a PNG with straight alpha, composited over a background color.

    Raises:
        OSError, ValueError, SyntaxError: it is damaged, or has more than :data:`_MOST` pixels.
    """
    from PIL import Image

    # No other format: Pillow starts programs for some, whatever the name says.
    try:
        with Image.open(path, formats=["PNG"]) as image:
            if image.width * image.height > _MOST:
                raise ValueError(f"{image.width} x {image.height} pixels")
            pixels = np.asarray(image.convert("RGBA"))
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error
    composite = np.empty((*pixels.shape[:2], 3), np.uint8)
    behind = np.asarray(list(color), dtype=np.float64)
    for target, row in zip(composite, pixels, strict=True):
        straight = row / 255.0
        alpha = straight[:, 3:]
        target[:] = np.rint((straight[:, :3] * alpha + (1.0 - alpha) * behind) * 255.0)
    return composite


def thumbnail(pixels: NDArray[np.uint8]) -> str:
    """A picture as a WebP data URI of a few kilobytes: lossy, reduced to 144 pixels a side."""
    from PIL import Image

    image = Image.fromarray(pixels)
    image.thumbnail((_THUMBNAIL, _THUMBNAIL), Image.Resampling.LANCZOS)
    return _encoded(image, quality=70)


def uri(pixels: NDArray[np.uint8]) -> str:
    """A picture as a WebP data URI: lossless if small, otherwise reduced to 400 pixels a side."""
    from PIL import Image

    image = Image.fromarray(pixels)
    if max(image.size) <= _LOSSLESS:
        return _encoded(image, lossless=True, quality=80)
    image.thumbnail((_SIDE, _SIDE), Image.Resampling.LANCZOS)
    return _encoded(image, quality=88)


def _encoded(image: Image.Image, **options: Any) -> str:
    file = io.BytesIO()
    image.save(file, "WEBP", method=4, **options)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
