"""Contact sheets: one picture with small views of many scenes and their transfer functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from econgs_bench.reports.pictures.transfer import AXIS, draw_level, draw_transfer, pixels

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

_WIDTH = 1500  # pixels of a sheet, unless a single tile is wider
_GAP = 14
_LINE = 18
_CURVE = 72  # height of a transfer function
_AXIS = 16  # and of the values below it
_INK, _PALE, _BARS = (20, 20, 20), AXIS, (222, 222, 222)
_LEAST = 420  # pixels; least width of a tile, for its texts


@dataclass(frozen=True, eq=False)
class Tile:
    """One scene or composition.

    Attributes:
        title: name.
        note: text beside the name: the variable, or the scenes of a composition.
        views: one or more composited views, (height, width, 3) in [0, 1].
        coverage: mean alpha of the views.
        histogram: (n,) counts of normalised values in equal bins; empty for none.
        transfer: (m, 4) color and opacity in [0, 1] at equidistant normalised values; empty for none.
        levels: normalised value and color of each isosurface.
        scale: data values at the normalised values 0 and 1, written below the curve; None for none.
    """

    title: str
    note: str
    views: tuple[NDArray[np.floating], ...]
    coverage: float
    histogram: NDArray[np.integer] | None = None
    transfer: NDArray[np.floating] | None = None
    levels: tuple[tuple[float, tuple[float, float, float]], ...] = ()
    scale: tuple[float, float] | None = None

    @property
    def has_curve(self) -> bool:
        return self.transfer is not None or bool(self.levels)


def contact_sheet(title: str, tiles: Sequence[Tile]) -> NDArray[np.uint8]:
    """A picture of all tiles, row by row.

    A tile has its title, and ``coverage`` to the right of it. Below are the views, and the logarithmic
    histogram of the variable (gray) over normalised values 0 to 1 with the transfer function on it: the area
    under the opacity has the color of the value, and isosurfaces are lines.

    Args:
        title: heading of the sheet.
        tiles: one or more tiles.

    Returns:
        (height, width, 3) picture.
    """
    from PIL import Image, ImageDraw

    wide = max(_LEAST, *(sum(v.shape[1] for v in tile.views) for tile in tiles))
    columns = max(1, min(len(tiles), (_WIDTH - _GAP) // (wide + _GAP)))
    rows = [list(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    heights = [max(_height(tile) for tile in row) + _GAP for row in rows]
    size = (columns * (wide + _GAP) + _GAP, sum(heights) + 2 * _GAP + 28)
    sheet = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    draw.text(
        (_GAP, _GAP), _fitting(title, 20, size[0] - 2 * _GAP, bold=True), fill=_INK, font=_font(20, bold=True)
    )
    top = _GAP + 36
    for row, height in zip(rows, heights, strict=True):
        for column, tile in enumerate(row):
            left = _GAP + column * (wide + _GAP)
            _head(draw, tile, left, top, wide)
            at, tall = left, max(v.shape[0] for v in tile.views)
            for view in tile.views:
                sheet.paste(Image.fromarray(pixels(view)), (at, top + _LINE + 4))
                at += view.shape[1]
            if tile.has_curve:
                curve = Image.fromarray(pixels(_curve(tile, wide)))
                below = top + _LINE + 4 + tall + 6
                sheet.paste(curve, (left, below))
                _values(draw, tile, left, below + _CURVE, wide)
        top += height
    return np.asarray(sheet)


def _height(tile: Tile) -> int:
    return _LINE + 4 + max(len(v) for v in tile.views) + (6 + _CURVE + _AXIS if tile.has_curve else 0)


def _head(draw: ImageDraw, tile: Tile, left: int, top: int, wide: int) -> None:
    coverage = f"alpha {100 * tile.coverage:.1f} %"
    right = left + wide - draw.textlength(coverage, font=_font(13))
    draw.text((right, top), coverage, fill=_PALE, font=_font(13))
    name = _fitting(tile.title, 14, right - left - 10, bold=True)
    draw.text((left, top), name, fill=_INK, font=_font(14, bold=True))
    after = left + draw.textlength(name, font=_font(14, bold=True)) + 10
    if right - after > 40:
        note = _fitting(tile.note, 13, right - after - 10)
        draw.text((after, top), note, fill=_PALE, font=_font(13))


def _values(draw: ImageDraw, tile: Tile, left: int, top: int, wide: int) -> None:
    """Normalised values below a curve, with the data's own."""
    font = _font(11)
    for ticks in (5, 3, 2):
        texts = [_value(tile, i / (ticks - 1)) for i in range(ticks)]
        if max(draw.textlength(text, font=font) for text in texts) < 0.8 * wide / (ticks - 1):
            break
    for i, text in enumerate(texts):
        share = i / (len(texts) - 1)
        at = left + round(share * (wide - 1))
        draw.line((at, top, at, top + 3), fill=_PALE)
        start = at - share * draw.textlength(text, font=font)
        draw.text((start, top + 3), text, fill=_PALE, font=font)


def _value(tile: Tile, share: float) -> str:
    if tile.scale is None:
        return f"{share:g}"
    value = tile.scale[0] + share * (tile.scale[1] - tile.scale[0])
    return f"{share:g} = {float(f'{value:.4g}'):.10g}"  # four digits, and no exponent if it can be helped


def _curve(tile: Tile, wide: int) -> NDArray[np.floating]:
    """(_CURVE, wide, 3): histogram, transfer function and levels over values 0 to 1."""
    picture = np.ones((_CURVE, wide, 3))
    across = (np.arange(wide) + 0.5) / wide
    up = (_CURVE - 1 - np.arange(_CURVE) + 0.5)[:, None] / _CURVE
    if tile.histogram is not None and tile.histogram.max() > 0:
        bins = np.minimum((across * len(tile.histogram)).astype(int), len(tile.histogram) - 1)
        share = np.log1p(tile.histogram)[bins] / math.log1p(tile.histogram.max())
        picture[up < share[None]] = np.asarray(_BARS) / 255.0
    if tile.transfer is not None:
        draw_transfer(picture, tile.transfer)
    for value, level in tile.levels:
        draw_level(picture, value, level)
    picture[-1] = np.asarray(_PALE) / 255.0
    return picture


def _fitting(text: str, size: int, room: float, *, bold: bool = False) -> str:
    """The text, with an ellipsis if it does not fit."""
    font = _font(size, bold=bold)
    if font.getlength(text) <= room:
        return text
    while text and font.getlength(text + "\N{HORIZONTAL ELLIPSIS}") > room:
        text = text[:-1]
    return text.rstrip(" ,") + "\N{HORIZONTAL ELLIPSIS}"


@cache
def _font(size: int, *, bold: bool = False) -> FreeTypeFont:
    """DejaVu Sans from the package Matplotlib."""
    import matplotlib
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
