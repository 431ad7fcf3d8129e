"""The first Gaussians: from a point cloud or at random."""

from __future__ import annotations

import numpy as np
import torch

from econgs.points import neighbour_distances
from methods.gaussian_splatting.model import SH_REST
from methods.gaussian_splatting.spec import GaussianOptions
from methods.interface import Refused, SceneInput

SH_C0 = 0.28209479177387814
INITIAL_OPACITY = 0.1


def initial_parameters(
    scene: SceneInput, options: GaussianOptions, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """Parameters of the first Gaussians, on the CPU (shapes as in ``model.SceneGaussians``).

    Raises:
        Refused: no points to start from, or more than ``max_gaussians``.
    """
    if options.start == "random":
        half = options.random_half_extent
        points = (torch.rand((options.random_points, 3), generator=generator) * 2.0 - 1.0) * half
        colors = torch.full_like(points, 0.5)
    else:
        points = torch.from_numpy(np.array(scene.cloud.points, dtype=np.float32))
        colors = torch.from_numpy(np.array(scene.cloud.colors, dtype=np.float32))
    n = len(points)
    if n == 0:
        raise Refused(f"the initial cloud of scene {scene.name!r} is empty; set start=random")
    limit = options.max_gaussians
    if 0 < limit < n:
        raise Refused(f"{n} initial points are more than max_gaussians = {limit}")
    scales = options.start_scale * neighbour_distances(points, 0.01 * scene.extent)
    quats = torch.zeros((n, 4))
    quats[:, 0] = 1.0
    return {
        "means": points,
        "log_scales": scales.log()[:, None].repeat(1, 3),
        "quats": quats,
        "logits": torch.full((n,), INITIAL_OPACITY).logit(),
        "sh_dc": ((colors - 0.5) / SH_C0)[:, None],
        "sh_rest": torch.zeros((n, SH_REST, 3)),
    }
