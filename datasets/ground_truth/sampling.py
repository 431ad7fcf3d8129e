"""The rays of a pixel: its value is the mean over its area, not the value at its centre.

A pixel is the mean of premultiplied RGBA over its square: a box filter, one pixel wide. The square is cut
into cells with a ray through the middle of each (the midpoint rule), so cells of one size weigh the same.

With a fixed number of samples, k x k, all pixels have k x k cells. With :data:`ADAPTIVE` the cells follow
the picture, at first one a pixel:

* A pixel bends by how far its value, of any channel, is off the line between its two neighbours, along the
  row or the column. One that bends by more than :data:`BEND` is cut into 3 x 3, of which the middle one has
  its ray already. So is one that bends so against a cell of the pixel beside it.
* Of all these cells, those that bend most get four rays more, a third of their side from the middle along
  both diagonals. With a quarter of the middle and three of the others, the mean is exact for what is cubic in
  both directions. Of those again, the ones whose rays differ most get the four that make them 3 x 3. Both
  go on until the error of the picture is under :data:`GOAL`, if the others err in proportion to their bends,
  or differences, as the least of those did. A cell beside one of great differences bends at least by a part
  of them: an edge that no line between cells shows ends there.

Why a regular grid: most of what a pixel hides is smooth, and for that the midpoint rule errs with the square
of the cell's side. Points of low discrepancy, shifted at random, have 4 to 12 dB less at 16 rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from numbers import Integral
from typing import NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError

SAMPLING_VERSION = 2
"""Raised with every change of a picture of more than one ray a pixel; part of the key of cached views."""
ADAPTIVE = 0
"""Number of samples that means: as many as each pixel needs."""
MOST = 1024
"""Most samples a pixel."""
BEND = 0.02
"""Deviation of a pixel from the line between its neighbours that gives it more than one ray."""
GOAL = 57.0
"""PSNR [dB] of a picture against the mean over its pixels, from which 3 x 3 cells are not cut further."""
RAYS_AT_ONCE = 2**20
"""Rays of a launch."""

_FIRST_RATIOS = (0.035, 0.004)
"""Squared error of a cell over its squared bend (one ray) or difference (five rays), before any is known.

