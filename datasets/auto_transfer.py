"""Automatic transfer functions for unknown data."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.scene import BasicScene
from datasets.transfer import Bump, TransferFunction
from datasets.volume import Volume

COLORS = (
    (0.34, 0.71, 0.91),
    (0.90, 0.62, 0.00),
    (0.80, 0.47, 0.65),
    (0.00, 0.62, 0.45),
    (0.84, 0.37, 0.00),
    (0.00, 0.45, 0.70),
    (0.94, 0.89, 0.26),
)
"""Palette of Okabe and Ito, distinct for color-blind readers too."""

_BINS = 256
_MAX_SAMPLES = 160  # per axis: enough for a histogram, and fast for any volume
_REFERENCE_LENGTH = 0.01
_LEAST_SHARE = 1e-3  # of the voxels: parts with fewer are hardly visible
_SURFACE_DEPTH = 1.2  # optical depth of one crossing of a surface: 70 % opaque


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of ``n`` equal bins of normalised values.

    Attributes:
        count: (n,) voxels.
        area: (n,) sum of gradient magnitudes: proportional to the area of the bin's isosurface
            (co-area formula), so homogeneous regions weigh nothing, however large they are.
        gradient: (n,) mean gradient magnitude per unit of scene space; 0 in bins without voxels.
        background: bins that belong to the homogeneous surroundings.
    """

    count: NDArray[np.int64]
    area: NDArray[np.float64]
    gradient: NDArray[np.float64]
    background: NDArray[np.bool_]


def automatic_scenes(volume: Volume, count: int = 3) -> tuple[BasicScene, ...]:
    """Basic scenes whose opacity bumps share the occupied value range without overlap.

    The range outside the homogeneous background is cut where isosurface areas are equal and, nearby, where
    gradients are weakest; each part becomes a bump with its plateau at the part's strongest boundary, and
    an opacity that makes one crossing of that boundary mostly, not fully, opaque. A part that has background
    in its middle (zero, of signed data) becomes a scene of two bumps, one on each side.

    Args:
        volume: the volume to show.
        count: number of scenes; the result has fewer where the values hold fewer distinct parts.

    Raises:
        DataError: count < 1.
    """
    if count < 1:
        raise DataError(f"{count} automatic scenes", "there must be at least one", "Ask for 3, say")
    stats = statistics(volume)
    cuts = _cuts(stats, count)
    scenes = []
    for i, (low, high) in enumerate(pairwise(cuts)):
        name = f"tf{i + 1}"
        pieces = _without_background(stats, low, high)
        bumps = tuple(
            _bump(name if len(pieces) == 1 else f"{name} {side}", stats, *piece, COLORS[i % len(COLORS)])
            for piece, side in zip(pieces, ("below", "above"), strict=False)
        )
        scenes.append(BasicScene(name, volume.name, TransferFunction(name, bumps, _REFERENCE_LENGTH)))
    return tuple(scenes)


