"""The photometric loss of the 3DGS lineage: (1 − w) · L1 + w · (1 − SSIM)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from econgs.splat.rasterise import choose_backend, native

WINDOW = 11  # taps of the Gaussian window of Wang et al. 2004
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def photometric_loss(
    rendered: Tensor, target: Tensor, ssim_weight: float = 0.2, *, backend: str | None = None
) -> Tensor:
    """Mean absolute error and structural dissimilarity of two images in [0, 1].

    Args:
        rendered: (H, W, C); the loss is differentiable with respect to it.
        target: (H, W, C), constant.
        ssim_weight: w in [0, 1].
        backend: as in :func:`econgs.splat.rasterise`.

    Raises:
        ValueError: the shapes differ, or are not those of images.
    """
    _check(rendered, target)
    if choose_backend(rendered, backend) == "native":
        value: Tensor = native().photometric_loss(rendered, target, ssim_weight)
        return value
    absolute = (rendered - target).abs().mean()
    if ssim_weight == 0:
        return absolute
    return (1 - ssim_weight) * absolute + ssim_weight * (1 - torch_ssim(rendered, target))


def ssim(rendered: Tensor, target: Tensor, *, backend: str | None = None) -> Tensor:
    """Mean SSIM over all pixels and channels: 11×11 Gaussian window, σ 1.5, zero padding.

    This is the training loss's SSIM; the metric of the tables leaves out the padded border. Arguments as in
    :func:`photometric_loss`.
    """
    _check(rendered, target)
    if choose_backend(rendered, backend) == "native":
        value: Tensor = native().ssim(rendered, target)
        return value
    return torch_ssim(rendered, target)


def torch_ssim(rendered: Tensor, target: Tensor) -> Tensor:
    """The same in plain PyTorch, for any dtype and device."""
    channels = rendered.shape[2]
    x, y = rendered.permute(2, 0, 1), target.permute(2, 0, 1)
    offset = torch.arange(WINDOW, dtype=x.dtype, device=x.device) - WINDOW // 2
    taps = torch.exp(-0.5 * (offset / SIGMA) ** 2)
    taps = (taps / taps.sum()).expand(5 * channels, 1, 1, WINDOW).contiguous()

    # The window is separable: rows, then columns, of all five moments at once.
    moments = torch.cat([x, y, x * x, y * y, x * y])[None]
    rows = functional.conv2d(moments, taps, padding=(0, WINDOW // 2), groups=5 * channels)
    columns = functional.conv2d(rows, taps.mT.contiguous(), padding=(WINDOW // 2, 0), groups=5 * channels)
    mean_x, mean_y, square_x, square_y, product = columns[0].split(channels)
    variance_x = square_x - mean_x * mean_x
    variance_y = square_y - mean_y * mean_y
    covariance = product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    structure = (2 * covariance + C2) / (variance_x + variance_y + C2)
    value: Tensor = (luminance * structure).mean()
    return value


def _check(rendered: Tensor, target: Tensor) -> None:
    if rendered.ndim != 3 or rendered.shape != target.shape or rendered.numel() == 0:
        raise ValueError(
            f"rendered has shape {tuple(rendered.shape)} and target {tuple(target.shape)}; "
            "both must be (height, width, channels) of one image size"
        )
