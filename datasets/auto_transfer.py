"""Automatic transfer functions for unknown data.

Bumps on many parts of the value range are candidates, each with two opacities. Visible voxels
(:mod:`.datasets.visibility`) decide among them: the choice shows as many boundaries as possible, and no two
of its scenes show the same place.
"""

from __future__ import annotations

import logging
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from os import cpu_count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.scene import BasicScene
from econgs_bench.datasets.transfer import Bump, TransferFunction
from econgs_bench.datasets.visibility import Samples, ends, overlaps
from econgs_bench.datasets.volume import Volume

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
"""Equal bins of the value range, in which values are counted and windows begin and end."""


@dataclass(frozen=True)
class Tuning:
    """Numbers that decide which windows of values become scenes; chosen by hand, on many volumes.

    Opacities and shares are 0 to 1. Shares of voxels are of those inside the volume's mask.

    Attributes:
        max_samples: samples per axis that statistics are made of: enough for a histogram, and fast.
        reference_length: length to which opacities refer, in scene space (longest side of the volume: 1).
        surface_depth: optical depth of one crossing of a surface; 1.2 is 70 % opaque.
        parts: parts of the value range, of equal isosurface area; 7 make 36 windows.
        tail: share of the area at which one more cut is made, as what is dense or bright is small.
        translucent: opacity of the second candidate of a window, in that of a surface: thick parts stay.
        min_opacity: least opacity of a translucent bump.
        visible_share: least and greatest share of voxels that a scene shows (the aim is 0.005 to 0.3).
        visible_label: least such share of a volume of labels.
        single_share: visible share times mean opacity to be nearest to, where nothing separates.
        max_overlap: share of visible voxels that two scenes may have in common; the aim is below a half.
        min_coherence: least share of a window's visible voxels that are no sharp edge and no noise.
        min_alpha: least mean opacity of the pixels that a scene covers.
        max_cover: greatest share of the rays through the box that a scene stops.
        bonus: worth of a further scene in a set, beside what it shows.
        beam: sets of scenes that a step of the search keeps.
        max_labels: most distinct values of a volume of labels.
        min_trend: share of the variance that a profile along an axis or a linear ramp explains, from which
            on the values follow a position.
        flat_residual: residuals of a trend, in the value range, below which they hold nothing.
        noise_ratio: half the mean squared difference of neighbours, in variances, above which values are
            noise; 1 is white noise.
        sheets: parts of a field that follows a position.
    """

    max_samples: int = 160
    reference_length: float = 0.01
    surface_depth: float = 1.2
    parts: int = 7
    tail: float = 0.95
    translucent: float = 0.3
    min_opacity: float = 0.04
    visible_share: tuple[float, float] = (0.008, 0.24)
    visible_label: float = 0.002
    single_share: float = 0.05
    max_overlap: float = 0.46
    min_coherence: float = 0.3
    min_alpha: float = 0.25
    max_cover: float = 0.8
    bonus: float = 0.25
    beam: int = 300
    max_labels: int = 16
    min_trend: float = 0.9
    flat_residual: float = 0.01
    noise_ratio: float = 0.75
    sheets: int = 24


TUNING = Tuning()

