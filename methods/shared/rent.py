"""Pruning by contribution: primitives that hardly change the pictures pay no "rent" and go.

Common equipment of the methods that splat Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
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
"""Training views of a scene that are asked, at most."""
COMPARED = 3
"""The errors of every so many of them are compared."""
_HALVINGS = 6

Frame = Callable[[Camera, Tensor], tuple[Gaussians, Tensor]]
"""(camera, (N,) kept primitives) -> the Gaussians of these in a view, and the primitive of each."""
Measure = Callable[[Tensor], Tensor]
"""(N,) kept primitives -> (m,) mean squared errors, none of which may grow by more than is allowed."""


@dataclass(frozen=True)
class Scene:
    """A scene whose training views say what a primitive is worth.

    Attributes:
        views: cameras and background.
        images: (views, H, W, 4) of them, premultiplied.
        frame: draws the scene.
        asks_alpha: whether the error of alpha is looked at too.
    """

    views: ViewSet
    images: Tensor
    frame: Frame
    asks_alpha: bool

    @property
    def sample(self) -> list[int]:
        """Numbers of the views that are asked."""
        return some_views(len(self.views))

    def errors(self, kept: Tensor, low_pass: LowPass) -> Iterator[Tensor]:
        """Mean squared errors of each view that is compared: (1,) of colors, (2,) with alpha."""
        for view in self.sample[::COMPARED]:
            camera, background = self.views.cameras[view], self.views.background
            splats = draw([self.frame(camera, kept)[0]], camera, low_pass=low_pass)
            truth = self.images[view].to(kept.device)
            target = over(truth[..., :3], truth[..., 3], background)
            apart = [over(splats.features, splats.alpha, background) - target]
            if self.asks_alpha:
                apart.append(splats.alpha - truth[..., 3])
            yield torch.stack([one.square().mean() for one in apart])


@dataclass(frozen=True)
class Holding:
    """Primitives of a fit, and the scenes that say what each is worth.

    Attributes:
        count: number of the primitives.
        scenes: which share them.
        keep: removes all others; takes (N,) which stay.
    """

    count: int
    scenes: Sequence[Scene]
    keep: Callable[[Tensor], None]


def some_views(count: int, most: int = VIEWS) -> list[int]:
    """At most so many of ``count`` views, evenly spread."""
    number = min(count, most)
    return [round(i * (count - 1) / max(number - 1, 1)) for i in range(number)]


@torch.no_grad()
def worth_keeping(
    count: int, scenes: Sequence[Scene], allowance: float, low_pass: LowPass, device: torch.device | str
) -> Tensor:
    """(N,) which primitives stay.

    Args:
        count: N, of all scenes, which share the primitives.
        scenes: what they show.
        allowance: dB of PSNR that may be lost with those that go.
        low_pass: filter of the projected Gaussians.
        device: of the primitives.
    """
    every = torch.ones(count, dtype=torch.bool, device=device)
    if count == 0:
        return every
    weights = torch.zeros(count, device=device)
    for scene in scenes:
        for view in scene.sample:
            camera = scene.views.cameras[view]
            gaussians, owner = scene.frame(camera, every)
            if len(owner):
                weights.index_add_(0, owner, _weights(gaussians, camera, low_pass))

    def measure(kept: Tensor) -> Tensor:
        # Scenes are means of their own: some may ask for alpha and others not.
        each = [torch.stack(list(scene.errors(kept, low_pass))).mean(dim=0) for scene in scenes]
        return torch.cat(each).cpu()

    return who_stays(weights, allowance, measure)


def _weights(gaussians: Gaussians, camera: Camera, low_pass: LowPass) -> Tensor:
    """(M,) by how much Gaussians weigh in the pixels of a view (:func:`blending_weights`)."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    return blending_weights(Splats(*fields, camera, low_pass=low_pass))


def who_stays(weights: Tensor, allowance: float, measure: Measure) -> Tensor:
    """(N,) which primitives stay: as many of the lightest go as the allowance lets go.

    Args:
        weights: (N,) in the pixels of some views; N at least 1.
        allowance: dB of PSNR that may be lost, of each error alike.
        measure: errors of the views that are compared.
    """
    order = weights.argsort()
    kept = torch.ones(len(weights), dtype=torch.bool, device=weights.device)
    limit = measure(kept) * 10.0 ** (allowance / 10.0)
    low, high = 0, len(weights) - 1  # at least one stays
    for _ in range(min(_HALVINGS, max(high, 1).bit_length())):
        middle = math.ceil((low + high) / 2)
        trial = kept.clone()
        trial[order[:middle]] = False
        if bool((measure(trial) <= limit).all()):
            low = middle
        else:
            high = middle - 1
        if low >= high:
            break
    kept[order[:low]] = False
    return kept
