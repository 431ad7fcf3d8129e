"""Reference ray marcher in torch: the float64 oracle, and the renderer where Mitsuba cannot run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.ground_truth.model import (
    BISECTIONS,
    Layer,
    Marcher,
    MarchSettings,
    index_transform,
)
from econgs_bench.datasets.ground_truth.occlusion import bake
from econgs_bench.datasets.ground_truth.sampling import Places, Tracer
from econgs_bench.datasets.scene import Light
from econgs_bench.datasets.volume import Volume

_SAMPLES_AT_ONCE = {"cpu": 2**20, "cuda": 2**24}


@dataclass(eq=False)
class _Part:
    """A layer as tensors: its grids, and its table or its levels (value, color, opacity; ascending)."""

    layer: Layer
    values: Tensor
    mask: Tensor | None
    table: Tensor | None
    levels: list[tuple[float, Tensor, float]]


@dataclass(eq=False)
class _Scene:
    parts: list[_Part]
    occlusion: Tensor | None = None
    scale: float = 1.0
    offset: float = 0.0


@dataclass(eq=False)
class _Hits:
    """Crossings of isosurfaces: segment, place within it (share), opacity and color."""

    segment: Tensor
    share: Tensor
    opacity: Tensor
    color: Tensor


class ReferenceMarcher(Marcher):
    """The plainest evaluation of :mod:`.datasets.ground_truth.model`.

    Args:
        volume: the field, or the fields of a composition.
        settings: step and table size.
        dtype: torch.float64 for the oracle, torch.float32 for speed.
        device: "cpu" or "cuda".

    Raises:
        DataError: the volumes differ in grid or box.
    """

    rays_at_once = 1  # a view by itself: progress is seen, and nothing is gained by more

    def __init__(
        self,
        volume: Volume | Sequence[Volume],
        settings: MarchSettings = MarchSettings(),  # noqa: B008  (frozen)
        dtype: torch.dtype = torch.float64,
        device: str = "cpu",
    ) -> None:
        super().__init__(volume, settings)
        self._dtype, self._device = dtype, device
        self._normalised = [each.normalised() for each in self._volumes]
        self._values = [self._tensor(values) for values in self._normalised]
        self._masks = [None if v.mask is None else self._tensor(v.mask) for v in self._volumes]
        first = self._volumes[0]
        scale, offset = index_transform(first)
        self._scale, self._offset = self._tensor(scale), self._tensor(offset)
        self._lower, self._upper = (self._tensor(corner) for corner in first.box)

    def tracer(self, layers: Sequence[Layer]) -> Tracer:
        """See :class:`.datasets.ground_truth.model.Marcher`."""
        return _Rays(self, self._scene(layers))

    def compose_exact(self, camera: Camera, layers: Sequence[Layer]) -> Tensor:
        """(height, width, 4) premultiplied RGBA in this marcher's own precision."""
        return self._image(camera, self._scene(layers))

    def _scene(self, layers: Sequence[Layer]) -> _Scene:
        numbers = self._numbers(layers)
        size = self._settings.table_size
        parts = []
        for layer, n in zip(layers, numbers, strict=True):
            table = None
            if layer.transfer is not None:
                entries = layer.transfer.entries(size)
                table = self._tensor(layer.transfer.classify(np.linspace(0.0, 1.0, entries)))
            levels = [(level, self._tensor(np.array(s.color)), s.opacity) for level, s in layer.levels]
            parts.append(_Part(layer, self._values[n], self._masks[n], table, levels))
        if not any(layer.depth_enhancement > 0.0 for layer in layers):
            return _Scene(parts)
        baked = bake(layers, [self._normalised[n] for n in numbers], size)
        return _Scene(parts, self._tensor(baked.values), baked.scale, baked.offset)

    def _image(self, camera: Camera, scene: _Scene) -> Tensor:
        """(height, width, 4) values along the rays of all pixel centres."""
        origin, directions = (self._tensor(a) for a in camera.rays())
        return self._traced(origin, directions.reshape(-1, 3), scene).reshape(camera.height, camera.width, 4)

    @torch.no_grad()
    def _traced(self, origin: Tensor, rays: Tensor, scene: _Scene) -> Tensor:
        """(R, 4) values along rays (R, 3) from one point."""
        near, far = self._box_interval(origin, rays)
        image = torch.zeros(len(rays), 4, dtype=self._dtype, device=self._device)
        hits = torch.nonzero(far > near)[:, 0]
        if len(hits):
            steps = int(torch.ceil((far - near)[hits].max() / self._dt))
            at_once = _SAMPLES_AT_ONCE[torch.device(self._device).type]
            for part in hits.split(max(1, at_once // steps)):
                with torch.device(self._device):
                    image[part] = self._march(origin, rays[part], near[part], far[part], scene)
        return image

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device, self._dtype)

    def _box_interval(self, origin: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Distances along each ray at which it enters and leaves the box (far <= near: a miss)."""
        inverse = 1.0 / torch.where(rays.abs() < 1e-12, torch.full_like(rays, 1e-12), rays)
        a, b = (self._lower - origin) * inverse, (self._upper - origin) * inverse
        near = torch.minimum(a, b).amax(dim=1).clamp_min(0.0)
        return near, torch.maximum(a, b).amin(dim=1)

    def _march(self, origin: Tensor, rays: Tensor, near: Tensor, far: Tensor, scene: _Scene) -> Tensor:
        """(R, 4) premultiplied RGBA of rays that hit the box; rays x segments at once."""
        steps = int(torch.ceil((far - near).max() / self._dt))
        start = near[:, None] + self._dt * torch.arange(steps, dtype=self._dtype)
        length = (far[:, None] - start).clamp(0.0, self._dt)
        ray, step = torch.nonzero(length > 0.0, as_tuple=True)
        start, length = start[ray, step], length[ray, step]
        middle = (origin + (start + 0.5 * length)[:, None] * rays[ray]) * self._scale + self._offset
        visible, extinction, color = self._sample(scene, middle, rays, ray)
        depth = extinction * length[visible]
        if not any(part.levels for part in scene.parts):
            return _composite(ray[visible], -torch.expm1(-depth), color, len(rays))
        first = (origin + start[:, None] * rays[ray]) * self._scale + self._offset
        hits = self._hits(scene, first, length[:, None] * rays[ray] * self._scale, rays, ray)
        segment, depth, opacity, color = _split(hits, visible, depth, color, len(ray))
        alpha = torch.where(torch.isnan(opacity), -torch.expm1(-depth), opacity)
        return _composite(ray[segment], alpha, color, len(rays))

    def _sample(self, scene: _Scene, index: Tensor, rays: Tensor, ray: Tensor) -> tuple[Tensor, ...]:
        """Indices of visible samples among the grid indices (S, 3), their extinction and color (., 3)."""
        total = torch.zeros(len(index), dtype=self._dtype)
        parts = []
        for part in scene.parts:
            if part.table is None:
                continue
            classified = _classify(_value(part.values, index), part.table)
            visible = torch.nonzero(classified[:, 3] > 0.0)[:, 0]
            weight, color, at = classified[visible, 3], classified[visible, :3], index[visible]
            if part.mask is not None:
                weight = weight * _value(part.mask, at)
            color = self._shade(scene, part, color, at, -rays[ray[visible]])
            total[visible] += weight
            parts.append((visible, weight, color))
        if len(parts) == 1:
            return parts[0]
        union = torch.nonzero(total > 0.0)[:, 0]
        mixed = torch.zeros(len(index), 3, dtype=self._dtype)
        for visible, weight, color in parts:
            mixed[visible] += weight[:, None] * color
        return union, total[union], mixed[union] / total[union, None]

    def _hits(self, scene: _Scene, first: Tensor, stride: Tensor, rays: Tensor, ray: Tensor) -> _Hits:
        """Crossings in segments, by segment, layer and order along the ray."""
        crossings = []
        for n, part in enumerate(scene.parts):
            if not part.levels:
                continue
            before, after = _value(part.values, first), _value(part.values, first + stride)
            for level, color, opacity in part.levels:
                segment = torch.nonzero((before >= level) != (after >= level))[:, 0]
                low, high = (torch.full((len(segment),), x, dtype=self._dtype) for x in (0.0, 1.0))
                at_low, at_high = before[segment], after[segment]
                for _ in range(BISECTIONS):
                    middle = 0.5 * (low + high)
                    value = _value(part.values, first[segment] + middle[:, None] * stride[segment])
                    beyond = (value >= level) != (at_low >= level)
                    high, at_high = torch.where(beyond, middle, high), torch.where(beyond, value, at_high)
                    low, at_low = torch.where(beyond, low, middle), torch.where(beyond, at_low, value)
                share = low + (high - low) * (level - at_low) / (at_high - at_low)
                at = first[segment] + share[:, None] * stride[segment]
                alpha = torch.full_like(share, opacity)
                if part.mask is not None:
                    alpha = torch.where(_value(part.mask, at) < 0.5, 0.0, alpha)
                shaded = self._shade(scene, part, color.expand(len(at), 3), at, -rays[ray[segment]])
                crossings.append((segment, torch.full_like(segment, n), share, alpha, shaded))
        segment, number, share, alpha, shaded = (torch.cat(column) for column in zip(*crossings, strict=True))
        order = _order(share, number, segment)
        return _Hits(segment[order], share[order], alpha[order], shaded[order])

    def _shade(self, scene: _Scene, part: _Part, color: Tensor, index: Tensor, view: Tensor) -> Tensor:
        """Shaded, clamped and darkened color (S, 3) of one layer at grid indices (S, 3)."""
        if part.layer.light is not None:
            color = self._lit(part, color, index, view, part.layer.light)
        color = color.clamp(0.0, 1.0)
        if scene.occlusion is not None:
            occlusion = _value(scene.occlusion, index * scene.scale + scene.offset)
            color = color * (1.0 - part.layer.depth_enhancement * occlusion)[:, None]
        return color

    def _lit(self, part: _Part, color: Tensor, index: Tensor, view: Tensor, light: Light) -> Tensor:
        values, sides = part.values, []
        for axis in range(3):
            offset = torch.zeros(3, dtype=self._dtype)
            offset[axis] = 1.0
            sides.append(_value(values, index + offset) - _value(values, index - offset))
        gradient = 0.5 * torch.stack(sides, dim=-1) * (self._scale * self._voxel)
        square = (gradient * gradient).sum(-1, keepdim=True)
        normal = gradient / square.sqrt().clamp_min(1e-12)
        fixed = None if light.direction is None else self._tensor(np.array(light.direction))
        towards = view if fixed is None else fixed.expand_as(view)
        lit = light.ambient + light.diffuse * (normal * towards).sum(-1, keepdim=True).abs()
        if light.model == "phong":
            mirrored = 2.0 * (normal * towards).sum(-1, keepdim=True) * normal - towards
            facing = (mirrored * view).sum(-1, keepdim=True).clamp_min(0.0)
            flat = light.ambient
        else:
            half = view + towards
            half = half / half.norm(dim=-1, keepdim=True).clamp_min(1e-6)
            facing = (normal * half).sum(-1, keepdim=True).abs()
            flat = light.ambient + light.diffuse
        trust = square / (square + part.layer.floor**2)
        shaded: Tensor = trust * (color * lit + light.specular * facing**light.shininess)
        return shaded + (1.0 - trust) * flat * color


class _Rays:
    """Rays of a scene; see :class:`.datasets.ground_truth.sampling.Tracer`."""

    def __init__(self, marcher: ReferenceMarcher, scene: _Scene) -> None:
        self._marcher, self._scene = marcher, scene

    def centres(self, cameras: Sequence[Camera]) -> NDArray[np.float32]:
        return np.stack([_float32(self._marcher._image(camera, self._scene)) for camera in cameras])

    def rays(self, cameras: Sequence[Camera], places: Places) -> NDArray[np.float32]:
        values = np.empty((len(places.view), 4), dtype=np.float32)
        for number in np.unique(places.view):
            own = np.flatnonzero(places.view == number)
            rays = cameras[number].rays_through(places.x[own], places.y[own])
            origin, directions = (self._marcher._tensor(a) for a in rays)
            values[own] = _float32(self._marcher._traced(origin, directions, self._scene))
        return values


def _float32(values: Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = values.to("cpu", torch.float32).numpy()
    return array


def _value(values: Tensor, index: Tensor) -> Tensor:
    """Trilinear interpolation of (nz, ny, nx) at grid indices (S, 3), clamped at the border."""
    counts = torch.tensor(values.shape[::-1], dtype=values.dtype)
    grid = index * (2.0 / (counts - 1.0).clamp_min(1.0)) - 1.0
    return grid_sample(
        values[None, None], grid[None, None, None], mode="bilinear", padding_mode="border", align_corners=True
    )[0, 0, 0, 0]


def _classify(values: Tensor, table: Tensor) -> Tensor:
    at = values.clamp(0.0, 1.0) * (len(table) - 1)
    cell = at.floor().clamp(max=len(table) - 2)
    low = table[cell.long()]
    return low + (at - cell)[:, None] * (table[cell.long() + 1] - low)


def _split(
    hits: _Hits, visible: Tensor, depth: Tensor, color: Tensor, n: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut segments at their crossings.

    Args:
        hits: crossings, sorted by segment.
        visible: indices of the segments with volume.
        depth: optical depth of each of them.
        color: (., 3) color of each of them.
        n: number of all segments.

    Returns:
        By segment and order along the ray: number of the segment, optical depth of the piece, opacity of the
        crossing (NaN for pieces of volume), color.
    """
    depth = torch.zeros(n, dtype=depth.dtype).index_copy(0, visible, depth)
    color = torch.zeros(n, 3, dtype=color.dtype).index_copy(0, visible, color)
    done = torch.zeros_like(depth)
    rank = torch.arange(len(hits.segment)) - torch.searchsorted(hits.segment, hits.segment)
    before = torch.zeros_like(hits.share)
    most = int(rank.max()) + 1 if len(rank) else 0
    for r in range(most):  # one crossing of every segment at a time
        now = torch.nonzero(rank == r)[:, 0]
        there = hits.segment[now]
        before[now] = (hits.share[now] - done[there]).clamp_min(0.0)
        done[there] += before[now]
    nothing, nan = torch.zeros_like(hits.share), torch.full_like(depth, torch.nan)
    segment = torch.cat([hits.segment, hits.segment, torch.arange(n)])
    slot = torch.cat([2 * rank, 2 * rank + 1, torch.full((n,), 2 * most)])
    depth = torch.cat([depth[hits.segment] * before, nothing, depth * (1.0 - done)])
    opacity = torch.cat([nan[hits.segment], hits.opacity, nan])
    color = torch.cat([color[hits.segment], hits.color, color])
    order = _order(slot, segment)
    return segment[order], depth[order], opacity[order], color[order]


def _order(*keys: Tensor) -> Tensor:
    """Positions that sort by the last key first, as ``numpy.lexsort`` has them."""
    order = np.lexsort([key.cpu().numpy() for key in keys])
    return torch.from_numpy(order).to(keys[0].device)


def _composite(ray: Tensor, alpha: Tensor, color: Tensor, rays: int) -> Tensor:
    """(R, 4) premultiplied RGBA of samples along rays, sorted by ray and from front to back."""
    visible = torch.nonzero(alpha > 0.0)[:, 0]
    ray, alpha, color = ray[visible], alpha[visible], color[visible]
    image = torch.zeros(rays, 4, dtype=alpha.dtype)
    if not len(visible):
        return image
    rank = torch.arange(len(ray)) - torch.searchsorted(ray, ray)
    through = torch.ones(rays, int(rank.max()) + 1, dtype=alpha.dtype)
    through[ray, rank] = 1.0 - alpha
    transmitted = torch.cumprod(through, dim=1)
    before = torch.cat([torch.ones_like(transmitted[:, :1]), transmitted[:, :-1]], dim=1)
    image[:, :3].index_add_(0, ray, (before[ray, rank] * alpha)[:, None] * color)
    image[:, 3] = 1.0 - transmitted[:, -1]
    return image