Over the bend it is 0.02 where all is smooth, to 0.14."""
_BESIDE = 0.05
"""Least squared bend of a cell, in parts of the squared differences of the cells around it in its pixel."""
_ROUNDS = 5
_PIXELS_AT_ONCE = 2**18
_IN_CACHE = 2**13  # pixels
_FACES = ((0, -1, (2, 5, 8), (0, 3, 6)), (0, 1, (0, 3, 6), (2, 5, 8)), (-1, 0, (6, 7, 8), (0, 1, 2)),
          (1, 0, (0, 1, 2), (6, 7, 8)))  # fmt: skip
"""A neighbour's place (down, right), those of its cells that touch the pixel, and the pixel's own there."""


class Places(NamedTuple):
    """Where rays cross pictures.

    Attributes:
        view: (R,) number of each ray's view.
        x: (R,) pixels from the left border.
        y: (R,) pixels from the upper border.
    """

    view: NDArray[np.uint32]
    x: NDArray[np.float32]
    y: NDArray[np.float32]


class Tracer(Protocol):
    """The rays of a scene."""

    def centres(self, cameras: Sequence[Camera]) -> NDArray[np.float32]:
        """(n, height, width, 4) premultiplied RGBA along the rays of all pixel centres."""
        ...

    def rays(self, cameras: Sequence[Camera], places: Places) -> NDArray[np.float32]:
        """(R, 4) premultiplied RGBA along rays through places of views of one size."""
        ...


def checked(samples: int, what: str) -> int:
    """A number of samples, as it came.

    Args:
        samples: a square, or :data:`ADAPTIVE`.
        what: who asks for it.

    Raises:
        DataError: it is none of those.
    """
    return ADAPTIVE if _whole(samples) == ADAPTIVE else samples_of(samples, what)


def samples_of(value: object, what: str) -> int:
    """A number of samples that a user asks for.

    Args:
        value: a square, as a number or its digits, or "auto".
        what: the option, or the function.

    Raises:
        DataError: it is neither.
    """
    if value == "auto":
        return ADAPTIVE
    number = _whole(value)
    root = math.isqrt(number) if 0 < number <= MOST else 0
    if root and number == root**2:
        return number
    near = f"{root**2} or {(root + 1) ** 2}, say" if root else "16, say"
    raise DataError(
        what,
        f"a pixel has 1, 4, 9, 16 ... {MOST} samples, not {value!r}",
        f'Take {near}, or "auto" for as many as each pixel needs',
    )


def _whole(value: object) -> int:
    """A whole number, or its digits; -1 for all else."""
    if isinstance(value, str) and value.isascii() and value.isdecimal() and len(value) < 9:
        return int(value)
    return int(cast(int, value)) if isinstance(value, Integral) and not isinstance(value, bool) else -1


def pictures(tracer: Tracer, cameras: Sequence[Camera], samples: int) -> NDArray[np.float32]:
    """Views as means over pixels.

    Args:
        tracer: of the scene.
        cameras: views of one size.
        samples: rays of each pixel, a square; or :data:`ADAPTIVE`.

    Returns:
        (n, height, width, 4) float32 premultiplied RGBA.
    """
    if samples == 1:
        return tracer.centres(cameras)
    shape = (len(cameras), cameras[0].height, cameras[0].width)
    if samples != ADAPTIVE:
        place = (np.arange(math.isqrt(samples)) + 0.5) / math.isqrt(samples)
        pixels, means = np.arange(math.prod(shape)), np.empty((math.prod(shape), 4), dtype=np.float32)
        at_once = max(1, RAYS_AT_ONCE // samples)
        for first in range(0, len(pixels), at_once):
            part = slice(first, first + at_once)
            means[part] = _mean(_traced(tracer, cameras, pixels[part], *_square(place)))
        return means.reshape(*shape, 4)
    image = tracer.centres(cameras)
    bent = _bent(image)
    height = shape[1]
    together = max(1, _PIXELS_AT_ONCE // math.prod(shape[1:]))  # views; a large one in bands of rows
    rows = max(1, min(height, _PIXELS_AT_ONCE // shape[2]))
    for view in range(0, len(cameras), together):
        for row in range(0, height, rows):
            band = (slice(view, view + together), slice(row, row + rows))
            image[band] = _refined(
                tracer, cameras[view : view + together], row, image[band].copy(), bent[band].copy()
            )
    return image


def _refined(
    tracer: Tracer,
    cameras: Sequence[Camera],
    first_row: int,
    image: NDArray[np.float32],
    bent: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Views, or a band of rows, with more rays where they need them.

    Args:
        tracer: of the scene.
        cameras: of the views.
        first_row: where the band begins.
        image: (n, rows, width, 4) values at the centres.
        bent: (n, rows, width) pixels to cut.
    """
    views, rows, width = bent.shape
    flat = image.reshape(-1, 4)

    def traced(
        pixels: NDArray[np.int64], x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        view, place = np.divmod(pixels, rows * width)
        return _traced(tracer, cameras, place + first_row * width + view * cameras[0].height * width, x, y)

    slot = np.full(views * rows * width, -1, dtype=np.int64)  # place of a pixel's cells among all cells
    cells = np.empty((0, 9, 4), dtype=np.float32)
    pixels = np.empty(0, dtype=np.int64)
    found = np.flatnonzero(bent)
    while len(found):
        slot[found] = len(pixels) + np.arange(len(found))
        pixels = np.concatenate([pixels, found])
        cells = np.concatenate([cells, _with_middle(flat[found], traced(found, *_AROUND))])
        more = []
        for down, right, _, own in _FACES:
            beside = _beside(found, rows, width, down, right)
            uncut = slot[beside] < 0
            facing = cells[slot[found[uncut]]][:, own]
            off = 0.5 * _largest(np.abs(facing - flat[beside[uncut], None])).max(axis=1)
            more.append(beside[uncut][off > BEND])
        found = np.unique(np.concatenate(more))
    if not len(pixels):
        return image
    order = np.argsort(pixels)
    pixels, cells = pixels[order], cells[order]
    slot[pixels] = np.arange(len(pixels))
    bends = _bends(pixels, cells, slot, flat, rows, width)
    _refine(cells, bends, pixels // (rows * width), rows * width, lambda n, x, y: traced(pixels[n], x, y))
    flat[pixels] = _mean(cells)
    return image


def _refine(
    cells: NDArray[np.float32],
    bends: NDArray[np.float32],
    view: NDArray[np.int64],
    size: int,
    traced: Callable[[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]], NDArray[np.float32]],
) -> None:
    """Give cells five rays, or nine, where they need them.

    Args:
        cells: (P, 9, 4) values along one ray each; those with more become their means.
        bends: (P, 9) of the cells.
        view: (P,) number of each pixel's view, from 0, ascending.
        size: pixels of a view.
        traced: (R, k, 4) values along rays through pixels, by numbers (R,) and places x, y (R, k).
    """
    allowed = 10.0 ** (-GOAL / 10.0) * size * 81
    errors = bends * bends  # but for their ratio
    totals, rays = np.zeros_like(cells), np.ones(bends.shape, dtype=np.int8)
    starts = np.searchsorted(view, np.arange(int(view[-1]) + 2))
    seen = [slice(*pair) for pair in pairwise(starts)]
    ratios = np.tile(np.array(_FIRST_RATIOS, dtype=np.float32), (len(seen), 1))
    for around in range(_ROUNDS):
        if around:
            _raise_beside(errors, rays)
        chosen = np.empty_like(rays)
        for own, ratio in zip(seen, ratios, strict=True):
            chosen[own] = _chosen(errors[own], rays[own], ratio, allowed)
        if not chosen.any():
            return
        for level, places in ((1, _SIDES), (0, _CORNERS)):
            number, cell = np.nonzero(chosen == 1 + level)
            if not len(number):
                continue
            x, y = (one[cell, None] + away / 9 for one, away in zip(_NINE, places, strict=True))
            more, before = traced(number, x, y), cells[number, cell]
            mean = _mean(more)
            if level:
                after = (totals[number, cell] + 4.0 * mean) / 9.0
            else:
                after = before + 0.75 * (mean - before)
                totals[number, cell] = before + 4.0 * mean
            change = ((after - before) ** 2).mean(axis=1)
            parts = np.searchsorted(number, starts)
            for one, part in enumerate(pairwise(parts)):
                mine = slice(*part)
                _learn(ratios[one], level, change[mine], errors[number[mine], cell[mine]])
            if not level:
                errors[number, cell] = _largest(np.abs(more - before[:, None])).max(axis=1) ** 2
            cells[number, cell] = after
            rays[number, cell] += 4


def _chosen(
    errors: NDArray[np.float32], rays: NDArray[np.int8], ratio: NDArray[np.float32], allowed: float
) -> NDArray[np.int8]:
    """(P, 9) cells of a view that get four rays more: 1 if they have one, 2 if they have five; others 0."""
    expected = errors * ratio[rays >> 2 & 1]
    expected[rays == 9] = 0.0
    chosen: NDArray[np.int8] = ((rays >> 2) + 1) * (expected >= _limit(expected.ravel(), allowed))
    return chosen


def _raise_beside(errors: NDArray[np.float32], rays: NDArray[np.int8]) -> None:
    """Raise errors of cells with one ray to a part of the largest around them, of those with more."""
    several = rays > 1
    pixels = np.flatnonzero(several.any(axis=1))
    block = np.zeros((len(pixels), 5, 5), dtype=np.float32)
    block[:, 1:4, 1:4] = np.where(several[pixels], errors[pixels], 0.0).reshape(-1, 3, 3)
    rows = np.maximum(np.maximum(block[:, :3], block[:, 1:4]), block[:, 2:])
    largest = np.maximum(np.maximum(rows[..., :3], rows[..., 1:4]), rows[..., 2:]).reshape(-1, 9)
    errors[pixels] = np.maximum(errors[pixels], np.where(several[pixels], 0.0, _BESIDE * largest))


def _learn(
    ratios: NDArray[np.float32], level: int, change: NDArray[np.float32], expected: NDArray[np.float32]
) -> None:
    """Set a view's ratio to the change over the expectation, of the half expected to change least."""
    if len(expected):
        least = expected <= np.median(expected)
        total = expected[least].sum(dtype=np.float64)
        if total > 0.0:
            ratios[level] = change[least].sum(dtype=np.float64) / total


def _limit(errors: NDArray[np.float32], allowed: float) -> float:
    """The error from which cells get more rays, so that smaller ones sum to what is allowed; inf: none."""
    # Few decide: those so small that they cannot reach half of what is allowed together are not sorted.
    large = errors[errors > 0.5 * allowed / max(1, len(errors))]
    allowed -= float(errors.sum(dtype=np.float64) - large.sum(dtype=np.float64))
    order = np.sort(large)
    left = int(np.searchsorted(np.cumsum(order, dtype=np.float64), allowed, side="right"))
    return float(order[left]) if left < len(order) else math.inf


def _bends(
    pixels: NDArray[np.int64],
    cells: NDArray[np.float32],
    slot: NDArray[np.int64],
    flat: NDArray[np.float32],
    rows: int,
    width: int,
) -> NDArray[np.float32]:
    """(P, 9) bend of each cell."""
    bends = np.empty((len(pixels), 3, 3), dtype=np.float32)
    for first in range(0, len(pixels), _IN_CACHE):
        part = slice(first, first + _IN_CACHE)
        middle = cells[part].reshape(-1, 3, 3, 4)
        facing = []
        for down, right, touching, _ in _FACES:
            beside = _beside(pixels[part], rows, width, down, right)
            other = slot[beside]
            touched = cells[other[:, None], touching]
            facing.append(np.where(other[:, None, None] < 0, flat[beside, None], touched))
        before, after, above, below = facing
        off = np.empty((2, *middle.shape), dtype=np.float32)
        off[0, :, :, 0] = before + middle[:, :, 1]
        off[0, :, :, 1] = middle[:, :, 0] + middle[:, :, 2]
        off[0, :, :, 2] = middle[:, :, 1] + after
        off[1, :, 0] = above + middle[:, 1]
        off[1, :, 1] = middle[:, 0] + middle[:, 2]
        off[1, :, 2] = middle[:, 1] + below
        off *= 0.5
        off -= middle
        np.abs(off, out=off)
        bends[part] = _largest(np.maximum(off[0], off[1]))
    return bends.reshape(-1, 9)


def _bent(image: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels of (n, height, width, 4) off the line between their neighbours along the row or the column."""
    if min(image.shape[1:3]) == 1:  # no neighbours, along one side at least
        return np.ones(image.shape[:3], dtype=bool)
    bent = np.zeros(image.shape[:3], dtype=bool)
    for axis in (1, 2):
        lines = np.moveaxis(image, axis, 0)
        before, at, after = lines[:-2], lines[1:-1], lines[2:]
        off = _largest(np.abs(0.5 * (before + after) - at)) > BEND
        np.moveaxis(bent, axis, 0)[1:-1] |= off
        for border, inner in ((0, 1), (-1, -2)):
            off = 0.5 * _largest(np.abs(lines[inner] - lines[border])) > BEND
            np.moveaxis(bent, axis, 0)[border] |= off
    return bent


def _beside(pixels: NDArray[np.int64], rows: int, width: int, down: int, right: int) -> NDArray[np.int64]:
    """The neighbours of pixels; beyond the border, the pixels themselves."""
    row, column = pixels // width % rows, pixels % width
    inside = (row + down >= 0) & (row + down < rows) & (column + right >= 0) & (column + right < width)
    return np.asarray(pixels + inside * (down * width + right))


def _traced(
    tracer: Tracer,
    cameras: Sequence[Camera],
    pixels: NDArray[np.int64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> NDArray[np.float32]:
    """(P, k, 4) values along rays of pixels.

    Args:
        tracer: of the scene.
        cameras: views of one size.
        pixels: (P,) their numbers, through all views.
        x: (k,) or (P, k) places within a pixel, from its left border, in [0, 1].
        y: the same from its upper border.
    """
    height, width = cameras[0].height, cameras[0].width
    k = x.shape[-1]
    values = np.empty((len(pixels), k, 4), dtype=np.float32)
    at_once = max(1, RAYS_AT_ONCE // k)
    for first in range(0, len(pixels), at_once):
        part = slice(first, first + at_once)
        view, place = np.divmod(pixels[part], height * width)
        row, column = np.divmod(place, width)
        right, down = (
            (number[:, None] + (within if within.ndim == 1 else within[part])).astype(np.float32).ravel()
            for number, within in ((column, x), (row, y))
        )
        places = Places(np.repeat(view.astype(np.uint32), k), right, down)
        values[part] = tracer.rays(cameras, places).reshape(-1, k, 4)
    return values


def _largest(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Largest of the four channels (..., 4); NumPy's own reduction of so few takes several times as long."""
    red, green, blue, alpha = (values[..., channel] for channel in range(4))
    largest: NDArray[np.float32] = np.maximum(np.maximum(red, green), np.maximum(blue, alpha))
    return largest


def _mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(P, 4) means of (P, k, 4)."""
    total = values[:, 0].astype(np.float64)
    for k in range(1, values.shape[1]):
        total += values[:, k]
    means: NDArray[np.float32] = (total / values.shape[1]).astype(np.float32)
    return means


def _with_middle(middle: NDArray[np.float32], others: NDArray[np.float32]) -> NDArray[np.float32]:
    """(P, 9, 4) cells of 3 x 3, from the (P, 4) middle ones and the (P, 8, 4) others."""
    return np.concatenate([others[:, :4], middle[:, None], others[:, 4:]], axis=1)


def _square(places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns and rows of all pairs of places, row by row."""
    return np.tile(places, len(places)), np.repeat(places, len(places))


_NINE = _square((np.arange(3) + 0.5) / 3)
"""x and y of the middles of the 3 x 3 cells of a pixel."""
_CORNERS = (np.array([-1.0, 1.0, -1.0, 1.0]), np.array([-1.0, -1.0, 1.0, 1.0]))
"""x and y of four rays, in thirds of a cell from its middle."""
_SIDES = (np.array([0.0, -1.0, 1.0, 0.0]), np.array([-1.0, 0.0, 0.0, 1.0]))
"""The same of four more, which make a cell with those 3 x 3."""
_AROUND = tuple(np.delete(one, 4) for one in _NINE)
"""x and y of the middles of the cells, without the middle one."""