_log = logging.getLogger(__name__)


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
    """Basic scenes that show different places of a volume, their bumps on disjoint parts of its values.

    The range outside the homogeneous background is cut where isosurface areas are equal. Each run of parts is
    a window: a bump with its plateau at the strongest boundary within, so opaque that one crossing of that
    boundary hides most behind it, or a third of that. A window that has background in its middle (zero, of
    signed data) has two bumps, one on each side. A scene's worth is the root of the share of all gradients
    that its visible voxels hold; it is less for pale pictures, and for voxels over which values jump past
    the window (sharp edges, noise). Of the sets of scenes of which no two have more than 46 % of their
    visible voxels in common, the one that is worth most wins.

    A warning of the log tells where nothing separates: noise, or values that merely follow a position.

    Args:
        volume: the volume to show.
        count: number of scenes; the result has fewer where the values hold fewer distinct parts.

    Raises:
        DataError: count < 1.
    """
    if count < 1:
        raise DataError(f"{count} automatic scenes", "there must be at least one", "Ask for 3, say")
    stats = statistics(volume)
    samples = Samples.of(volume)
    structure = _structure(stats, samples)
    if structure.obstacle:
        _log.warning("%s: transfer functions of %s: %s", volume.source, volume.name, structure.obstacle)
    candidates = _candidates(stats, samples, structure)
    usable = [one for one in candidates if one.usable]
    if usable and not structure.empty:
        choice = _choice(usable, count)
    elif candidates:
        choice = [min(candidates, key=_distance_from_good).bumps]
    else:
        choice = [(_bump("", stats, *_two_valued(stats), COLORS[0]),)]
    scenes = []
    for i, bumps in enumerate(choice):
        name = f"tf{i + 1}"
        sides = ("",) if len(bumps) == 1 else ("_below", "_above")
        bumps = tuple(
            replace(bump, name=name + side, color=COLORS[i % len(COLORS)])
            for bump, side in zip(bumps, sides, strict=True)
        )
        scenes.append(BasicScene(name, volume.name, TransferFunction(name, bumps, TUNING.reference_length)))
    return tuple(scenes)


