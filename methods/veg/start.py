"""The first Gaussians: points of all scenes of a group, with the volume's values and gradients there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from econgs_bench.econgs.points import neighbour_distances
from econgs_bench.methods.interface import Refused, SceneInput
from econgs_bench.methods.shared.start import thinned
from econgs_bench.methods.veg.field import gradients_at, values_at
from econgs_bench.methods.veg.spec import VegOptions

FIRST_OPACITY = {"depth": 0.3, "product": 0.1}
"""The published one of the product. Of the depth: Gaussians that deviate by 0.6 of their spacing overlap, and
with the whole density each they would add up to (2π)^1.5 0.6³ = 3.4 times that of the volume."""
_EDGE = 1e-4  # values nearer to 0 or 1 have no finite logit


def initial_parameters(
    group: Sequence[SceneInput], options: VegOptions, generator: torch.Generator
) -> dict[str, Tensor]:
    """Parameters of the first Gaussians, on the CPU.

    Raises:
        Refused: no points to start from, or more than ``max_gaussians``.
    """
    points, scalars, normals = _points(group, options, generator)
    n = len(points)
    if n == 0:
        names = ", ".join(scene.name for scene in group)
        raise Refused(f"the initial clouds of {names} are empty; set start=random")
    if 0 < options.max_gaussians < n:
        raise Refused(f"{n} initial points are more than max_gaussians = {options.max_gaussians}")
    extent = max(scene.extent for scene in group)
    scales = options.start_scale * neighbour_distances(points, 0.01 * extent)
    quats = torch.zeros((n, 4))
    quats[:, 0] = 1.0
    if options.start_normals == "random":
        normals = torch.randn((n, 3), generator=generator)
    full = {
        "ambient": options.shading_start,
        "diffuse": options.shading_start,
        "specular": 0.0,
        "shininess": 0.0,
    }
    return {
        "means": points,
        "log_scales": scales.log()[:, None].repeat(1, 3),
        "quats": quats,
        "normals": torch.nn.functional.normalize(normals, dim=1),
        "scalars": scalars.clamp(_EDGE, 1.0 - _EDGE).logit(),
        "opacities": torch.full((n,), FIRST_OPACITY[options.opacity_law]).logit(),
        **{name: torch.full((n, 1), value) for name, value in full.items()},
    }


def _points(
    group: Sequence[SceneInput], options: VegOptions, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (n, 3), normalised values (n,) and gradients (n, 3), no position twice."""
    positions, values, gradients = [], [], []
    for place, scene in enumerate(group):
        assert scene.volume is not None
        volume = scene.volume()
        if options.start == "random":
            if place:
                break  # the group has one volume
            low, high = (torch.from_numpy(corner / scene.units).float() for corner in volume.box)
            points = low + (high - low) * torch.rand((options.random_points, 3), generator=generator)
            positions.append(points.numpy())
        else:
            positions.append(np.asarray(scene.cloud.points, dtype=np.float32).reshape(-1, 3))
        inside = scene.units * positions[-1].astype(np.float64)
        values.append(values_at(volume, inside))
        gradients.append(gradients_at(volume, inside))
    joined = np.concatenate(positions)
    _, first = np.unique(joined, axis=0, return_index=True)
    first.sort()
    if options.start == "cloud":
        cameras = [camera for scene in group for camera in scene.train.cameras]
        first = first[thinned(joined[first], options.start_spacing, cameras, options.start_points)]
    one, two, three = (
        torch.from_numpy(np.concatenate(parts)[first]).float() for parts in (positions, values, gradients)
    )
    return one, two, three
