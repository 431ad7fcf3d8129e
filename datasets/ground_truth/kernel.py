"""The loops along the rays, traced by Dr.Jit: :mod:`.datasets.ground_truth.model` in float32.

All differences between scenes and cameras enter as data (or as opaque scalars), so that each number and kind
of layers needs one compilation. Branches on the parts of a scene (a light, a mask) happen while tracing and
cost nothing in a scene without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.ground_truth.bricks import BRICK
from econgs_bench.datasets.ground_truth.field import Field, aligned
from econgs_bench.datasets.ground_truth.model import BISECTIONS, Layer
from econgs_bench.datasets.ground_truth.occlusion import Occlusion
from econgs_bench.datasets.scene import Light

_MARGIN = 2e-3  # voxels that leaps end early: more than the rounding of positions
_UNSEEN = 1e-6  # transmittance at which a ray may stop: below what 16-bit images resolve


def march(scene: SceneData, start: Any, step: Any, whole: Any, rest: Any, view: Any) -> tuple[Any, Any]:
    """Premultiplied color and transmittance of rays.

    Args:
        scene: volumes, tables and lights along the rays.
        start: entry point of each ray into the box, in grid indices.
        step: one ray step, in grid indices.
        whole: number of whole steps (-1: the ray misses).
        rest: remaining part of a step.
        view: unit vector to the camera (scene space).
    """
    loop = _march_with_surfaces if scene.surfaces else _march
    color, transmitted = loop(scene, start, step, whole, rest, view)
    return color, transmitted


@dr.syntax
def _march(scene: Any, start: Any, step: Any, whole: Any, rest: Any, view: Any) -> Any:
    i = mi.Int32(0)
    inverse = _inverse(step)
    color = mi.Color3f(0.0)
    transmitted = mi.Float(1.0)
    while (i <= whole) & (transmitted > _UNSEEN):
        part = dr.select(i < whole, 1.0, rest)
        at = dr.fma(step, mi.Float(i) + 0.5 * part, start)
        distance, leap = scene.leap(at, step, inverse)
        if distance > 0:
            i += leap
        else:
            extinction, sample = scene.sample(at, view)
            alpha = 1.0 - dr.exp(-extinction * scene.dt * part)
            color += (transmitted * alpha) * sample
            transmitted *= 1.0 - alpha
            i += 1
    return color, transmitted


@dr.syntax
def _march_with_surfaces(scene: Any, start: Any, step: Any, whole: Any, rest: Any, view: Any) -> Any:
    i = mi.Int32(0)
    inverse = _inverse(step)
    color = mi.Color3f(0.0)
    transmitted = mi.Float(1.0)
    while (i <= whole) & (transmitted > _UNSEEN):
        part = dr.select(i < whole, 1.0, rest)
        first = dr.fma(step, mi.Float(i), start)
        distance, leap = scene.leap(first, step, inverse)
        leap -= 1  # steps that end in empty space: one that leaves it may cross a surface
        if (distance > 0) & (leap > 0):
            i += leap
        else:
            last = dr.fma(step, mi.Float(i) + part, start)
            depth, sample = mi.Float(0.0), mi.Color3f(0.0)
            if dr.hint(scene.has_volumes, mode="scalar"):
                extinction, sample = scene.sample(dr.fma(step, mi.Float(i) + 0.5 * part, start), view)
                depth = extinction * scene.dt * part
            color, transmitted, done = scene.cross(first, last, view, depth, sample, color, transmitted)
            alpha = 1.0 - dr.exp(-depth * (1.0 - done))
            color += (transmitted * alpha) * sample
            transmitted *= 1.0 - alpha
            i += 1
    return color, transmitted


@dr.syntax
def _sample_one(scene: Any, layer: Any, at: Any, view: Any) -> Any:
    """Extinction and color of a single layer."""
    cell = layer.field.cell(at)
    value = cell.value()
    extinction, sample = mi.Float(0.0), mi.Color3f(0.0)
    if layer.may_show(value):
        classified = layer.classify(value)
        extinction = classified.w
        sample = mi.Color3f(classified.x, classified.y, classified.z)
        if dr.hint(layer.field.mask is not None, mode="scalar"):
            extinction *= cell.mask()
        if dr.hint(layer.light is not None, mode="scalar"):
            sample = layer.shade(sample, cell.gradient(), view)
        sample = scene.enhance(layer, _clamp(sample), at)
    return extinction, sample


@dr.syntax
def _add_field(scene: Any, layers: Any, at: Any, view: Any, total: Any, mixed: Any) -> Any:
    """Add the layers of one field to the sum of extinctions and of extinction times color."""
    cell = layers[0].field.cell(at)
    value = cell.value()
    if _any([layer.may_show(value) for layer in layers]):
        share, gradient = mi.Float(1.0), mi.Vector3f(0.0)
        if dr.hint(layers[0].field.mask is not None, mode="scalar"):
            share = cell.mask()
        if dr.hint(_lit(layers), mode="scalar"):
            gradient = cell.gradient()
        total, mixed = _add_layers(scene, layers, value, gradient, share, at, view, total, mixed)
    return total, mixed


def _add_layers(scene: SceneData, layers: Sequence[VolumeLayer], *state: Any) -> tuple[Any, Any]:
    value, gradient, share, at, view, total, mixed = state
    for layer in layers:
        total, mixed = _add_layer(scene, layer, value, gradient, share, at, view, total, mixed)
    return total, mixed


@dr.syntax
def _add_layer(
    scene: Any, layer: Any, value: Any, gradient: Any, share: Any, at: Any, view: Any, total: Any, mixed: Any
) -> Any:
    if layer.may_show(value):
        classified = layer.classify(value)
        weight = classified.w * share
        sample = mi.Color3f(classified.x, classified.y, classified.z)
        if dr.hint(layer.light is not None, mode="scalar"):
            sample = layer.shade(sample, gradient, view)
        total += weight
        mixed += weight * scene.enhance(layer, _clamp(sample), at)
    return total, mixed


@dr.syntax
def _cross(
    scene: Any, layer: Any, first: Any, last: Any, view: Any, depth: Any, sample: Any, color: Any,
    transmitted: Any, done: Any,
) -> Any:  # fmt: skip
    """Composite the crossings of one layer within a segment, and the volumes before them.

    The volumes have optical depth ``depth`` and color ``sample`` in the whole segment; the share ``done`` of
    it is in the composite already.
    """
    before, after = layer.field.cell(first).value(), layer.field.cell(last).value()
    k = mi.Int32(0)
    while k < layer.count:
        number = dr.select(after > before, k, layer.count - 1 - k)
        level = dr.gather(mi.Float, layer.levels, number)
        if (before >= level) ^ (after >= level):
            low, high, at_low, at_high = mi.Float(0.0), mi.Float(1.0), mi.Float(before), mi.Float(after)
            n = mi.Int32(0)
            while n < BISECTIONS:
                middle = 0.5 * (low + high)
                value = layer.field.cell(dr.fma(last - first, middle, first)).value()
                beyond = (value >= level) ^ (before >= level)
                high, at_high = dr.select(beyond, middle, high), dr.select(beyond, value, at_high)
                low, at_low = dr.select(beyond, low, middle), dr.select(beyond, at_low, value)
                n += 1
            along = low + (high - low) * ((level - at_low) / (at_high - at_low))
            at = dr.fma(last - first, along, first)
            cell = layer.field.cell(at)
            surface = dr.gather(mi.Vector4f, layer.table, number)
            opacity = surface.w
            if dr.hint(layer.field.mask is not None, mode="scalar"):
                opacity = dr.select(cell.mask() < 0.5, 0.0, opacity)
            shaded = mi.Color3f(surface.x, surface.y, surface.z)
            if dr.hint(layer.light is not None, mode="scalar"):
                shaded = layer.shade(shaded, cell.gradient(), view)
            shaded = scene.enhance(layer, _clamp(shaded), at)
            share = dr.select(along > done, along - done, 0.0)
            alpha = 1.0 - dr.exp(-depth * share)
            color += (transmitted * alpha) * sample
            transmitted *= 1.0 - alpha
            color += (transmitted * opacity) * shaded
            transmitted *= 1.0 - opacity
            done += share
        k += 1
    return color, transmitted, done


class SceneData:
    """A scene as the kernel reads it.

    Args:
        layers: one layer, or the layers of a composition.
        fields: field of each layer.
        tables: transfer function table of each layer; None for isosurfaces.
        leaps: distances in bricks.
        dt: ray step in scene space.
        indices_per_voxel: grid indices in one smallest voxel side, x y z.
        occlusion: None without depth enhancement.
    """

    def __init__(
        self,
        layers: Sequence[Layer],
        fields: Sequence[Field],
        tables: Sequence[NDArray[np.float32] | None],
        leaps: NDArray[np.int32],
        dt: float,
        indices_per_voxel: NDArray[np.float64],
        occlusion: Occlusion | None,
    ) -> None:
        self.dt = dr.opaque(mi.Float, dt)
        self._leaps = mi.Int32(aligned(leaps))
        self._bricks = [dr.opaque(mi.Int32, n) for n in reversed(leaps.shape)]
        per_voxel = mi.Vector3f(*(dr.opaque(mi.Float, float(s)) for s in indices_per_voxel))
        volumes: dict[int, list[VolumeLayer]] = {}
        self.surfaces = []
        for layer, field, table in zip(layers, fields, tables, strict=True):
            if table is None:
                self.surfaces.append(SurfaceLayer(layer, field, per_voxel))
            else:
                volumes.setdefault(id(field), []).append(VolumeLayer(layer, field, per_voxel, table))
        self._volumes = list(volumes.values())
        self._occlusion = None
        if occlusion is not None:
            self._occlusion = Field(occlusion.values, occlusion.values.shape)
            self._scale = dr.opaque(mi.Float, occlusion.scale)
            self._offset = dr.opaque(mi.Float, occlusion.offset)

    @property
    def has_volumes(self) -> bool:
        return bool(self._volumes)

    def sample(self, at: Any, view: Any) -> tuple[Any, Any]:
        """Extinction and color at a position in grid indices."""
        if len(self._volumes) == len(self._volumes[0]) == 1:
            extinction, sample = _sample_one(self, self._volumes[0][0], at, view)
            return extinction, sample
        total: Any = mi.Float(0.0)
        mixed: Any = mi.Color3f(0.0)
        for layers in self._volumes:
            total, mixed = _add_field(self, layers, at, view, total, mixed)
        return total, mixed * dr.select(total > 0.0, 1.0 / total, 0.0)

    def cross(self, first: Any, last: Any, *state: Any) -> tuple[Any, Any, Any]:
        """Composite the isosurfaces between two positions; see :func:`_cross`."""
        view, depth, sample, color, transmitted = state
        done = mi.Float(0.0)
        for layer in self.surfaces:
            color, transmitted, done = _cross(
                self, layer, first, last, view, depth, sample, color, transmitted, done
            )
        return color, transmitted, done

    def enhance(self, layer: _Lit, color: Any, at: Any) -> Any:
        """Darken a color by the occlusion at a position and the layer's strength."""
        if self._occlusion is None:
            return color
        there = mi.Vector3f(*(dr.fma(x, self._scale, self._offset) for x in at))
        return color * (1.0 - layer.strength * self._occlusion.cell(there).value())

    def leap(self, at: Any, step: Any, inverse: Any) -> tuple[Any, Any]:
        """Distance in bricks to the nearest visible one, and the steps to the end of the empty space."""
        brick = [
            dr.select(b < n, dr.select(b > 0, b, 0), n - 1)
            for b, n in zip([mi.Int32(dr.floor(x * (1.0 / BRICK))) for x in at], self._bricks, strict=True)
        ]
        number = (brick[2] * self._bricks[1] + brick[1]) * self._bricks[0] + brick[0]
        distance = dr.gather(mi.Int32, self._leaps, number)
        steps = mi.Float(1e6)
        for x, d, i, b in zip(at, step, inverse, brick, strict=True):
            forward = d > 0.0
            face = mi.Float(dr.select(forward, b + distance, b - distance + 1) * BRICK)
            along = (face + dr.select(forward, -_MARGIN, _MARGIN) - x) * i
            steps = dr.select(along < steps, along, steps)
        return distance, 1 + mi.Int32(dr.select(steps > 0.0, steps, 0.0))


