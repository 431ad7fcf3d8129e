"""Which values of a volume are shown: missing ones, outliers, and the range of all others.

A value is an outlier if it lies farther from all others than :data:`FAR` times the range of these others, as
one hot voxel does, or an undeclared fill value of 1e35. A range with it would leave one step of a table for
everything else. Outliers count as missing, and one line tells of them. Values of one byte have none: a table
has an entry for each.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.finish import check_range, value_range
from econgs_bench.datasets.readers.notices import notice
from econgs_bench.datasets.scratch import new_array

FAR = 100.0
"""Distance of an outlier from the range of all other values, in lengths of that range."""

_FAR_FILL = 4.0  # the same for repeated fill values by custom: -999, -9999, 1e20, 1e35
_RARE = 1e-3  # share of the values that may be outliers without being one fill value
_LEAST_FILL = 999.0  # magnitude of a fill value
_MOST_ISOLATED = 4096
_SAMPLES = (1 << 12, 1 << 17)
_CHUNK = 1 << 21


@dataclass(frozen=True)
class Limits:
    """A choice of the values that are shown.

    Attributes:
        value_range: data values (low, high) at 0 and 1 of a transfer function; "all": minimum and maximum,
            outliers included; None: minimum and maximum without outliers. Outliers within a given range are
            shown.
        missing: data values that stand for missing data; NaN is one of them or not.
        implied: whether ``value_range`` gives way to one that the file itself says.
    """

    value_range: tuple[float, float] | Literal["all"] | None = None
    missing: tuple[float, ...] = ()
    implied: bool = False

    def with_choice(self, other: Limits | None) -> Limits:
        """These limits, those of another choice where it has any."""
        if other is None:
            return self
        own = other.value_range is None or (other.implied and self.value_range is not None)
        given = self.value_range if own else other.value_range
        return Limits(given, other.missing or self.missing)


@dataclass(frozen=True, eq=False)
class Shown:
    """The values that are shown.

    Attributes:
        valid: of the values' shape, False for missing ones; None if all are valid.
        value_range: data values at 0 and 1 of a transfer function.
        whole: minimum and maximum with the outliers; None where there are none, or the range is given.
        isolated: (n, axes) indices of outliers without a neighbour among them; ``valid`` keeps them.
    """

    valid: NDArray[np.bool_] | None
    value_range: tuple[float, float]
    whole: tuple[float, float] | None = None
    isolated: NDArray[np.intp] | None = None


def shown(
    values: NDArray[np.generic], valid: NDArray[np.bool_] | None, limits: Limits, path: Path | str
) -> Shown:
    """Apply limits to values of any shape; a memory-mapped file is never in memory twice.

    Raises:
        DataError: a valid value is NaN or infinite, none is valid, all are equal and none is missing, they
            exceed single precision, or the range given does not ascend.
    """
    valid = _without(values, valid, limits.missing)
    low, high = value_range(values, path, valid)
    bounds, whole, isolated = (low, high), None, None
    rest = None if limits.value_range == "all" else _rest(values, valid, low, high)
    if rest is not None:
        a, b = rest
        if isinstance(limits.value_range, tuple):
            a, b = min(a, limits.value_range[0]), max(b, limits.value_range[1])
        if low < a or high > b:
            valid, isolated, number = _within(values, valid, a, b)
            bounds, whole = rest, (low, high)
            _report(path, number, values.size, bounds, whole)
    if isinstance(limits.value_range, tuple):
        bounds, whole = limits.value_range, None
        if not (math.isfinite(bounds[0]) and math.isfinite(bounds[1]) and bounds[0] < bounds[1]):
            raise DataError(path, f"range {list(bounds)} does not ascend", "Give the lower value first")
    if low == high and valid is not None:  # the shape of what is valid is something to see
        half = 0.5 * max(abs(low), 1.0)
        bounds = (low - half, low + half) if limits.value_range in (None, "all") else bounds
    check_range(*bounds, path)
    return Shown(valid, bounds, whole, isolated)


def mended(values: NDArray[np.generic], isolated: NDArray[np.intp]) -> None:
    """Replace isolated outliers by the mean of their neighbours, in place."""
    for place in isolated:
        around = [float(values[tuple(near)]) for near in _neighbours(place, values.shape)]
        values[tuple(place)] = np.mean(around)


def is_missing(part: NDArray[np.generic], missing: tuple[float, ...]) -> NDArray[np.bool_]:
    """Where values are one of the missing ones, which are compared in the type of the values."""
    result = np.zeros(part.shape, dtype=bool)
    for value in missing:
        if math.isnan(value):
            result |= np.isnan(part) if part.dtype.kind == "f" else False
        elif part.dtype.kind == "f":
            with np.errstate(over="ignore"):
                result |= part == part.dtype.type(value)
        else:
            result |= part == value
    return result


def _without(
    values: NDArray[np.generic], valid: NDArray[np.bool_] | None, missing: tuple[float, ...]
) -> NDArray[np.bool_] | None:
    if not missing:
        return valid
    result = new_array(values.shape, bool)
    for part in _parts(values):
        result[part] = ~is_missing(values[part], missing)
        if valid is not None:
            result[part] &= valid[part]
    return None if result.all() else result


def _parts(values: NDArray[np.generic]) -> Iterator[slice]:
    step = max(1, _CHUNK // max(values[0].size, 1))
    for start in range(0, len(values), step):
        yield slice(start, start + step)


def _rest(
    values: NDArray[np.generic], valid: NDArray[np.bool_] | None, low: float, high: float
) -> tuple[float, float] | None:
    """Minimum and maximum without outliers; None if there are none.

    Samples decide whether there can be any, a small one in most files; only then all values are looked at.
    """
    if values.dtype.itemsize == 1 or low == high:
        return None
    a, b, customary = low, high, set[float]()
    for size in _SAMPLES:
        found = _of_sample(values, valid, low, high, size)
        if found is None:
            return None
        a, b, customary = found
    while True:
        before, far = (a, b), FAR * (b - a)
        for part in _valid_parts(values, valid):
            within = part[(part >= before[0] - far) & (part <= before[1] + far)]
            for fill in customary:
                within = within[within != fill]
            if within.size:
                a, b = min(a, float(within.min())), max(b, float(within.max()))
        if (a, b) == before:
            break
    near = _FAR_FILL * (b - a)
    for fill in customary:
        if a - near <= fill <= b + near:
            a, b = min(a, fill), max(b, fill)
    if a <= low and high <= b:
        return None
    outside, total, ends = 0, 0, {low: 0, high: 0}
    for part in _valid_parts(values, valid):
        total += part.size
        outside += int(np.count_nonzero((part < a) | (part > b)))
        for end in ends:
            ends[end] += int(np.count_nonzero(part == end)) if not a <= end <= b else 0
    alike = sum(n for end, n in ends.items() if n > 1 and abs(end) >= _LEAST_FILL)
    return None if outside - alike > max(1.0, _RARE * total) else (a, b)


def _of_sample(
    values: NDArray[np.generic], valid: NDArray[np.bool_] | None, low: float, high: float, size: int
) -> tuple[float, float, set[float]] | None:
    """The range of a sample without its outliers, and fill values; None if there can be no outliers.

    The range of all values is no smaller: what lies near enough to that of a sample is no outlier.
    """
    stride = max(1, math.ceil((values.size / size) ** (1.0 / values.ndim)))
    some = (slice(None, None, stride),) * values.ndim
    sample = values[some] if valid is None else values[some][valid[some]]
    if _is_compact(sample, low, high):
        return None
    levels, counts = np.unique(np.append(sample.ravel(), [low, high]).astype(np.float64), return_counts=True)
    counts[[0, -1]] -= 1
    fills = _fills(levels, counts)
    inner = ~np.isin(levels, list(fills))
    if inner.sum() < 2:
        return (low, low, fills) if size < _SAMPLES[-1] else None
    a, b = _core(levels[inner], counts[inner])
    customary = {fill for fill in fills if _is_customary(fill)}
    a, b = _grown(levels[~np.isin(levels, list(customary))], a, b)
    for v in (low, high):
        reach = (_FAR_FILL if v in customary else FAR) * (b - a)
        if not a - reach <= v <= b + reach:
            return a, b, customary
    return None


def _is_compact(sample: NDArray[np.generic], low: float, high: float) -> bool:
    """Whether the middle half of a sample says at once that neither end is an outlier or a fill value."""
    if sample.size < 8:
        return False
    for end in (low, high):
        if _may_be_fill(end, int(np.count_nonzero(sample == end)), sample.size):
            return False
    i, j = sample.size // 4, (3 * sample.size) // 4
    middle = np.partition(sample.ravel(), (i, j))
    a, b = float(middle[i]), float(middle[j])
    return a < b and a - FAR * (b - a) <= low and high <= b + FAR * (b - a)


def _fills(levels: NDArray[np.float64], counts: NDArray[np.int64]) -> set[float]:
    """What may be fill values: repeated, or customary ones, at either end."""
    found: set[float] = set()
    for order in (range(len(levels)), range(len(levels) - 1, -1, -1)):
        for i in order[:3]:
            if not _may_be_fill(levels[i], counts[i], counts.sum()):
                break
            found.add(float(levels[i]))
    return found


def _may_be_fill(value: float, count: int, total: int) -> bool:
    often = count > _RARE * total and abs(value) >= _LEAST_FILL
    return often or _is_customary(value)


def _is_customary(value: float) -> bool:
    if abs(value) >= 1e19:  # 1e20, 9.96921e36, 1e35...
        return True
    digits = f"{-value:.0f}"
    return value == round(value) and len(digits) > 2 and set(digits) == {"9"}


def _core(levels: NDArray[np.float64], counts: NDArray[np.int64]) -> tuple[float, float]:
    """The middle half of the values, at least two levels."""
    share = np.cumsum(counts) / max(int(counts.sum()), 1)
    i, j = (min(int(np.searchsorted(share, s)), len(levels) - 1) for s in (0.25, 0.75))
    if i == j:
        below = levels[i] - levels[i - 1] if i else math.inf
        above = levels[j + 1] - levels[j] if j + 1 < len(levels) else math.inf
        i, j = (i - 1, j) if below < above else (i, j + 1)
    return float(levels[i]), float(levels[j])


def _grown(levels: NDArray[np.float64], a: float, b: float) -> tuple[float, float]:
    """The range of levels of which no gap separates them."""
    while True:
        far = FAR * (b - a)
        within = levels[(levels >= a - far) & (levels <= b + far)]
        low, high = min(a, float(within[0])), max(b, float(within[-1]))
        if (low, high) == (a, b):
            return a, b
        a, b = low, high


def _valid_parts(values: NDArray[np.generic], valid: NDArray[np.bool_] | None) -> Iterator[NDArray[Any]]:
    for part in _parts(values):
        yield values[part] if valid is None else values[part][valid[part]]


def _within(
    values: NDArray[np.generic], valid: NDArray[np.bool_] | None, a: float, b: float
) -> tuple[NDArray[np.bool_] | None, NDArray[np.intp] | None, int]:
    """Validity without outliers, the isolated ones of a grid, and the number of outliers."""
    result = new_array(values.shape, bool)
    number = 0
    for part in _parts(values):
        piece: NDArray[Any] = values[part]
        inside = (piece >= a) & (piece <= b)
        before = np.ones(piece.shape, dtype=bool) if valid is None else valid[part]
        number += int(np.count_nonzero(before & ~inside))
        result[part] = before & inside
    if values.ndim != 3 or number > _MOST_ISOLATED:
        return result, None, number
    places = np.argwhere(~result if valid is None else valid & ~result)
    alone = [p for p in places if all(result[tuple(near)] for near in _neighbours(p, values.shape))]
    if not alone:
        return result, None, number
    isolated = np.array(alone)
    result[tuple(isolated.T)] = True
    return None if result.all() else result, isolated, number


def _neighbours(place: NDArray[np.intp], shape: tuple[int, ...]) -> Iterator[NDArray[np.intp]]:
    for axis, length in enumerate(shape):
        for step in (-1, 1):
            near = place.copy()
            near[axis] += step
            if 0 <= near[axis] < length:
                yield near


def _report(
    path: Path | str, number: int, size: int, bounds: tuple[float, float], whole: tuple[float, float]
) -> None:
    beyond = " and ".join(f"{v:g}" for v, out in zip(whole, (whole[0] < bounds[0], whole[1] > bounds[1]),
                                                      strict=True) if out)  # fmt: skip
    many = f"{number} of {size} values lie" if number > 1 else f"1 of {size} values lies"
    notice(
        f"{path}: {many} far beyond the others ({bounds[0]:g} to {bounds[1]:g}), up to {beyond}, and counts "
        "as missing; a `range` that holds it shows it"
    )
