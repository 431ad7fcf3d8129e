"""The first Gaussians: from a point cloud or at random."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from econgs_bench.econgs.points import neighbour_distances
from econgs_bench.methods.gaussian_splatting.model import SH_REST
from econgs_bench.methods.gaussian_splatting.spec import HarmonicsOptions
from econgs_bench.methods.interface import Refused, SceneInput
from econgs_bench.methods.shared.start import thinned

SH_C0 = 0.28209479177387814


def first_points(
    scene: SceneInput, options: HarmonicsOptions, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Positions and colors (N, 3) of the first Gaussians.

    Raises:
        Refused: no points to start from.
    """
    if options.start == "random":
        half = options.random_half_extent
        points = (torch.rand((options.random_points, 3), generator=generator) * 2.0 - 1.0) * half
        return points, torch.full_like(points, 0.5)
    if len(scene.cloud) == 0:
        raise Refused(f"the initial cloud of scene {scene.name!r} is empty; set start=random")
    points, colors = (
        torch.from_numpy(np.array(one, dtype=np.float32)) for one in (scene.cloud.points, scene.cloud.colors)
    )
    cameras = scene.train.cameras
    kept = thinned(points.numpy(), options.start_spacing, cameras, options.start_points)
    return points[kept], colors[kept]


def first_gaussians(
    points: Tensor, colors: Tensor, extent: float, *, scale: float, opacity: float
) -> dict[str, Tensor]:
    """Round Gaussians of one opacity at points.

    Args:
        points: (N, 3).
        colors: (N, 3) in [0, 1].
        extent: of the scene; a point without others gets a hundredth of it.
        scale: standard deviations in root mean squared distances to the three nearest neighbours.
        opacity: of each.

    Returns:
        Parameters on the CPU, shapes as in ``model.SceneGaussians``.
    """
    n = len(points)
    scales = scale * neighbour_distances(points, 0.01 * extent)
    quats = torch.zeros((n, 4))
    quats[:, 0] = 1.0
    return {
        "means": points,
        "log_scales": scales.log()[:, None].repeat(1, 3),
        "quats": quats,
        "logits": torch.full((n,), opacity).logit(),
        "sh_dc": ((colors - 0.5) / SH_C0)[:, None],
        "sh_rest": torch.zeros((n, SH_REST, 3)),
    }