class _Lit:
    """A layer's field, light and strength of depth enhancement."""

    def __init__(self, layer: Layer, field: Field, per_voxel: Any) -> None:
        self.field, self.light = field, layer.light
        self.strength = dr.opaque(mi.Float, layer.depth_enhancement)
        self._per_voxel = per_voxel
        self._floor = dr.opaque(mi.Float, layer.floor**2)
        if layer.light is not None:
            self._set_light(layer.light)

    def _set_light(self, light: Light) -> None:
        self._headlight = dr.opaque(mi.Bool, light.direction is None)
        self._fixed = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in light.direction or (0, 0, 1)))
        self._phong = light.model == "phong"
        self._ambient, self._diffuse, self._specular, self._shininess = (
            dr.opaque(mi.Float, float(x))
            for x in (light.ambient, light.diffuse, light.specular, light.shininess)
        )

    def shade(self, color: Any, gradient: Any, view: Any) -> Any:
        """Two-sided Blinn-Phong or Phong; it fades to the unshaded color as the gradient vanishes."""
        gradient = gradient * self._per_voxel
        square = dr.dot(gradient, gradient)
        normal = gradient * dr.select(square > 0.0, dr.rsqrt(square), 0.0)
        towards = dr.select(self._headlight, view, self._fixed)
        if self._phong:
            cosine = dr.dot(normal, towards)
            facing = 2.0 * cosine * dr.dot(normal, view) - dr.dot(towards, view)
            flat = color * self._ambient
        else:
            half = view + towards
            half *= dr.select(dr.dot(half, half) > 1e-12, dr.rsqrt(dr.dot(half, half)), 0.0)
            facing = dr.abs(dr.dot(normal, half))
            flat = color * (self._ambient + self._diffuse)
        highlight = dr.select(facing > 0.0, dr.exp2(self._shininess * dr.log2(facing)), 0.0)
        lit = color * (self._ambient + self._diffuse * dr.abs(dr.dot(normal, towards)))
        trust = square / (square + self._floor)
        return trust * (lit + self._specular * highlight) + (1.0 - trust) * flat


