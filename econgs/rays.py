"""Rays through pixels of cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of a camera, or of several.

    Attributes:
        origins: (B, 3).
        directions: (B, 3) unit vectors.
        near: (B,) distance from the origin of the near plane.
    """

    origins: Tensor
    directions: Tensor
    near: Tensor

    def __len__(self) -> int:
        return len(self.near)

    def __getitem__(self, rows: slice) -> Rays:
        return Rays(self.origins[rows], self.directions[rows], self.near[rows])

    def to(self, device: str) -> Rays:
        """The rays on a device."""
        return Rays(self.origins.to(device), self.directions.to(device), self.near.to(device))


def camera_rays(camera: Camera, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays through the centres of all pixels of a camera, row after row, on the CPU."""
    origin, directions = camera.rays()
    flat = directions.reshape(-1, 3)
    near = camera.near / (flat @ camera.camera_to_world[:3, 2])
    arrays = (np.broadcast_to(origin, flat.shape), flat, near)
    return Rays(*(torch.from_numpy(np.ascontiguousarray(one)).to(dtype) for one in arrays))


class PixelRays:
    """Rays through any pixels of several cameras, all cameras' pixels numbered in a row."""

    def __init__(self, cameras: Sequence[Camera], dtype: torch.dtype = torch.float64) -> None:
        """For cameras with pictures of one size."""
        self.height, self.width = cameras[0].height, cameras[0].width
        self.poses = torch.from_numpy(np.stack([one.camera_to_world for one in cameras])).to(dtype)
        numbers = [[one.fx, one.fy, one.cx, one.cy, one.near] for one in cameras]
        self.numbers = torch.tensor(numbers, dtype=dtype)

    def __call__(self, pixels: Tensor) -> Rays:
        """Rays through the centres of pixels (B,) int64, on the CPU."""
        view = pixels // (self.height * self.width)
        row, column = pixels // self.width % self.height, pixels % self.width
        fx, fy, cx, cy, near = self.numbers[view].unbind(1)
        x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
        local = torch.stack([x, y, torch.ones_like(x)], dim=1)
        length = local.norm(dim=1)
        poses = self.poses[view]
        directions = (poses[:, :3, :3] @ local[:, :, None])[:, :, 0] / length[:, None]
        return Rays(poses[:, :3, 3].contiguous(), directions, near * length)
