"""Calling layer of the compiled shading kernel: float32 on the CPU, without gradients."""

from __future__ import annotations

import torch
from torch import Tensor

import econgs_bench.econgs._native as _native
import econgs_bench.econgs.splat.native  # noqa: F401  (chooses instruction set and threads)


def shade(
    means: Tensor, normals: Tensor, base: Tensor, coefficients: Tensor, eye: Tensor, light: Tensor | None
) -> Tensor:
    """Native part of :func:`.econgs.anchors.shading.shade`, without gradients."""
    colors = torch.empty_like(means)
    x, n, b, c = (one.detach().contiguous().numpy() for one in (means, normals, base, coefficients))
    _native.shade(x, n, b, c, eye.numpy(), None if light is None else light.numpy(), colors.numpy())
    return colors