class VolumeLayer(_Lit):
    """A transfer function on a field."""

    def __init__(self, layer: Layer, field: Field, per_voxel: Any, table: NDArray[np.float32]) -> None:
        super().__init__(layer, field, per_voxel)
        self._table = mi.Float(aligned(table))
        self._last = dr.opaque(mi.Float, float(len(table) - 1))
        visible = np.flatnonzero(table[:, 3] > 0.0)
        # Two more entries on either side: one for interpolation, one for rounding.
        low, high = (visible[0] - 2, visible[-1] + 2) if len(visible) else (2 * len(table), -1)
        self._low = dr.opaque(mi.Float, float(low / (len(table) - 1)))
        self._high = dr.opaque(mi.Float, float(high / (len(table) - 1)))

    def may_show(self, value: Any) -> Any:
        """False for values that certainly have no opacity."""
        return (value >= self._low) & (value <= self._high)

    def classify(self, value: Any) -> Any:
        """Color and extinction, linear between the entries of the table."""
        at = value * self._last
        cell = dr.floor(at)
        cell = dr.select(cell < self._last, cell, self._last - 1.0)
        low = dr.gather(mi.Vector4f, self._table, mi.UInt32(cell))
        high = dr.gather(mi.Vector4f, self._table, mi.UInt32(cell) + 1)
        return dr.fma(high - low, at - cell, low)


