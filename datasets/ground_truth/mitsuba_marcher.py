"""Ray marcher on Mitsuba 3 / Dr.Jit: one kernel for all views, transfer functions and lights.

The kernel is traced anew for each launch but compiled once, and Dr.Jit keeps compiled kernels on disk. Its
speed comes from leaps over empty bricks, and from gradients only at visible samples.
Set the variant (:func:`.datasets.ground_truth.probe.activate`) before importing this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.ground_truth.bricks import Bricks, leaps
from econgs_bench.datasets.ground_truth.field import Field, aligned
from econgs_bench.datasets.ground_truth.kernel import SceneData, march
from econgs_bench.datasets.ground_truth.model import Layer, Marcher, MarchSettings, index_transform
from econgs_bench.datasets.ground_truth.occlusion import bake
from econgs_bench.datasets.ground_truth.sampling import Places, Tracer
from econgs_bench.datasets.volume import Volume

_TILE = 16
"""Pixels along the side of a tile: neighbouring rays share their fetches."""

_CAMERA_WIDTH = 16  # position, rotation, focal lengths, principal point


class MitsubaMarcher(Marcher):
    """Evaluation of :mod:`.datasets.ground_truth.model` in float32, ray set-up in float64.

    Args:
        volume: the field, or the fields of a composition. The marcher keeps their normalised values and
            the value ranges of their bricks.
        settings: step and table size.
        leap: leap over empty bricks; pictures without leaps are the same bit for bit.

    Raises:
        DataError: the volumes differ in grid or box.
    """

    def __init__(
        self,
        volume: Volume | Sequence[Volume],
        settings: MarchSettings = MarchSettings(),  # noqa: B008  (frozen)
        leap: bool = True,
    ) -> None:
        super().__init__(volume, settings)
        self._leap = leap
        self._bricks, self._fields = [], []
        together = sum(Field.bytes_of(each.values.shape) for each in self._volumes)
        for each in self._volumes:
            bricks = Bricks(each.values.shape, each.mask, together)
            slices = bricks.passing(each.normalise(values) for values in each.values)
            self._fields.append(Field(slices, each.values.shape, each.mask, together))
            self._bricks.append(bricks)
        first = self._volumes[0]
        self._scale, self._offset = index_transform(first)
        self._half = 0.5 * first.extent

    def tracer(self, layers: Sequence[Layer]) -> Tracer:
        """See :class:`.datasets.ground_truth.model.Marcher`."""
        return _Rays(self._scene(layers), self._half, self._scale, self._offset, self._dt)

    def _scene(self, layers: Sequence[Layer]) -> SceneData:
        """Tables, leaps and occlusion of layers."""
        numbers = self._numbers(layers)
        size = self._settings.table_size
        transfers = [layer.transfer for layer in layers]
        tables = [None if each is None else each.table(each.entries(size)) for each in transfers]
        empty = np.full(self._bricks[0].low.shape, self._leap)
        for layer, n, table in zip(layers, numbers, tables, strict=True):
            if table is None:
                empty &= self._bricks[n].uncrossed(level for level, _ in layer.levels)
            else:
                empty &= self._bricks[n].empty(table[:, 3])
        occlusion = None
        if any(layer.depth_enhancement > 0.0 for layer in layers):
            occlusion = bake(layers, [self._fields[n].values for n in numbers], size)
        fields = [self._fields[n] for n in numbers]
        per_voxel = self._scale * self._voxel
        return SceneData(layers, fields, tables, leaps(empty), self._dt, per_voxel, occlusion)


class _Rays:
    """Rays of a scene; see :class:`.datasets.ground_truth.sampling.Tracer`.

    Args:
        data: the scene.
        half: (3,) half of the box's sides.
        scale, offset: of :func:`.datasets.ground_truth.model.index_transform`.
        dt: ray step in scene space.
    """

    def __init__(
        self,
        data: SceneData,
        half: NDArray[np.float64],
        scale: NDArray[np.float64],
        offset: NDArray[np.float64],
        dt: float,
    ) -> None:
        self._data = data
        self._half, self._scale, self._offset, self._dt = half, scale, offset, dt

    def centres(self, cameras: Sequence[Camera]) -> NDArray[np.float32]:
        """One ray a pixel, tile by tile."""
        width, height = cameras[0].width, cameras[0].height
        places, pixel = _centres(len(cameras), width, height)
        return self._traced(cameras, places, pixel).reshape(-1, height, width, 4)

    def rays(self, cameras: Sequence[Camera], places: Places) -> NDArray[np.float32]:
        """Rays in the order that they are in: neighbours share their fetches."""
        return self._traced(cameras, places, np.arange(len(places.view), dtype=np.uint32))

    def _traced(
        self, cameras: Sequence[Camera], places: Places, row: NDArray[np.uint32]
    ) -> NDArray[np.float32]:
        """(R, 4) values of rays, each in its row."""
        with dr.suspend_grad():
            color, transmitted = march(self._data, *self._set_up(cameras, places))
            # The kernel scatters pixels: in NumPy this takes longer than the rays of a sparse scene.
            picture = dr.zeros(mi.Float, 4 * len(row))
            rgba = mi.Vector4f(color.x, color.y, color.z, 1.0 - transmitted)
            dr.scatter(picture, rgba, mi.UInt32(aligned(row)))
            return np.array(picture).reshape(-1, 4)

    def _set_up(self, cameras: Sequence[Camera], places: Places) -> tuple[Any, ...]:
        """Rays in grid indices.

        Returns:
            start: entry point into the box; step: one ray step; whole: number of whole steps (-1: the ray
            misses); rest: remaining part of a step; view: unit vector to the camera.
        """
        camera = mi.Float64(aligned(np.stack([_pack(c) for c in cameras])))
        number = mi.UInt32(aligned(places.view))
        entry = [dr.gather(mi.Float64, camera, number * _CAMERA_WIDTH + k) for k in range(_CAMERA_WIDTH)]
        right = (mi.Float64(mi.Float(aligned(places.x))) - entry[14]) / entry[12]
        down = (mi.Float64(mi.Float(aligned(places.y))) - entry[15]) / entry[13]
        direction = [entry[3 + 3 * a] * right + entry[4 + 3 * a] * down + entry[5 + 3 * a] for a in range(3)]
        length = dr.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        direction = [d / length for d in direction]
        near, far = mi.Float64(0.0), mi.Float64(1e30)
        for a in range(3):
            half = dr.opaque(mi.Float64, float(self._half[a]))
            inverse = 1.0 / dr.select(dr.abs(direction[a]) < 1e-12, 1e-12, direction[a])
            one, other = (-half - entry[a]) * inverse, (half - entry[a]) * inverse
            swapped = one > other
            enter, leave = dr.select(swapped, other, one), dr.select(swapped, one, other)
            near, far = dr.select(enter > near, enter, near), dr.select(leave < far, leave, far)
        dt = dr.opaque(mi.Float64, self._dt)
        steps = dr.select(far > near, (far - near) / dt, -1.0)
        whole = dr.floor(steps)
        scale = [dr.opaque(mi.Float64, float(s)) for s in self._scale]
        offset = [dr.opaque(mi.Float64, float(o)) for o in self._offset]
        start = [(entry[a] + near * direction[a]) * scale[a] + offset[a] for a in range(3)]
        step = [dt * direction[a] * scale[a] for a in range(3)]
        return (
            mi.Vector3f(*(mi.Float(s) for s in start)),
            mi.Vector3f(*(mi.Float(s) for s in step)),
            mi.Int32(whole),
            mi.Float(steps - whole),
            mi.Vector3f(*(-mi.Float(d) for d in direction)),
        )


def _pack(camera: Camera) -> NDArray[np.float64]:
    """The 16 numbers of a camera."""
    rotation = camera.camera_to_world[:3, :3].ravel()
    return np.concatenate([camera.position, rotation, [camera.fx, camera.fy, camera.cx, camera.cy]])


def _tile_order() -> NDArray[np.uint32]:
    """Pixel numbers (row x side + column) of a tile in the order of its rays: blocks of 4 x 2, of 8 x 8."""
    n = np.arange(_TILE**2, dtype=np.uint32)
    column = n & 3 | (n >> 3 & 1) << 2 | (n >> 6 & 1) << 3
    row = n >> 2 & 1 | (n >> 4 & 3) << 1 | (n >> 7 & 1) << 3
    return row * np.uint32(_TILE) + column


_ORDER = _tile_order()


@lru_cache(maxsize=2)  # a full launch, and the last one of a set
def _centres(views: int, width: int, height: int) -> tuple[Places, NDArray[np.uint32]]:
    """Places of all pixel centres, tile by tile, and the numbers of their pixels."""
    down, across = -(-height // _TILE), -(-width // _TILE)
    row = (np.arange(down)[:, None] * _TILE + _ORDER // _TILE)[:, None]
    column = np.arange(across)[:, None] * _TILE + _ORDER % _TILE
    row, column = (np.broadcast_to(one, (down, across, _TILE**2)).ravel() for one in (row, column))
    inside = (row < height) & (column < width)
    row, column = row[inside], column[inside]
    view = np.repeat(np.arange(views, dtype=np.uint32), height * width)
    pixel = np.tile((row * width + column).astype(np.uint32), views) + view * np.uint32(height * width)
    x, y = (np.tile((one + 0.5).astype(np.float32), views) for one in (column, row))
    return Places(view, x, y), pixel
