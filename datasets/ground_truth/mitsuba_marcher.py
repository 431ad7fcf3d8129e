"""Ray marcher on Mitsuba 3 / Dr.Jit: one kernel for all views, transfer functions and lights of a volume.

The kernel is traced anew for each launch but compiled once: everything that differs between scenes and
cameras enters as data (or as an opaque scalar), and Dr.Jit keeps compiled kernels on disk. What keeps it fast
is leaping over empty bricks and fetching neighbours for the gradient only where something is visible.
Set the variant (:func:`datasets.ground_truth.probe.activate`) before making a marcher.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from datasets.camera import Camera
from datasets.ground_truth.bricks import BRICK, Bricks
from datasets.ground_truth.model import GRADIENT_FLOOR, PHONG_FLOOR, MarchSettings, Progress, index_transform
from datasets.scene import Light
from datasets.transfer import TransferFunction
from datasets.volume import Volume

_RAYS_PER_LAUNCH = 2**20
_UNSEEN = 1e-6  # transmittance at which a ray may stop: below what 16-bit images resolve
_CAMERA_WIDTH = 16  # position, rotation, focal lengths, principal point


# min and max are written as select throughout: LLVM 15 and 16 cannot compile Dr.Jit's own.


class MitsubaMarcher:
    """Evaluates :mod:`datasets.ground_truth.model` in float32, ray set-up in float64.

    Args:
        volume: the field; its normalised values and the value ranges of its bricks are held.
        settings: step and table size.
        leap: leap over empty bricks; the pictures are the same bit for bit without.
    """

    def __init__(
        self,
        volume: Volume,
        settings: MarchSettings = MarchSettings(),  # noqa: B008  (frozen)
        leap: bool = True,
    ) -> None:
        values = volume.normalised()
        self._settings = settings
        self._leap = leap
        self._bricks = Bricks(values)
        self._field = _Field(values)
        self._scale, self._offset = index_transform(volume)
        self._half = 0.5 * volume.extent
        self._voxel = volume.voxel
        self._dt = settings.step_voxels * volume.voxel

    def render(
        self,
        cameras: tuple[Camera, ...],
        transfer: TransferFunction,
        light: Light | None,
        progress: Progress | None = None,
    ) -> NDArray[np.float32]:
        """See :class:`datasets.ground_truth.model.Marcher`; several small views share a launch."""
        width, height = cameras[0].width, cameras[0].height
        table = transfer.table(self._settings.table_size)
        leaps = self._bricks.leaps(table[:, 3])
        if not self._leap:
            leaps[:] = 0
        data = _SceneData(table, leaps, light, self._dt, self._scale * self._voxel)
        images = np.empty((len(cameras), height, width, 4), dtype=np.float32)
        batch = max(1, _RAYS_PER_LAUNCH // (width * height))
        for start in range(0, len(cameras), batch):
            part = cameras[start : start + batch]
            with dr.suspend_grad():
                channels = self._launch(part, data)
                dr.eval(channels)  # together: apart, the loop would run once for each channel
            for i, channel in enumerate(channels):
                images[start : start + batch, ..., i] = np.array(channel).reshape(-1, height, width)
            if progress:
                progress(start + len(part), len(cameras))
        return images

    def _launch(self, cameras: Sequence[Camera], data: _SceneData) -> tuple[Any, ...]:
        """Trace the kernel for some views; returns red, green, blue, alpha of all rays, unevaluated."""
        start, step, whole, rest, view = self._rays(cameras)
        color, transmitted = _march(data, self._field, start, step, whole, rest, view)
        return color.x, color.y, color.z, 1.0 - transmitted

    def _rays(self, cameras: Sequence[Camera]) -> tuple[Any, ...]:
        """Rays of all pixels in grid indices.

        Returns:
            start: where the ray enters the box; step: one ray step; whole: number of whole steps (-1: the
            ray misses); rest: part of a step that remains; view: unit vector to the camera (scene space).
        """
        width, height = cameras[0].width, cameras[0].height
        packed = np.stack([_pack(c) for c in cameras])
        opaque_width, opaque_height = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)
        index = dr.arange(mi.UInt32, len(cameras) * width * height)
        row = index // opaque_width
        column = index - row * opaque_width
        number = row // opaque_height
        row -= number * opaque_height
        camera = mi.Float64(_aligned(packed))
        entry = [dr.gather(mi.Float64, camera, number * _CAMERA_WIDTH + k) for k in range(_CAMERA_WIDTH)]

        x = (mi.Float64(column) + 0.5 - entry[14]) / entry[12]
        y = (mi.Float64(row) + 0.5 - entry[15]) / entry[13]
        direction = [entry[3 + 3 * a] * x + entry[4 + 3 * a] * y + entry[5 + 3 * a] for a in range(3)]
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


@dr.syntax
def _march(data: Any, field: Any, start: Any, step: Any, whole: Any, rest: Any, view: Any) -> Any:
    """The loop along the rays; returns premultiplied color and transmittance."""
    i = mi.Int32(0)
    color = mi.Color3f(0.0)
    transmitted = mi.Float(1.0)
    while (i <= whole) & (transmitted > _UNSEEN):
        part = dr.select(i < whole, 1.0, rest)
        at = dr.fma(step, mi.Float(i) + 0.5 * part, start)
        distance, leap = data.leap(at, step)
        if distance > 0:
            i += leap
        else:
            cell = field.cell(at)
            classified = data.classify(cell.value())
            alpha = 1.0 - dr.exp(-classified.w * data.dt * part)
            if alpha > 0.0:
                sample = mi.Color3f(classified.x, classified.y, classified.z)
                if dr.hint(data.light is not None, mode="scalar"):
                    sample = data.shade(sample, cell.gradient(), view)
                color += (transmitted * alpha) * _clamp(sample)
                transmitted *= 1.0 - alpha
            i += 1
    return color, transmitted


class _SceneData:
    """What the kernel reads of a transfer function and a light."""

    def __init__(
        self,
        table: NDArray[np.float32],
        leaps: NDArray[np.int32],
        light: Light | None,
        dt: float,
        indices_per_voxel: NDArray[np.float64],
    ) -> None:
        self.light = light
        self.dt = dr.opaque(mi.Float, dt)
        self._leaps = mi.Int32(_aligned(leaps))
        self._bricks = [dr.opaque(mi.Int32, n) for n in reversed(leaps.shape)]
        self._per_voxel = mi.Vector3f(*(dr.opaque(mi.Float, float(s)) for s in indices_per_voxel))
        self._table = mi.Float(_aligned(table))
        self._last = dr.opaque(mi.Float, float(len(table) - 1))
        if light is not None:
            self._headlight = dr.opaque(mi.Bool, light.direction is None)
            self._fixed = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in light.direction or (0, 0, 1)))
            self._ambient, self._diffuse, self._specular, self._shininess = (
                dr.opaque(mi.Float, float(x))
                for x in (light.ambient, light.diffuse, light.specular, light.shininess)
            )

    def classify(self, value: Any) -> Any:
        """Color and extinction, linear between the entries of the table."""
        at = value * self._last
        cell = dr.floor(at)
        cell = dr.select(cell < self._last, cell, self._last - 1.0)
        low = dr.gather(mi.Vector4f, self._table, mi.UInt32(cell))
        high = dr.gather(mi.Vector4f, self._table, mi.UInt32(cell) + 1)
        return dr.fma(high - low, at - cell, low)

    def shade(self, color: Any, gradient: Any, view: Any) -> Any:
        """Two-sided Blinn-Phong or Phong, blended with the color of no gradient where it vanishes."""
        gradient = gradient * self._per_voxel
        square = dr.dot(gradient, gradient)
        normal = gradient * dr.select(square > 0.0, dr.rsqrt(square), 0.0)
        towards = dr.select(self._headlight, view, self._fixed)
        if self.light.model == "phong":
            cosine = dr.dot(normal, towards)
            facing = 2.0 * cosine * dr.dot(normal, view) - dr.dot(towards, view)
            floor, flat = PHONG_FLOOR, color * self._ambient
        else:
            half = view + towards
            half *= dr.select(dr.dot(half, half) > 1e-12, dr.rsqrt(dr.dot(half, half)), 0.0)
            facing = dr.abs(dr.dot(normal, half))
            floor, flat = GRADIENT_FLOOR, color * (self._ambient + self._diffuse)
        highlight = dr.select(facing > 0.0, dr.exp2(self._shininess * dr.log2(facing)), 0.0)
        lit = color * (self._ambient + self._diffuse * dr.abs(dr.dot(normal, towards)))
        trust = square / (square + floor**2)
        return trust * (lit + self._specular * highlight) + (1.0 - trust) * flat

    def leap(self, at: Any, step: Any) -> tuple[Any, Any]:
        """Distance in bricks to the nearest visible one, and the steps to just beyond what is known empty."""
        brick = [
            dr.select(b < n, dr.select(b > 0, b, 0), n - 1)
            for b, n in zip([mi.Int32(dr.floor(x * (1.0 / BRICK))) for x in at], self._bricks, strict=True)
        ]
        number = (brick[2] * self._bricks[1] + brick[1]) * self._bricks[0] + brick[0]
        distance = dr.gather(mi.Int32, self._leaps, number)
        steps = mi.Float(1e6)
        for x, d, b in zip(at, step, brick, strict=True):
            face = dr.select(d > 0.0, b + distance, b - distance + 1)
            along = dr.select(d == 0.0, 1e6, (mi.Float(face * BRICK) - x) / d)
            steps = dr.select(along < steps, along, steps)
        return distance, 1 + mi.Int32(dr.select(steps > 0.0, steps, 0.0))


class _Field:
    """The grid of values."""

    def __init__(self, values: NDArray[np.float32]) -> None:
        self.values = mi.Float(_aligned(values))
        self.dims = [dr.opaque(mi.Int32, n) for n in reversed(values.shape)]
        self.stride = [
            dr.opaque(mi.Int32, 1),
            self.dims[0],
            dr.opaque(mi.Int32, values.shape[2] * values.shape[1]),
        ]

    def cell(self, at: Any) -> _Cell:
        """The cell around a position in grid indices."""
        lower, weight = [], []
        for x, n in zip(at, self.dims, strict=True):
            low = mi.Int32(dr.floor(x))
            low = dr.select(low > n - 2, n - 2, low)
            low = dr.select(low < 0, 0, low)
            w = x - mi.Float(low)
            lower.append(low)
            weight.append(dr.select(w > 1.0, 1.0, dr.select(w > 0.0, w, 0.0)))
        return _Cell(self, lower, weight)


class _Cell:
    """Eight neighbouring samples and a position between them."""

    def __init__(self, field: _Field, lower: list[Any], weight: list[Any]) -> None:
        self._field, self._lower, self._weight = field, lower, weight
        x, y, z = field.stride
        self._base = lower[2] * z + lower[1] * y + lower[0]
        # Corner numbers count x fastest: bit a of the number is the side along axis a.
        self._corners = [self._fetch(o + side) for o in (mi.Int32(0), y, z, y + z) for side in (0, x)]

    def _fetch(self, offset: Any) -> Any:
        return dr.gather(mi.Float, self._field.values, self._base + offset)

    def value(self) -> Any:
        """Trilinear interpolation."""
        near, far = (_bilinear(self._corners[i : i + 4], *self._weight[:2]) for i in (0, 4))
        return _lerp(near, far, self._weight[2])

    def gradient(self) -> Any:
        """Half of f(x + 1) - f(x - 1) along each axis, in values per grid index.

        As interpolation is linear, both terms need only the corners of this cell and of its neighbours:
        24 fetches more instead of 48.
        """
        result = []
        for axis in range(3):
            stride, first, second = self._field.stride[axis], *(a for a in range(3) if a != axis)
            u, v = self._field.stride[first], self._field.stride[second]
            below = dr.select(self._lower[axis] > 0, -stride, 0)
            above = dr.select(self._lower[axis] < self._field.dims[axis] - 2, 2 * stride, stride)
            at_low, at_high = [], []
            for offset, corner in (
                (mi.Int32(0), 0),
                (u, 1 << first),
                (v, 1 << second),
                (u + v, (1 << first) + (1 << second)),
            ):
                at_low.append(self._corners[corner + (1 << axis)] - self._fetch(offset + below))
                at_high.append(self._fetch(offset + above) - self._corners[corner])
            weights = self._weight[first], self._weight[second]
            low, high = _bilinear(at_low, *weights), _bilinear(at_high, *weights)
            result.append(0.5 * _lerp(low, high, self._weight[axis]))
        return mi.Vector3f(*result)


def _lerp(a: Any, b: Any, w: Any) -> Any:
    return dr.fma(b - a, w, a)


def _bilinear(values: Sequence[Any], first: Any, second: Any) -> Any:
    """Of four values, ``first`` being the weight along the faster axis."""
    return _lerp(_lerp(values[0], values[1], first), _lerp(values[2], values[3], first), second)


def _clamp(color: Any) -> Any:
    """Clamp to [0, 1]."""
    return dr.select(color > 1.0, 1.0, dr.select(color > 0.0, color, 0.0))


def _aligned(array: NDArray[Any]) -> NDArray[Any]:
    """A flat copy that starts at a multiple of 64 bytes.

    Dr.Jit maps numpy's memory where it lies, and compiles other code for memory that lies unaligned: without
    this, chance would decide whether a launch finds its kernel compiled.
    """
    room = np.empty(array.nbytes + 64, dtype=np.uint8)
    start = -room.ctypes.data % 64
    flat = room[start : start + array.nbytes].view(array.dtype)
    flat[:] = array.ravel()
    return flat


def _pack(camera: Camera) -> NDArray[np.float64]:
    """The 16 numbers of a camera."""
    rotation = camera.camera_to_world[:3, :3].ravel()
    return np.concatenate([camera.position, rotation, [camera.fx, camera.fy, camera.cx, camera.cy]])
