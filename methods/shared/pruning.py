"""Pruning by contribution: the primitives that weigh least in the pictures go.

Common equipment of the methods that splat Gaussians, and what measures how many Gaussians a model can do
without (:mod:`.bench.jobs.pruning`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.views import ViewSet
from econgs_bench.econgs.anchors.gaussians import Gaussians, draw
from econgs_bench.econgs.splat import LowPass
from econgs_bench.econgs.splat.composite import over
from econgs_bench.econgs.splat.splats import Splats
from econgs_bench.econgs.splat.weights import blending_weights

VIEWS = 12
"""Training views of a scene that contributions are taken from, at most."""
COMPARED = 3
"""The errors of every so many of them are compared."""
_TRIALS = 6

GaussiansInView = Callable[[Camera, Tensor], tuple[Gaussians, Tensor]]
"""(camera, (N,) kept primitives) -> M Gaussians of these in a view, and (M,) the primitive of each."""
Errors = Callable[[Tensor], Tensor]
"""(N,) kept primitives -> (m,) mean squared errors, none of which may grow by more than is allowed."""


@dataclass(frozen=True)
class PruningViews:
    """Training views of a scene, by which its primitives are judged.

    Attributes:
        views: cameras and background.
        images: (views, H, W, 4) of them, premultiplied.
        gaussians: decodes the scene in a view.
        asks_alpha: whether the error of alpha counts too.
    """

    views: ViewSet
    images: Tensor
    gaussians: GaussiansInView
    asks_alpha: bool

    @property
    def sample(self) -> list[int]:
        """Numbers of the views that contributions are taken from."""
        return some_views(len(self.views))

    def splats(self, kept: Tensor, low_pass: LowPass) -> Iterator[tuple[Splats, Tensor]]:
        """The Gaussians of each view of the sample, and the primitive of each."""
        for view in self.sample:
            camera = self.views.cameras[view]
            one, owner = self.gaussians(camera, kept)
            fields = (one.means, one.quats, one.scales, one.opacities, one.colors)
            yield Splats(*fields, camera, low_pass=low_pass), owner

    def errors(self, kept: Tensor, low_pass: LowPass) -> Iterator[Tensor]:
        """Mean squared errors of each view that is compared: (1,) of colors, (2,) with alpha."""
        for view in self.sample[::COMPARED]:
            camera, background = self.views.cameras[view], self.views.background
            splats = draw([self.gaussians(camera, kept)[0]], camera, low_pass=low_pass)
            truth = self.images[view].to(kept.device)
            target = over(truth[..., :3], truth[..., 3], background)
            apart = [over(splats.features, splats.alpha, background) - target]
            if self.asks_alpha:
                apart.append(splats.alpha - truth[..., 3])
            yield torch.stack([one.square().mean() for one in apart])


@dataclass(frozen=True)
class Prunable:
    """Primitives of a fit that may go.

    Attributes:
        count: number of the primitives.
        scenes: views of the scenes that share them.
        keep: removes all others; takes (N,) which stay.
    """

    count: int
    scenes: Sequence[PruningViews]
    keep: Callable[[Tensor], None]

    @torch.no_grad()
    def prune(self, loss_db: float, low_pass: LowPass, device: torch.device | str) -> None:
        """Remove the primitives that contribute least.

        Args:
            loss_db: PSNR that may be lost with them [dB].
            low_pass: filter of the projected Gaussians.
            device: device of the primitives.
        """
        every = torch.ones(self.count, dtype=torch.bool, device=device)
        if self.count == 0:
            return self.keep(every)
        drawn = (one for scene in self.scenes for one in scene.splats(every, low_pass))
        sums, _ = contributions(drawn, torch.float32, device, self.count)

        def errors(kept: Tensor) -> Tensor:
            # Scenes are means of their own: some may ask for alpha and others not.
            each = [torch.stack(list(scene.errors(kept, low_pass))).mean(dim=0) for scene in self.scenes]
            return torch.cat(each).cpu()

        self.keep(survivors(sums, loss_db, errors))


def some_views(count: int, most: int = VIEWS) -> list[int]:
    """At most so many of ``count`` views, evenly spread."""
    number = min(count, most)
    return [round(i * (count - 1) / max(number - 1, 1)) for i in range(number)]


def contributions(
    drawn: Iterable[tuple[Splats, Tensor]], dtype: torch.dtype, device: torch.device | str, count: int = 0
) -> tuple[Tensor, Tensor]:
    """How much primitives weigh in pictures: sums of their blending weights over pixels and views.

    Args:
        drawn: M Gaussians of each view, and (M,) the number of the primitive of each.
        dtype: type of the sums.
        device: device of the sums.
        count: number of primitives, if it is known; else the highest number counts.

    Returns:
        (N,) sums, and (N,) whether any view splats the primitive.
    """
    sums = torch.zeros(count, dtype=dtype, device=device)
    seen = torch.zeros(count, dtype=torch.bool, device=device)
    for splats, owner in drawn:
        if not len(owner):
            continue
        weights, numbers = blending_weights(splats).to(device, dtype), owner.to(device)
        more = 0 if count else max(0, int(numbers.max()) + 1 - len(sums))
        sums, seen = (torch.nn.functional.pad(one, (0, more)) for one in (sums, seen))
        sums.index_add_(0, numbers, weights)
        seen[numbers] = True
    return sums, seen


def survivors(sums: Tensor, loss_db: float, errors: Errors) -> Tensor:
    """(N,) which primitives stay when as many as possible of those that contribute least go; at least one.

    Args:
        sums: (N,) contributions; N at least 1.
        loss_db: PSNR that may be lost, by each error alike [dB].
        errors: errors of the compared views.
    """
    order = sums.argsort()

    def without(gone: int) -> Tensor:
        kept = torch.ones(len(sums), dtype=torch.bool, device=sums.device)
        kept[order[:gone]] = False
        return kept

    limit = errors(without(0)) * 10.0 ** (loss_db / 10.0)
    gone = greatest(0, len(sums), lambda gone: bool((errors(without(gone)) <= limit).all()), trials=_TRIALS)
    return without(gone)


def greatest(
    low: int, high: int, allowed: Callable[[int], bool], *, step: int = 1, trials: int | None = None
) -> int:
    """The greatest number that is allowed, by bisection.

    Args:
        low: a number that is allowed.
        high: a number that is not.
        allowed: whether a number is; none above one that is not.
        step: how far the result may be from the greatest.
        trials: numbers that are tried, at most; None: as many as it takes.
    """
    while high - low > step and trials != 0:
        middle = (low + high) // 2
        low, high = (middle, high) if allowed(middle) else (low, middle)
        trials = None if trials is None else trials - 1
    return low
