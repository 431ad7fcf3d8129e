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
from numbers import Integral
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from datasets.camera import Camera
from datasets.errors import DataError

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
        view: (P,) number of each pixel's view, from 0.
        size: pixels of a view.
        traced: (R, k, 4) values along rays through pixels, by numbers (R,) and places x, y (R, k).
    """
    allowed = 10.0 ** (-GOAL / 10.0) * size * 81
    errors = bends.astype(np.float64) ** 2  # but for their ratio
    totals, rays = cells.astype(np.float64), np.ones(bends.shape, dtype=np.int64)
    seen = [view == one for one in range(int(view.max()) + 1)]
    ratios = np.tile(_FIRST_RATIOS, (len(seen), 1))
    for _ in range(_ROUNDS):
        around = _BESIDE * _largest_around(np.where(rays > 1, errors, 0.0))
        errors = np.where(rays == 1, np.maximum(errors, around), errors)
        expected = errors * np.where(rays == 1, ratios[view, :1], ratios[view, 1:])
        limits = np.array([_limit(expected[own][rays[own] < 9], allowed) for own in seen])
        chosen = (rays < 9) & (expected >= limits[view, None])
        if not chosen.any():
            return
        for level, places in ((1, _SIDES), (0, _CORNERS)):
            number, cell = np.nonzero(chosen & (rays == 1 + 4 * level))
            if not len(number):
                continue
            x, y = (one[cell, None] + away / 9 for one, away in zip(_NINE, places, strict=True))
            more, before = traced(number, x, y), cells[number, cell]
            totals[number, cell] += 4.0 * _mean(more)
            if level:
                after = (totals[number, cell] / 9.0).astype(np.float32)
            else:
                after = before + 0.75 * (_mean(more) - before)
            change = ((after - before) ** 2).mean(axis=1)
            for one, own in enumerate(seen):
                _learn(ratios[one], level, change, errors[number, cell], own[number])
            if not level:
                errors[number, cell] = _largest(np.abs(more - before[:, None])).max(axis=1) ** 2
            cells[number, cell] = after
            rays[number, cell] += 4


def _learn(
    ratios: NDArray[np.float64],
    level: int,
    change: NDArray[np.float64],
    expected: NDArray[np.float64],
    own: NDArray[np.bool_],
) -> None:
    """Set a view's ratio to the change over the expectation, of the half expected to change least."""
    mine = expected[own]
    least = mine <= np.median(mine) if len(mine) else own[:0]
    if mine[least].sum() > 0.0:
        ratios[level] = change[own][least].sum() / mine[least].sum()


def _largest_around(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 9) largest value of each cell and those beside it in its pixel, corners too."""
    block = np.pad(values.reshape(-1, 3, 3), ((0, 0), (1, 1), (1, 1)))
    rows = np.maximum(np.maximum(block[:, :3], block[:, 1:4]), block[:, 2:])
    return np.maximum(np.maximum(rows[..., :3], rows[..., 1:4]), rows[..., 2:]).reshape(-1, 9)


def _limit(squares: NDArray[np.float64], allowed: float) -> float:
    """The value from which cells are cut, so that those below sum to what is allowed; inf if all may stay."""
    order = np.sort(squares)
    left = int(np.searchsorted(np.cumsum(order), allowed, side="right"))
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
    block = np.empty((len(pixels), 5, 5, 4), dtype=np.float32)
    block[:, 1:4, 1:4] = cells.reshape(-1, 3, 3, 4)
    edges: tuple[Any, ...] = (np.s_[:, 1:4, 0], np.s_[:, 1:4, 4], np.s_[:, 0, 1:4], np.s_[:, 4, 1:4])
    for (down, right, touching, _), edge in zip(_FACES, edges, strict=True):
        beside = _beside(pixels, rows, width, down, right)
        other = slot[beside]
        block[edge] = np.where(other[:, None, None] < 0, flat[beside, None], cells[other][:, touching])
    middle = block[:, 1:4, 1:4]
    across = 0.5 * (block[:, 1:4, :3] + block[:, 1:4, 2:]) - middle
    along = 0.5 * (block[:, :3, 1:4] + block[:, 2:, 1:4]) - middle
    return _largest(np.maximum(np.abs(across), np.abs(along))).reshape(-1, 9)


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
