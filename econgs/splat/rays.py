"""Depth of Gaussians along the rays of a view, for a rasteriser that does not know it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from datasets.camera import Camera
from econgs.splat.torch_backend import MIN_THROUGH, RAY_LIMIT, rotations


def along_rays(
    opacities: Tensor, means: Tensor, quats: Tensor, scales: Tensor, camera: Camera, power: float
) -> Tensor:
    """Opacities of Gaussians in a view; see ``ray_power`` of :class:`econgs.splat.LowPass`."""
    eye = torch.as_tensor(camera.position, dtype=means.dtype, device=means.device)
    ray = torch.nn.functional.normalize(means - eye, dim=1)
    least = math.sqrt(torch.finfo(means.dtype).tiny)
    scales = scales.clamp_min(least)
    through = (torch.einsum("nij,ni->nj", rotations(quats), ray) / scales).square().sum(1)
    length = -0.5 * through.log() - scales.log().mean(1)
    factor = (power * length.clamp(-RAY_LIMIT, RAY_LIMIT)).exp()
    return 1.0 - (1.0 - opacities).clamp_min(MIN_THROUGH) ** factor
