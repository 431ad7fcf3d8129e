"""A short training of plain Gaussians against a model's own pictures of the training views."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.losses import view_losses
from econgs_bench.econgs.optim import Adam
from econgs_bench.econgs.splat import LowPass, rasterise
from econgs_bench.econgs.splat.sh import spherical_harmonics
from econgs_bench.methods.baking.bake import VIEWERS, enlarged, sizes
from econgs_bench.methods.formats.gaussians import SHAPES
from econgs_bench.methods.gaussian_splatting.model import SceneGaussians
from econgs_bench.methods.interface import Model

ITERATIONS = 1_000
LEARNING_RATES = {"log_scales": 5e-3, "quats": 1e-3, "logits": 2e-2, "sh_dc": 2.5e-3, "sh_rest": 1e-3}
"""First learning rates; all fall to nothing in a line."""
MEANS_LR = 2e-5
"""That of places, times the greatest distance of a camera from their middle."""
ALPHA_WEIGHT = 0.2
LARGEST = 2048
"""Pixels along a side beyond which no picture is drawn, unless the training views are larger."""
_KEPT = 1 << 29
"""Bytes of the model's pictures that are kept; the others are drawn anew each time."""


def distilled(
    scene: SceneGaussians,
    model: Model,
    cameras: Sequence[Camera],
    iterations: int = ITERATIONS,
    viewer: LowPass = VIEWERS["antialiased"],
    seed: int = 0,
    report: Callable[[int, float], None] = lambda _iteration, _loss: None,
) -> SceneGaussians:
    """Gaussians that come nearer to a model's pictures, drawn as a viewer draws, at several sizes.

    Their number stays. No picture but those of the model from ``cameras``, also enlarged, is looked at.

    Args:
        scene: the Gaussians to begin with.
        model: the teacher, which holds the scene.
        cameras: of the training views.
        iterations: one view in one size each.
        viewer: how the Gaussians will be drawn.
        seed: of the order of pictures.
        report: takes the iteration, from 1, and its loss.
    """
    centres = np.stack([camera.position for camera in cameras])
    extent = float(np.linalg.norm(centres - centres.mean(0), axis=1).max()) or 1.0
    first = {**LEARNING_RATES, "means": MEANS_LR * extent}
    adam = Adam({name: getattr(scene, name).clone() for name in SHAPES}, first)
    generator = torch.Generator().manual_seed(seed)
    side = max(max(camera.width, camera.height) for camera in cameras)
    shots = [
        enlarged(camera, factor)
        for factor in sizes(viewer)
        if factor == 1 or factor * side <= LARGEST
        for camera in cameras
    ]
    pictures: dict[int, torch.Tensor] = {}
    kept = 0
    order: list[int] = []
    for iteration in range(1, iterations + 1):
        if not order:
            order = torch.randperm(len(shots), generator=generator).tolist()
        shot = order.pop()
        camera, picture = shots[shot], pictures.get(shot)
        if picture is None:
            picture = _picture(model, scene.name, camera)
            if kept + picture.nbytes <= _KEPT:
                pictures[shot], kept = picture, kept + picture.nbytes
        values = {name: adam[name] for name in SHAPES}
        position = torch.as_tensor(camera.position, dtype=torch.float32)
        means, rest = values["means"], values["sh_rest"]
        colors = spherical_harmonics(scene.sh_degree, means, position, values["sh_dc"], rest)
        drawn = rasterise(
            means, values["quats"], values["log_scales"].exp(), values["logits"].sigmoid(), colors,
            camera, low_pass=viewer,
        )  # fmt: skip
        losses = view_losses(
            drawn.features, drawn.alpha, picture.float(), scene.background, alpha_weight=ALPHA_WEIGHT
        )
        loss = losses[0] + losses[1]
        if loss.requires_grad:
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.learning_rates.update(
                {name: rate * (1.0 - (iteration - 1) / iterations) for name, rate in first.items()}
            )
            adam.step()
        report(iteration, float(loss.detach()))
    tensors = {name: adam[name].detach().clone() for name in SHAPES}
    return SceneGaussians(scene.name, scene.background, scene.sh_degree, **tensors)


def _picture(model: Model, scene: str, camera: Camera) -> torch.Tensor:
    """(H, W, 4) premultiplied, in half precision: they stay in memory."""
    with torch.inference_mode():
        rgb, alpha = model.render(camera, scenes=[scene], background=(0.0, 0.0, 0.0))
        return torch.cat([rgb, alpha[..., None]], dim=2).cpu().half().clone()