class SurfaceLayer(_Lit):
    """Isosurfaces of a field, by rising level."""

    def __init__(self, layer: Layer, field: Field, per_voxel: Any) -> None:
        super().__init__(layer, field, per_voxel)
        table = [(*surface.color, surface.opacity) for _, surface in layer.levels]
        # One more, never used: Dr.Jit would compile another kernel for a single level.
        levels = [*(level for level, _ in layer.levels), 2.0]
        self.count = dr.opaque(mi.Int32, len(table))
        self.levels = mi.Float(aligned(np.array(levels, dtype=np.float32)))
        self.table = mi.Float(aligned(np.array(table, dtype=np.float32)))


def _any(conditions: Sequence[Any]) -> Any:
    result = conditions[0]
    for condition in conditions[1:]:
        result |= condition
    return result


def _lit(layers: Sequence[_Lit]) -> bool:
    return any(layer.light is not None for layer in layers)


def _inverse(step: Any) -> Any:
    """Inverse of a ray step; what stands still along an axis never arrives."""
    return mi.Vector3f(*(dr.select(dr.abs(d) > 1e-12, 1.0 / d, 1e12) for d in step))


def _clamp(color: Any) -> Any:
    """Clamp to [0, 1]."""
    return dr.select(color > 1.0, 1.0, dr.select(color > 0.0, color, 0.0))
