"""What models could do without: the Gaussians that weigh least in the training views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from econgs_bench.bench.jobs.monitor import as_numpy
from econgs_bench.bench.metrics import evaluate
from econgs_bench.bench.store.records import PruningResult
from econgs_bench.econgs.splat import rasterise
from econgs_bench.econgs.splat.composite import over
from econgs_bench.methods.interface import HasGaussians
from econgs_bench.methods.shared.pruning import contributions, greatest
from econgs_bench.reports.schema import PRUNED

if TYPE_CHECKING:
    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.views import ViewSet

_STEPS = 1024
"""A share is found to 1 / so many."""


def pruning(
    model: HasGaussians, scene: str, training: Sequence[Camera], cameras: Sequence[Camera], truth: ViewSet
) -> PruningResult | None:
    """How many Gaussians of a scene can go until PSNR is lower by each step of :data:`PRUNED`.

    Args:
        model: of the scene.
        scene: its name.
        training: cameras whose pictures tell what weighs; a Gaussian counts if one of these splats it.
        cameras: those of the compared views.
        truth: of the compared views.

    Returns:
        None if no training view splats any.
    """
    numbers = by_weight(model, scene, training)
    if not len(numbers):
        return None

    def quality(count: int) -> float:
        return _psnr(model, scene, numbers[:count], cameras, truth)

    counts = removable(len(numbers), quality, PRUNED.values())
    shares = [count / len(numbers) for count in counts]
    return PruningResult(gaussians=len(numbers), shares=dict(zip(PRUNED, shares, strict=True)))


def by_weight(model: HasGaussians, scene: str, cameras: Iterable[Camera]) -> Tensor:
    """(N,) numbers of the Gaussians that any view splats; those of the least blending weights come first."""
    with torch.no_grad():
        drawn = (model.splats(scene, camera) for camera in cameras)
        sums, seen = contributions(drawn, torch.float64, "cpu")
    numbers = seen.nonzero()[:, 0]
    return numbers[sums[numbers].argsort(stable=True)]


def removable(count: int, quality: Callable[[int], float], drops: Iterable[float]) -> list[int]:
    """For each drop, ascending, how many of ``count`` can go, by bisection.

    Args:
        count: of all.
        quality: of the rest once so many are gone.
        drops: largest losses of quality.
    """
    whole, fewest, found = quality(0), 0, []
    step = max(1, count // _STEPS)
    for drop in drops:

        def allowed(gone: int, drop: float = drop) -> bool:
            return whole - quality(min(gone, count)) <= drop

        # One that is too many, so that all may go.
        fewest = min(greatest(fewest, count + step, allowed, step=step), count)
        found.append(fewest)
    return found


def _psnr(
    model: HasGaussians, scene: str, without: Tensor, cameras: Sequence[Camera], truth: ViewSet
) -> float:
    """Mean PSNR of views in which some Gaussians are left out."""
    total = 0.0
    for index, camera in enumerate(cameras):
        with torch.inference_mode():
            splats, slots = model.splats(scene, camera)
            rows = (~torch.isin(slots, without.to(slots.device))).nonzero()[:, 0]
            means, quats, scales, opacities, colors = (one.index_select(0, rows) for one in splats[:5])
            images = rasterise(
                means, quats, scales, opacities, colors, splats.camera, low_pass=splats.low_pass
            )
            rgb = over(images.features, images.alpha, truth.background).clamp(0.0, 1.0)
            alpha = images.alpha.clamp(0.0, 1.0)
        pair = truth.images[index], as_numpy(rgb), as_numpy(alpha), truth.background
        total += evaluate(*pair, ["psnr"]).values["psnr"] or 0.0
    return total / len(cameras)
