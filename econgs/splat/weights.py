"""How much Gaussians weigh in a picture."""

from __future__ import annotations

import torch
from torch import Tensor

from econgs_bench.econgs.splat.rasterise import rasterise
from econgs_bench.econgs.splat.splats import Splats


def blending_weights(splats: Splats) -> Tensor:
    """(M,) the weight of each Gaussian, summed over pixels; whatever its color.

    The weight in a pixel is the share of the blended color. Its sum is the derivative of the picture's sum
    with respect to the Gaussian's color.
    """
    # Copies, because tensors of inference mode take part in no gradient.
    means, quats, scales, opacities = (one.detach().clone() for one in splats[:4])
    gray = torch.ones_like(means[:, :1]).requires_grad_(True)
    with torch.enable_grad():
        images = rasterise(means, quats, scales, opacities, gray, splats.camera, low_pass=splats.low_pass)
        images.features.sum().backward()  # type: ignore[no-untyped-call]
    return torch.zeros_like(means[:, 0]) if gray.grad is None else gray.grad[:, 0]