def statistics(volume: Volume) -> Statistics:
    """Histogram, isosurface areas and mean gradients of a volume (of a regular subset if it is large).

    Samples that the volume's mask leaves out count nothing.
    """
    strides = [-(-n // _MAX_SAMPLES) for n in volume.values.shape]
    subset = tuple(slice(None, None, stride) for stride in strides)
    values = volume.values[subset]
    valid = np.ones(values.shape, dtype=bool) if volume.mask is None else volume.mask[subset]
    if not valid.any():  # a mesh thinner than the strides
        valid = np.ones(values.shape, dtype=bool)
    coarse = Volume(volume.name, values, volume.spacing, volume.value_range, volume.source).normalised()
    distances = volume.extent[::-1] / (np.array(volume.values.shape) - 1) * strides
    squared = np.zeros_like(coarse)
    for axis in range(3):
        if coarse.shape[axis] > 1:
            squared += np.gradient(coarse, float(distances[axis]), axis=axis) ** 2
    slope = np.sqrt(squared)[valid]
    bins = _bin(coarse[valid])
    number = np.bincount(bins, minlength=_BINS)
    area = np.bincount(bins, weights=slope, minlength=_BINS).astype(np.float64)
    gradient = area / np.maximum(number, 1)
    stats = Statistics(number, area, gradient, np.zeros(_BINS, dtype=bool))
    return replace(stats, background=_background(coarse, valid, stats))


def _bin(values: NDArray[np.float32]) -> NDArray[np.int64]:
    return np.minimum((values * _BINS).astype(np.int64), _BINS - 1)


def _background(
    values: NDArray[np.float32], valid: NDArray[np.bool_], stats: Statistics
) -> NDArray[np.bool_]:
    """Bins around the commonest value of the volume's border (of all, where the mask leaves no border).

    A value that is common inside too and homogeneous (weak gradients) takes its noise with it. While the
    background covers less than half of the volume, it grows towards the commoner neighbour: values that fill
    the box would hide everything else.
    """
    number = stats.count
    total = int(number.sum())
    ends = [(k, axis) for axis in range(3) for k in (0, -1)]
    faces = np.concatenate([np.take(values, *end)[np.take(valid, *end)] for end in ends])
    if not len(faces):
        faces = values[valid]
    low = high = int(np.bincount(_bin(faces), minlength=_BINS).argmax())
    near = slice(max(low - 2, 0), low + 3)
    common = number[near].sum()
    slope = stats.area[near].sum() / max(common, 1)
    if common >= 0.1 * total and slope <= 0.5 * stats.area.sum() / total:
        smooth = np.convolve(number, np.ones(3), mode="same")  # integers leave bins empty
        low, high = _grow(smooth, low, -1, 0.02), _grow(smooth, high, 1, 0.02)
        if high - low > _BINS // 4:  # a smooth decay is structure, not noise
            low, high = max(near.start, 0), min(near.stop, _BINS) - 1
    rest = total - int(number[low : high + 1].sum())
    while rest > 0.5 * total and (low > 0 or high < _BINS - 1):
        below = number[low - 1] if low > 0 else -1
        above = number[high + 1] if high < _BINS - 1 else -1
        if rest - max(below, above) < 0.2 * total:
            break
        rest -= int(max(below, above))
        low, high = (low - 1, high) if below > above else (low, high + 1)
    inside = np.zeros(_BINS, dtype=bool)
    inside[low : high + 1] = True
    return inside


def _grow(number: NDArray[np.floating], start: int, step: int, share: float) -> int:
    """The last bin from ``start`` on with more than that share of its count."""
    at = start
    while 0 <= at + step < _BINS and number[at + step] > share * number[start]:
        at += step
    return at


def _cuts(stats: Statistics, count: int) -> list[float]:
    """Ends of the bumps, ascending in [0, 1]: each part holds at least one occupied bin."""
    area = np.where(stats.background, 0.0, stats.area)
    occupied = np.flatnonzero((stats.count > 0) & ~stats.background)
    if not len(occupied) or area.sum() <= 0.0:
        return _two_valued(stats)
    share = np.cumsum(area) / area.sum()
    first = max(int(np.searchsorted(share, 0.005)), int(occupied[0]))
    last = min(int(np.searchsorted(share, 0.998)), int(occupied[-1]))
    if last - first < 4 or len(occupied) < 3:
        return _two_valued(stats)
    parts = min(count, (last - first + 1) // 4)
    level = share[first - 1] if first else 0.0
    targets = level + (share[last] - level) * np.arange(1, parts) / parts
    edges = [first, *(int(i) + 1 for i in np.searchsorted(share, targets)), last + 1]
    for i in range(1, parts):
        reach = max(min(edges[i] - edges[i - 1], edges[i + 1] - edges[i]) // 4, 0)
        window = np.arange(edges[i] - reach, min(edges[i] + reach, _BINS - 1) + 1)
        weak = np.where(stats.count[window] > 0, stats.gradient[window], np.inf)
        if np.isfinite(weak).any():
            edges[i] = int(window[weak.argmin()])
    ends = [edges[0]]
    for edge in edges[1:]:
        if edge - ends[-1] >= 3 and stats.count[ends[-1] : edge].sum() > 0:
            ends.append(edge)
    ends[-1] = edges[-1]
    ends = _merge(stats, ends)
    return [e / _BINS for e in ends] if len(ends) > 1 else _two_valued(stats)


def _merge(stats: Statistics, edges: list[int]) -> list[int]:
    """Edges of the parts after each part with too few voxels has joined a neighbour."""
    number = np.where(stats.background, 0, stats.count)
    edges = list(edges)
    while len(edges) > 2:
        sizes = [number[low:high].sum() for low, high in pairwise(edges)]
        least = int(np.argmin(sizes))
        if sizes[least] >= _LEAST_SHARE * stats.count.sum():
            break
        above = least + 1 < len(sizes) and (least == 0 or sizes[least + 1] < sizes[least - 1])
        del edges[least + 1 if above else least]
    return edges


def _without_background(stats: Statistics, low: float, high: float) -> list[tuple[float, float]]:
    """Pieces of a part below and above the background; the part itself if neither holds voxels."""
    first, last = round(low * _BINS), round(high * _BINS)
    inside = np.flatnonzero(stats.background[first:last]) + first
    if not len(inside):
        return [(low, high)]
    pieces = [(low, inside[0] / _BINS), ((inside[-1] + 1) / _BINS, high)]
    number = stats.count
    occupied = [(a, b) for a, b in pieces if b > a and number[round(a * _BINS) : round(b * _BINS)].any()]
    # Slivers beside the background are thinner than a ray's step, and show as dots.
    wide = [(a, b) for a, b in occupied if b - a > 4 / _BINS]
    occupied = wide or occupied
    return occupied or [(low, high)]


def _two_valued(stats: Statistics) -> list[float]:
    """One bump for a mask, a label or a field of few values; it begins halfway between them.

    Interpolation between two samples passes every value between theirs.
    """
    background = np.flatnonzero(stats.background & (stats.count > 0))
    if len(background):
        low, high = background[[0, -1]]
        return [0.5 * (high + 1) / _BINS + 0.5, 1.0] if low < _BINS - 1 - high else [0.0, 0.5 * low / _BINS]
    return [0.5, 1.0]


def _bump(name: str, stats: Statistics, low: float, high: float, color: tuple[float, float, float]) -> Bump:
    """A trapezoid over [low, high], its plateau around the strongest boundary within."""
    first, last = round(low * _BINS), max(round(high * _BINS), round(low * _BINS) + 1)
    gradient = np.convolve(stats.gradient, np.full(3, 1.0 / 3.0), mode="same")[first:last]
    weight = gradient * np.sqrt(stats.count[first:last])  # strong, and more than a few voxels
    centre = low + (int(weight.argmax()) + 0.5) / _BINS if weight.any() else 0.5 * (low + high)
    half = 0.2 * (high - low)
    centre = min(max(centre, low + half), high - half)
    rise, fall = centre - 0.5 * half, centre + 0.5 * half
    if high >= 1.0 - 1.5 / _BINS:  # the top of the range stays visible
        fall = high = 1.0
    if low <= 1.5 / _BINS and not stats.background[:2].any():
        rise = low = 0.0
    slope = float(stats.area[first:last].sum() / max(stats.count[first:last].sum(), 1))
    thickness = 0.5 * (high - low) / slope if slope > 0.0 else 1.0
    opacity = 1.0 - math.exp(-_SURFACE_DEPTH * _REFERENCE_LENGTH / thickness)
    return Bump(name, low, rise, fall, high, color, min(max(opacity, 0.15), 0.9))
