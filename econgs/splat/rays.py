"""How much deeper a Gaussian is along a ray than on average."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MIN_THROUGH = 1e-4  # least transmittance of a Gaussian whose depth is changed
MAX_DEPTH = 50.0  # relative


def relative_depths(rays: Tensor, scales: Tensor) -> Tensor:
    """Optical depths through the middles of Gaussians, relative to those from a mean direction.

    A Gaussian keeps its mass: its depth is inverse to its area across the ray. The mean area is the root of
    the mean square over all directions, which is that over the three axes.

    Args:
        rays: (N, 3) directions in the Gaussians' axes, of length 1.
        scales: (N, 3) standard deviations.

    Returns:
        N factors, from √⅓ (a sheet seen from the front) to 50.
    """
    areas = torch.stack([scales[:, one] * scales[:, two] for one, two in ((1, 2), (0, 2), (0, 1))], dim=1)
    least = torch.finfo(scales.dtype).tiny
    squares = (areas / areas.detach().amax(1, keepdim=True).clamp_min(least)).square()
    across = (rays.square() * squares).sum(1)
    depth = 0.5 * (squares.mean(1).clamp_min(least).log() - across.clamp_min(least).log())
    return depth.clamp_max(math.log(MAX_DEPTH)).exp()


def deepen(opacities: Tensor, factors: Tensor) -> Tensor:
    """N opacities of Gaussians whose optical depths are ``factors`` times as large."""
    return 1.0 - (1.0 - opacities).clamp_min(MIN_THROUGH) ** factors
