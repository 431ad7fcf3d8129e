"""Visible voxels of a scene: those that contribute to some view, not hidden inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.volume import Volume

LEAST_WEIGHT = 0.02
"""Least share of a pixel that a voxel must have in some view to be visible: five of 255 levels."""

MOST_SAMPLES = 96
"""Default limit of the samples along an axis."""

_STEPS = 4096  # of normalised values: finer than any plateau, and its cumulative table stays in the cache


@dataclass(frozen=True, eq=False)
class Look:
    """What a transfer function shows.

    Attributes:
        visible: (nz, ny, nx) bool, voxels that some view shows.
        alpha: mean alpha of the rays that meet something, of at least :data:`LEAST_WEIGHT`; 0 for none.
        cover: share of all rays through the box with an alpha of at least 1/2.
    """

    visible: NDArray[np.bool_]
    alpha: float
    cover: float


@dataclass(frozen=True, eq=False)
class Samples:
    """A volume (a regular subset of it, if it is large), prepared for many transfer functions.

    Attributes:
        values: (nz, ny, nx) float32 normalised values.
        valid: (nz, ny, nx) bool, False where the volume's mask leaves a sample out.
        distances: scene-space distance between samples along z, y, x.
        first: scene-space position z, y, x of the first sample.
    """

    values: NDArray[np.float32]
    valid: NDArray[np.bool_]
    distances: tuple[float, float, float]
    first: tuple[float, float, float]
    _segments: tuple[tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]], ...]

    @classmethod
    def of(cls, volume: Volume, most: int = MOST_SAMPLES) -> Samples:
        """Samples of a volume, at most ``most`` along an axis."""
        strides = [-(-n // most) for n in volume.values.shape]
        starts = [(n - 1) % s // 2 for n, s in zip(volume.values.shape, strides, strict=True)]
        subset = tuple(slice(start, None, s) for start, s in zip(starts, strides, strict=True))
        coarse = Volume(volume.name, volume.values[subset], volume.spacing, volume.value_range, volume.source)
        values = coarse.normalised()
        valid = np.ones(values.shape, dtype=bool) if volume.mask is None else volume.mask[subset]
        if not valid.any():  # a mesh thinner than the strides
            valid = np.ones(values.shape, dtype=bool)
        voxel = volume.extent[::-1] / np.maximum(np.array(volume.values.shape) - 1, 1)
        sides, first = voxel * strides, voxel * starts - 0.5 * volume.extent[::-1]
        steps = np.minimum(values * _STEPS, _STEPS - 1).astype(np.intp)
        segments = []
        for axis in range(3):
            near, far = ends(steps, axis)
            low, high = np.minimum(near, far), np.maximum(near, far) + 1
            length = np.logical_and(*ends(valid, axis)) * np.float32(sides[axis])
            segments.append((low, high, length / (high - low).astype(np.float32)))
        dz, dy, dx = map(float, sides)
        z, y, x = map(float, first)
        return cls(values, valid, (dz, dy, dx), (z, y, x), tuple(segments))

    def slope(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(nz, ny, nx) gradient magnitude of values at the samples, per unit of scene space."""
        squared = np.zeros_like(values)
        for axis in range(3):
            if values.shape[axis] > 1:
                squared += np.gradient(values, self.distances[axis], axis=axis) ** 2
        return np.sqrt(squared)

    def look(self, transfer: TransferFunction) -> Look:
        """What views along the six directions of the axes show.

        Rays run along the rows of voxels. Values between two voxels are linear, and the extinction between
        them is integrated exactly. A voxel is visible where the segment before or behind it contributes at
        least :data:`LEAST_WEIGHT` of the pixel: its own opacity times the transparency of all before it.
        """
        extinction = transfer.classify((np.arange(_STEPS) + 0.5) / _STEPS)[:, 3]
        total = np.concatenate([[0.0], np.cumsum(extinction)]).astype(np.float64)
        shown = np.zeros(self.values.shape, dtype=bool)
        alphas = []
        for axis, (low, high, per_step) in enumerate(self._segments):
            depth = (total[high] - total[low]).astype(np.float32)
            depth *= per_step
            before = np.cumsum(depth, axis=axis)
            opacity = 1.0 - np.exp(-depth)
            alpha = 1.0 - np.exp(-before[_last(axis)])
            alphas.append(alpha.ravel())
            nearest = np.minimum(before - depth, before[_last(axis)] - before)
            seen = opacity * np.exp(-nearest) >= LEAST_WEIGHT
            first, last = ends(shown, axis)
            first |= seen
            last |= seen
        every = np.concatenate(alphas)
        hits = every[every >= LEAST_WEIGHT]
        cover = float((every >= 0.5).mean()) if len(every) else 0.0
        return Look(shown, float(hits.mean()) if len(hits) else 0.0, cover)


def overlaps(sets: Sequence[NDArray[np.bool_]]) -> NDArray[np.float64]:
    """(n, n) overlap of each two of n scenes: voxels that both show over those of the one that shows less.

    0 where a scene shows nothing.
    """
    flat = np.stack([one.ravel() for one in sets]).astype(np.float32)
    both = (flat @ flat.T).astype(np.float64)
    least = np.minimum.outer(np.diag(both), np.diag(both))
    return np.asarray(np.where(least > 0.0, both / np.maximum(least, 1.0), 0.0))


def _last(axis: int) -> tuple[slice, ...]:
    """The last segment of each row along an axis."""
    return tuple(slice(-1, None) if x == axis else slice(None) for x in range(3))


def ends(array: NDArray, axis: int) -> tuple[NDArray, NDArray]:  # type: ignore[type-arg]
    """Views of the voxels at the near and at the far end of each segment along an axis."""
    near = tuple(slice(None, -1) if x == axis else slice(None) for x in range(3))
    far = tuple(slice(1, None) if x == axis else slice(None) for x in range(3))
    return array[near], array[far]
