"""Frames of views: where the visible part of a dataset is."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.ground_truth.occlusion import beside_level
from econgs_bench.datasets.scene import BasicScene, Dataset, Frame
from econgs_bench.datasets.visibility import Samples

_KEPT = 0.995  # of a scene's visible voxels: a few specks far away are no reason to make all else small
_GRID = 100  # frames are multiples of 1 / _GRID, so that small changes of a scene leave the cameras
_LEAST_RADIUS = 0.1  # nearer cameras would come close to the near plane of splatting


def visible_voxels(samples: Samples, scene: BasicScene) -> NDArray[np.bool_]:
    """(nz, ny, nx) bool: the visible voxels of a scene; of isosurfaces all voxels beside a level."""
    if scene.transfer is not None:
        return samples.look(scene.transfer).visible
    beside = np.zeros(samples.values.shape, dtype=bool)
    for surface in scene.isosurfaces:
        beside |= beside_level(samples.values, surface.value)
    return beside & samples.valid


def visible_frame(dataset: Dataset) -> Frame:
    """The frame of what all scenes of a dataset show.

    Raises:
        DataError: a volume cannot be read.
    """
    sets = []
    for variable in dict.fromkeys(scene.variable for scene in dataset.scenes):
        samples = Samples.of(dataset.volume(variable))
        scenes = [scene for scene in dataset.scenes if scene.variable == variable]
        sets += [places(samples, visible_voxels(samples, scene)) for scene in scenes]
    return frame_of(sets)


def places(samples: Samples, visible: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(n, 3) scene-space positions x, y, z of visible voxels, without the few that are farthest away."""
    grid = np.argwhere(visible)[:, ::-1]
    points = np.asarray(grid * samples.distances[::-1] + samples.first[::-1], dtype=np.float64)
    if not len(points):
        return points
    low, high = np.quantile(points, [0.5 * (1.0 - _KEPT), 0.5 * (1.0 + _KEPT)], axis=0)
    distance = np.linalg.norm(points - 0.5 * (low + high), axis=1)
    return np.asarray(points[distance <= np.quantile(distance, _KEPT)], dtype=np.float64)


def frame_of(sets: Iterable[NDArray[np.float64]]) -> Frame:
    """The frame around (n, 3) positions of several scenes; the middle of the volume if there are none."""
    points = np.concatenate([np.zeros((0, 3)), *sets])
    if not len(points):
        return Frame((0.0, 0.0, 0.0), 0.5)
    middle = np.rint(0.5 * (points.min(axis=0) + points.max(axis=0)) * _GRID) / _GRID
    radius = math.ceil(float(np.linalg.norm(points - middle, axis=1).max()) * _GRID) / _GRID
    x, y, z = (float(value) + 0.0 for value in middle)  # no negative zeros
    return Frame((x, y, z), max(radius, _LEAST_RADIUS))
