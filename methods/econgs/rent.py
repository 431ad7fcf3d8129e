"""Removal of anchors that hardly change the pictures: they pay no "rent"."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from datasets.camera import Camera
from econgs.anchors.gaussians import ViewGaussians
from econgs.splat import LowPass
from econgs.splat.splats import Splats
from econgs.splat.weights import blending_weights

VIEWS = 12
"""Training views that are asked, at most."""
_HALVINGS = 6

Decode = Callable[[Camera, Tensor], tuple[ViewGaussians, Tensor]]
"""(camera, kept anchors) -> the decoded Gaussians, and the anchor of each."""
Measure = Callable[[Sequence[int], Tensor], Tensor]
"""(views, kept anchors) -> (m,) mean squared errors, none of which may grow by more than is allowed."""


def some_views(count: int, most: int = VIEWS) -> list[int]:
    """At most so many of ``count`` views, evenly spread."""
    number = min(count, most)
    return [round(i * (count - 1) / max(number - 1, 1)) for i in range(number)]


def contributions(
    anchors: int, cameras: Sequence[Camera], decode: Decode, low_pass: LowPass, device: torch.device
) -> Tensor:
    """(N,) by how much each anchor's Gaussians weigh in the pixels of these views, summed.

    See :func:`econgs.splat.weights.blending_weights`.
    """
    weights = torch.zeros(anchors, device=device)
    every = torch.ones(anchors, dtype=torch.bool, device=device)
    for camera in cameras:
        with torch.no_grad():
            decoded, owner = decode(camera, every)
        if not len(owner):
            continue
        fields = (decoded.means, decoded.quats, decoded.scales, decoded.opacities, decoded.colors)
        splats = Splats(*fields, camera, low_pass=low_pass)
        weights.index_add_(0, owner, blending_weights(splats))
    return weights


def who_stays(weights: Tensor, allowance: float, views: Sequence[int], measure: Measure) -> Tensor:
    """(N,) which anchors stay: as many of the lightest go as the allowance lets go.

    Args:
        weights: (N,) of :func:`contributions`.
        allowance: dB of PSNR over the views together that may be lost, of each error alike.
        views: that are compared.
        measure: errors of those views.
    """
    order = weights.argsort()
    kept = torch.ones(len(weights), dtype=torch.bool, device=weights.device)
    limit = measure(views, kept) * 10.0 ** (allowance / 10.0)
    low, high = 0, len(weights) - 1  # at least one stays
    for _ in range(min(_HALVINGS, max(high, 1).bit_length())):
        middle = math.ceil((low + high) / 2)
        trial = kept.clone()
        trial[order[:middle]] = False
        if bool((measure(views, trial) <= limit).all()):
            low = middle
        else:
            high = middle - 1
        if low >= high:
            break
    kept[order[:low]] = False
    return kept
