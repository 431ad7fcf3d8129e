"""Reference ray marcher in torch: the float64 oracle, and the renderer where Mitsuba cannot run."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from datasets.camera import Camera
from datasets.ground_truth.model import GRADIENT_FLOOR, PHONG_FLOOR, MarchSettings, Progress, index_transform
from datasets.scene import Light
from datasets.transfer import TransferFunction
from datasets.volume import Volume

_SAMPLES_AT_ONCE = 2**20


class ReferenceMarcher:
    """Evaluates :mod:`datasets.ground_truth.model` in the plainest way.

    Args:
        volume: the field.
        settings: step and table size.
        dtype: torch.float64 for the oracle, torch.float32 for speed.
    """

    def __init__(
        self,
        volume: Volume,
        settings: MarchSettings = MarchSettings(),  # noqa: B008  (frozen)
        dtype: torch.dtype = torch.float64,
    ) -> None:
        self._dtype = dtype
        self._settings = settings
        self._values = torch.from_numpy(volume.normalised()).to(dtype)[None, None]
        scale, offset = index_transform(volume)
        self._scale, self._offset = self._tensor(scale), self._tensor(offset)
        self._lower, self._upper = (self._tensor(corner) for corner in volume.box)
        self._voxel = volume.voxel
        self._dt = settings.step_voxels * volume.voxel

    def render(
        self,
        cameras: tuple[Camera, ...],
        transfer: TransferFunction,
        light: Light | None,
        progress: Progress | None = None,
    ) -> NDArray[np.float32]:
        """See :class:`datasets.ground_truth.model.Marcher`."""
        images = []
        for done, camera in enumerate(cameras, start=1):
            images.append(self.render_exact(camera, transfer, light).to(torch.float32).numpy())
            if progress:
                progress(done, len(cameras))
        return np.stack(images)

    @torch.no_grad()
    def render_exact(self, camera: Camera, transfer: TransferFunction, light: Light | None) -> Tensor:
        """(height, width, 4) premultiplied RGBA in this marcher's own precision."""
        size = self._settings.table_size
        table = self._tensor(transfer.classify(np.linspace(0.0, 1.0, size)))
        origin, directions = (self._tensor(a) for a in camera.rays())
        rays = directions.reshape(-1, 3)
        near, far = self._box_interval(origin, rays)
        image = torch.zeros(len(rays), 4, dtype=self._dtype)
        hits = torch.nonzero(far > near)[:, 0]
        if len(hits):
            steps = int(torch.ceil((far - near)[hits].max() / self._dt))
            for part in hits.split(max(1, _SAMPLES_AT_ONCE // steps)):
                image[part] = self._march(origin, rays[part], near[part], far[part], table, light)
        return image.reshape(camera.height, camera.width, 4)

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._dtype)

    def _box_interval(self, origin: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Distances along each ray at which it enters and leaves the box (far <= near: a miss)."""
        inverse = 1.0 / torch.where(rays.abs() < 1e-12, torch.full_like(rays, 1e-12), rays)
        a, b = (self._lower - origin) * inverse, (self._upper - origin) * inverse
        near = torch.minimum(a, b).amax(dim=1).clamp_min(0.0)
        return near, torch.maximum(a, b).amin(dim=1)

    def _march(
        self, origin: Tensor, rays: Tensor, near: Tensor, far: Tensor, table: Tensor, light: Light | None
    ) -> Tensor:
        """(R, 4) premultiplied RGBA of rays that hit the box; rays x steps samples at once."""
        steps = int(torch.ceil((far - near).max() / self._dt))
        start = near[:, None] + self._dt * torch.arange(steps, dtype=self._dtype)
        length = (far[:, None] - start).clamp(0.0, self._dt)
        ray, step = torch.nonzero(length > 0.0, as_tuple=True)
        length = length[ray, step]
        at = origin + (start[ray, step] + 0.5 * length)[:, None] * rays[ray]
        index = at * self._scale + self._offset
        classified = self._classify(self._value(index), table)
        opacity = -torch.expm1(-classified[:, 3] * length)

        seen = torch.nonzero(opacity > 0.0)[:, 0]
        color = classified[seen, :3]
        if light is not None:
            color = self._shade(color, index[seen], -rays[ray[seen]], light)

        alpha = torch.zeros(len(rays), steps, dtype=self._dtype)
        alpha[ray, step] = opacity
        transmitted = torch.cumprod(1.0 - alpha, dim=1)
        before = torch.cat([torch.ones_like(transmitted[:, :1]), transmitted[:, :-1]], dim=1)
        weight = (before * alpha)[ray[seen], step[seen]]
        image = torch.zeros(len(rays), 4, dtype=self._dtype)
        image[:, :3].index_add_(0, ray[seen], weight[:, None] * color.clamp(0.0, 1.0))
        image[:, 3] = 1.0 - transmitted[:, -1]
        return image

    def _value(self, index: Tensor) -> Tensor:
        """Trilinear interpolation at grid indices (S, 3), clamped at the border."""
        grid = index / self._offset - 1.0
        return grid_sample(
            self._values, grid[None, None, None], mode="bilinear", padding_mode="border", align_corners=True
        )[0, 0, 0, 0]

    @staticmethod
    def _classify(values: Tensor, table: Tensor) -> Tensor:
        at = values.clamp(0.0, 1.0) * (len(table) - 1)
        cell = at.floor().clamp(max=len(table) - 2)
        low = table[cell.long()]
        return low + (at - cell)[:, None] * (table[cell.long() + 1] - low)

    def _shade(self, color: Tensor, index: Tensor, view: Tensor, light: Light) -> Tensor:
        sides = []
        for axis in range(3):
            offset = torch.zeros(3, dtype=self._dtype)
            offset[axis] = 1.0
            sides.append(self._value(index + offset) - self._value(index - offset))
        gradient = 0.5 * torch.stack(sides, dim=-1) * (self._scale * self._voxel)
        square = (gradient * gradient).sum(-1, keepdim=True)
        normal = gradient / square.sqrt().clamp_min(1e-12)
        fixed = None if light.direction is None else self._tensor(np.array(light.direction))
        towards = view if fixed is None else fixed.expand_as(view)
        lit = light.ambient + light.diffuse * (normal * towards).sum(-1, keepdim=True).abs()
        if light.model == "phong":
            mirrored = 2.0 * (normal * towards).sum(-1, keepdim=True) * normal - towards
            facing = (mirrored * view).sum(-1, keepdim=True).clamp_min(0.0)
            floor, flat = PHONG_FLOOR, light.ambient
        else:
            half = view + towards
            half = half / half.norm(dim=-1, keepdim=True).clamp_min(1e-6)
            facing = (normal * half).sum(-1, keepdim=True).abs()
            floor, flat = GRADIENT_FLOOR, light.ambient + light.diffuse
        trust = square / (square + floor**2)
        shaded: Tensor = trust * (color * lit + light.specular * facing**light.shininess)
        return shaded + (1.0 - trust) * flat * color