def statistics(volume: Volume) -> Statistics:
    """Histogram, isosurface areas and mean gradients of a volume (of a regular subset if it is large).

    Samples that the volume's mask leaves out count nothing.
    """
    strides = [-(-n // TUNING.max_samples) for n in volume.values.shape]
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


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A window of values, with what it shows.

    Attributes:
        low, high: first bin, and the one after the last.
        bumps: one, or two beside the background.
        visible: (voxels,) bool.
        share: of the voxels, visible; positive.
        alpha: mean opacity of the pixels that it covers; positive.
        worth: of its picture, positive.
        usable: whether the picture is good enough to stand among others.
    """

    low: int
    high: int
    bumps: tuple[Bump, ...]
    visible: NDArray[np.bool_]
    share: float
    alpha: float
    worth: float
    usable: bool


@dataclass(frozen=True, eq=False)
class _Structure:
    """Where a volume has something to show.

    Attributes:
        slope: gradient magnitude per unit of scene space at each sample.
        weight: the same of what a trend leaves over; 0 outside the mask.
        windows: first bin of each window of values, and the one after the last.
        labels: whether the values are few and distinct.
        obstacle: why nothing separates, for people; "" where that is not so.
        empty: whether any one window is as good as the others.
    """

    slope: NDArray[np.float32]
    weight: NDArray[np.float32]
    windows: list[tuple[int, int]]
    labels: bool = False
    obstacle: str = ""
    empty: bool = False


def _distance_from_good(one: _Candidate) -> float:
    """How far a scene is from one that shows neither too little nor too much, as a ratio's logarithm."""
    return abs(math.log(one.share * one.alpha / TUNING.single_share))


def _structure(stats: Statistics, samples: Samples) -> _Structure:
    values, valid = samples.values, samples.valid
    inside = values[valid].astype(np.float64)
    slope = samples.slope(values)
    weight = slope * valid
    levels = np.unique(inside)
    variance = float(inside.var())
    if len(levels) < 3 or variance <= 0.0:
        return _Structure(slope, weight, [])
    share = np.cumsum(stats.count) / stats.count.sum()
    if _roughness(samples) > TUNING.noise_ratio * variance:
        high = [(int(np.searchsorted(share, 0.75)), _BINS)]
        obstacle = "nothing separates (noise); the scene shows the highest values"
        return _Structure(slope, weight, high, False, obstacle, True)
    if len(levels) <= TUNING.max_labels:
        return _Structure(slope, weight, _around(stats, levels), True)
    trend, kind = _trend(samples)
    residual = values - trend
    explained = 1.0 - float(residual[valid].astype(np.float64).var()) / variance
    if explained < TUNING.min_trend:
        return _Structure(slope, weight, _windows(stats, stats.area, TUNING.parts))
    if float(np.quantile(np.abs(residual[valid]), 0.999)) < TUNING.flat_residual:
        middle = int(np.searchsorted(share, 0.5))
        bands = [(max(middle - half, 0), min(middle + half, _BINS)) for half in (4, 8, 16)]
        obstacle = f"nothing separates, values follow {kind} and nothing else; the scene shows their middle"
        return _Structure(slope, weight, bands, False, obstacle, True)
    weight = samples.slope(residual) * valid
    area = np.bincount(_bin(values[valid]), weights=weight[valid], minlength=_BINS)
    part = f"{100 * min(explained, 0.999):.1f} % of the variance"
    obstacle = f"values mostly follow {kind} ({part}); scenes are sheets, bent where values deviate"
    return _Structure(slope, weight, _windows(stats, area, TUNING.sheets, sheets=True), False, obstacle)


def _roughness(samples: Samples) -> float:
    """Half the mean squared difference of neighbors: the variance, for white noise."""
    squares = []
    for axis in range(3):
        steps = np.diff(samples.values, axis=axis)[np.logical_and(*ends(samples.valid, axis))]
        if len(steps):
            squares.append(0.5 * float(np.mean(steps.astype(np.float64) ** 2)))
    return float(np.mean(squares)) if squares else 0.0


def _trend(samples: Samples) -> tuple[NDArray[np.float32], str]:
    """The best of the mean profiles along each axis and a linear ramp, and its name."""
    values, valid = samples.values, samples.valid
    number = valid.sum()
    fits: list[tuple[NDArray[np.float32], str]] = []
    axes = []
    for axis, name in enumerate("zyx"):
        others = tuple(other for other in range(3) if other != axis)
        total = np.where(valid, values, 0.0).sum(axis=others, keepdims=True, dtype=np.float64)
        profile = total / np.maximum(valid.sum(axis=others, keepdims=True), 1)
        fits.append((np.broadcast_to(profile, values.shape).astype(np.float32), f"the position along {name}"))
        shape = [-1 if other == axis else 1 for other in range(3)]
        axes.append(np.broadcast_to(np.linspace(-1.0, 1.0, values.shape[axis]).reshape(shape), values.shape))
    places = np.stack([np.ones(values.shape), *axes], axis=-1)
    some = np.flatnonzero(valid)[:: max(1, int(number) // 50_000)]
    fit = np.linalg.lstsq(places.reshape(-1, 4)[some], values.ravel()[some].astype(np.float64), rcond=None)[0]
    fits.append(((places @ fit).astype(np.float32), "a linear ramp"))
    return min(fits, key=lambda one: float(((values - one[0])[valid].astype(np.float64) ** 2).sum()))


def _windows(
    stats: Statistics, area: NDArray[Any], parts: int, *, sheets: bool = False
) -> list[tuple[int, int]]:
    """Runs of parts of equal area outside the background; of ``sheets``, each part by itself."""
    area = np.where(stats.background, 0.0, area)
    occupied = np.flatnonzero((stats.count > 0) & ~stats.background)
    if len(occupied) < 3 or area.sum() <= 0.0:
        return []
    share = np.cumsum(area) / area.sum()
    first = max(int(np.searchsorted(share, 0.005)), int(occupied[0]))
    last = min(int(np.searchsorted(share, 0.998)), int(occupied[-1]))
    level = share[first - 1] if first else 0.0
    targets = level + (share[last] - level) * np.append(np.arange(1, parts) / parts, TUNING.tail)
    edges = sorted({first, *(int(i) + 1 for i in np.searchsorted(share, targets)), last + 1})
    if sheets:
        return list(pairwise(edges))
    return [(a, b) for i, a in enumerate(edges) for b in edges[i + 1 :] if b - a >= 3]


def _around(stats: Statistics, levels: NDArray[np.float64]) -> list[tuple[int, int]]:
    """A window around each label outside the background, a quarter of the way to the next.

    The narrower it is, the thinner is its shell around labels of higher value, as interpolation passes all
    values between.
    """
    windows = []
    gaps = np.diff(levels)
    for i, level in enumerate(levels):
        at = min(int(level * _BINS), _BINS - 1)
        if stats.background[at]:
            continue
        below = 0.25 * float(gaps[i - 1]) if i else 0.0
        above = 0.25 * float(gaps[i]) if i < len(gaps) else 0.0
        low = min(math.ceil((float(level) - below) * _BINS), at)
        high = max(int((float(level) + above) * _BINS), at + 1)
        windows.append((low, min(high, _BINS)))
    return windows


def _candidates(stats: Statistics, samples: Samples, structure: _Structure) -> list[_Candidate]:
    """Every window that shows anything, in either opacity."""
    steps = [d for d, n in zip(samples.distances, samples.values.shape, strict=True) if n > 1]
    sharp = structure.slope * np.float32(min(steps))  # change of the value over a voxel

    def candidate(choice: tuple[tuple[int, int], float]) -> _Candidate | None:
        (low, high), factor = choice
        pieces = _without_background(stats, low / _BINS, high / _BINS)
        bumps = tuple(_bump("", stats, *piece, COLORS[0]) for piece in pieces)
        bumps = tuple(replace(bump, opacity=max(TUNING.min_opacity, bump.opacity * factor)) for bump in bumps)
        look = samples.look(TransferFunction("", bumps, TUNING.reference_length))
        visible, alpha = look.visible, look.alpha
        within = visible & (samples.values >= low / _BINS) & (samples.values <= high / _BINS)
        coherence = 1.0
        if structure.labels:  # interpolation draws thin shells of all labels between two
            visible = within
        else:
            coherence = float((sharp[within] <= (high - low) / _BINS).mean()) if within.any() else 0.0
        share = float(visible.sum() / samples.valid.sum())
        if share <= 0.0:
            return None
        held = float(structure.weight[visible].sum(dtype=np.float64) / total)
        worth = math.sqrt(held * coherence * alpha) * (1.0 if factor == 1.0 else 0.95) + TUNING.bonus
        usable = (
            least <= share <= TUNING.visible_share[1]
            and alpha >= TUNING.min_alpha
            and look.cover <= TUNING.max_cover
            and coherence >= TUNING.min_coherence
        )
        return _Candidate(low, high, bumps, visible.ravel(), share, alpha, worth, usable)

    least = TUNING.visible_label if structure.labels else TUNING.visible_share[0]
    total = max(float(structure.weight.sum(dtype=np.float64)), 1e-30)
    choices = [(window, factor) for window in structure.windows for factor in (1.0, TUNING.translucent)]
    with ThreadPoolExecutor(min(cpu_count() or 1, 4)) as pool:
        return [one for one in pool.map(candidate, choices) if one is not None]


def _choice(candidates: list[_Candidate], count: int) -> list[tuple[Bump, ...]]:
    """The bumps of the set of at most ``count`` candidates that is worth most, by ascending value."""
    if count == 1:
        return [max(candidates, key=lambda one: one.worth).bumps]
    low = np.array([one.low for one in candidates])
    high = np.array([one.high for one in candidates])
    worth = np.array([one.worth for one in candidates])
    apart = (low[:, None] >= high[None]) | (high[:, None] <= low[None])
    fits = apart & (overlaps([one.visible for one in candidates]) <= TUNING.max_overlap)
    sets: dict[tuple[int, ...], float] = {(i,): float(value) for i, value in enumerate(worth)}
    best = max(sets, key=lambda one: sets[one])
    for _ in range(count - 1):
        kept = sorted(sets, key=lambda one: (-sets[one], one))[: TUNING.beam]
        larger: dict[tuple[int, ...], float] = {}
        for one in kept:
            for other in np.flatnonzero(fits[list(one)].all(axis=0)):
                larger[tuple(sorted((*one, int(other))))] = sets[one] + float(worth[other])
        if not larger:
            break
        sets = larger
        best = max(sorted(sets), key=lambda one: sets[one])
    return [candidates[i].bumps for i in sorted(best, key=lambda i: candidates[i].low)]


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


def _two_valued(stats: Statistics) -> tuple[float, float]:
    """One bump for a mask, a label or a field of few values; it begins halfway between them.

    Interpolation between two samples passes every value between theirs.
    """
    background = np.flatnonzero(stats.background & (stats.count > 0))
    if len(background):
        low, high = background[[0, -1]]
        return (0.5 * (high + 1) / _BINS + 0.5, 1.0) if low < _BINS - 1 - high else (0.0, 0.5 * low / _BINS)
    return 0.5, 1.0


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
    opacity = 1.0 - math.exp(-TUNING.surface_depth * TUNING.reference_length / thickness)
    return Bump(name, low, rise, fall, high, color, min(max(opacity, 0.15), 0.9))
