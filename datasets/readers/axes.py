"""Sample positions along the axes: uniform ones become a spacing, others need resampling."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import limits as shown
from econgs_bench.datasets.readers.fields import Field
from econgs_bench.datasets.readers.finish import checked_grid
from econgs_bench.datasets.readers.limits import Limits
from econgs_bench.datasets.readers.notices import notice
from econgs_bench.datasets.scratch import converted, new_array

CAP = 512
"""Maximum number of samples of a resampled axis (its own number if that is larger)."""

_UNEVEN = 1e-3
"""Deviation from uniform positions, in sample distances, that counts as rounding."""


def place(
    values: NDArray[np.generic],
    axes: Sequence[NDArray[np.generic] | None],
    path: Path,
    limits: Limits,
    mask: NDArray[np.bool_] | None = None,
) -> Field:
    """A field with samples at given positions, on a uniform grid, checked.

    Uniform axes stay, descending ones are reversed. Others are resampled linearly at their finest spacing, to
    at most ``CAP`` samples an axis, with a notice in the log.

    Args:
        values: (nz, ny, nx).
        axes: positions along x, y, z; an axis without (None) has the mean distance of the others.
        path: the file, for messages.
        limits: which values are shown.
        mask: (nz, ny, nx), False for missing values: they become continuations of their neighbours.

    Raises:
        DataError: as :func:`.datasets.readers.finish.checked_grid` and
            :func:`.datasets.readers.limits.shown`, or positions are not finite, or neither
            ascending nor descending.
    """
    given = values
    values = checked_grid(values, path)
    found = shown.shown(values, None if mask is None or mask.all() else mask, limits, path)
    mask = found.valid
    if (mask is not None or found.isolated is not None) and np.may_share_memory(values, given):
        values = converted(values, values.dtype)
    if found.isolated is not None:
        shown.mended(values, found.isolated)
    if mask is not None:
        fill_outside(values, mask, found.value_range[0])
    spacing = [1.0, 1.0, 1.0]
    uneven: dict[int, NDArray[np.float64]] = {}
    for i, (name, axis) in enumerate(zip("xyz", axes, strict=True)):
        if axis is None or len(axis) < 2:
            continue
        positions = axis.astype(np.float64)
        finite = bool((np.abs(positions) < 1e30).all())
        steps = np.diff(positions) if finite else positions
        if not finite or not ((steps > 0).all() or (steps < 0).all()):
            remedy = "Write ascending or descending, finite positions"
            raise DataError(path, f"positions along {name} are not monotonic", remedy)
        if steps[0] < 0:
            positions, steps = positions[::-1], -steps[::-1]
            values = np.flip(values, 2 - i)
            mask = None if mask is None else np.flip(mask, 2 - i)
        spacing[i] = float(positions[-1] - positions[0]) / (len(positions) - 1)
        even = positions[0] + spacing[i] * np.arange(len(positions))
        rounding = 8.0 * float(np.finfo(axis.dtype.str).eps) if axis.dtype.kind == "f" else 0.0
        tolerance = _UNEVEN * spacing[i] + rounding * float(np.abs(positions).max())
        if float(np.abs(positions - even).max()) > tolerance:
            length = float(positions[-1] - positions[0])
            n = max(int(min(np.ceil(length / steps.min() - 1e-6) + 1, CAP)), len(positions))
            spacing[i] = length / (n - 1)
            uniform = np.linspace(positions[0], positions[-1], n)
            uneven[2 - i] = np.interp(uniform, positions, np.arange(len(positions)))
            if not np.isfinite(uneven[2 - i]).all():
                remedy = "Write positions that double precision can distinguish"
                raise DataError(path, f"positions along {name} lie too close to each other", remedy)
    size = None if all(axis is None for axis in axes) else (spacing[0], spacing[1], spacing[2])
    if size is not None and any(axis is None for axis in axes):
        known = [distance for distance, axis in zip(size, axes, strict=True) if axis is not None]
        mean = sum(known) / len(known)
        x, y, z = (mean if axis is None else d for d, axis in zip(size, axes, strict=True))
        size = x, y, z
        without = ", ".join(name for name, axis in zip("xyz", axes, strict=True) if axis is None)
        notice(f"{path}: no sample distance along {without}: the mean of the others is taken; "
               "`spacing` sets all three")  # fmt: skip
    if not uneven:
        return Field(values, size, mask, found.value_range, found.whole)
    before = " x ".join(str(n) for n in reversed(values.shape))
    values = resample(values, uneven)
    if mask is not None:
        for at, fractions in uneven.items():
            mask = np.take(mask, np.rint(fractions).astype(np.intp), at)
    after = " x ".join(str(n) for n in reversed(values.shape))
    names = ", ".join("zyx"[at] for at in sorted(uneven, reverse=True))
    notice(f"{path}: samples along {names} are unevenly spaced; resampled from {before} to {after}")
    return Field(values, size, mask, found.value_range, found.whole)


def resample(values: NDArray[np.generic], fractions: dict[int, NDArray[np.float64]]) -> NDArray[np.generic]:
    """Linear interpolation at fractional indices along some axes of (nz, ny, nx), slice by slice."""
    kind = np.float64 if values.dtype.itemsize > 4 else np.float32
    shape = [len(fractions[a]) if a in fractions else n for a, n in enumerate(values.shape)]
    out = new_array(shape, kind)
    within = {a: _weights(f, values.shape[a], kind) for a, f in fractions.items()}
    for k in range(shape[0]):
        if 0 in within:
            low, weight = within[0]
            plane = values[low[k]].astype(kind)
            if weight[k] > 0.0:
                plane += weight[k] * (values[low[k] + 1].astype(kind) - plane)
        else:
            plane = values[k].astype(kind)
        for axis in (1, 2):
            if axis in within:
                low, weight = within[axis]
                first, second = np.take(plane, low, axis - 1), np.take(plane, low + 1, axis - 1)
                plane = first + (weight[:, None] if axis == 1 else weight) * (second - first)
        out[k] = plane
    return out


def _weights(fractions: NDArray[np.float64], n: int, kind: type) -> tuple[NDArray[np.intp], NDArray[Any]]:
    low = np.minimum(fractions.astype(np.intp), n - 2)
    return low, (fractions - low).astype(kind)


def fill_outside(values: NDArray[np.generic], mask: NDArray[np.bool_], rest: float) -> None:
    """Continue valid values over the border, in place: two samples far in every direction, ``rest`` beyond.

    Interpolation and central differences at valid samples then see no jump.
    """
    for part, valid in zip(values, mask, strict=True):
        part[~valid] = rest
    reached = converted(mask, bool)
    for _ in range(2):
        for axis in range(3):
            here, ahead = _neighbours(axis)
            for block in _blocks(values.shape, axis):
                value, valid = values[block], reached[block]
                up, down = valid[here] > valid[ahead], valid[here] < valid[ahead]
                value[ahead][up] = value[here][up]
                value[here][down] = value[ahead][down]
                valid[ahead] |= up
                valid[here] |= down


def _blocks(shape: tuple[int, ...], axis: int) -> Iterator[tuple[slice, ...]]:
    """Parts of a grid with whole lines along an axis, so that temporary arrays are small."""
    across = 1 if axis == 0 else 0
    step = max(1, (1 << 20) * shape[across] // math.prod(shape))
    for start in range(0, shape[across], step):
        part = slice(start, start + step)
        yield (slice(None), part) if across else (part,)


def _neighbours(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    here = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
    ahead = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
    return here, ahead
