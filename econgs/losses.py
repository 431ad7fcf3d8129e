"""Losses of pictures: that of the 3DGS lineage, (1 − w) · L1 + w · (1 − SSIM), and that of alpha."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from econgs_bench.datasets.scene import RGB
from econgs_bench.econgs.splat.composite import over
from econgs_bench.econgs.splat.rasterise import choose_backend, native

WINDOW = 11  # taps of the Gaussian window of Wang et al. 2004
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
VANISHING = 0.5
"""Share of a view's alpha under which the loss of alpha has the weight :data:`RESCUE`."""
RESCUE = 1.0


def photometric_loss(
    rendered: Tensor, target: Tensor, ssim_weight: float = 0.2, *, backend: str | None = None
) -> Tensor:
    """Mean absolute error and structural dissimilarity of two images in [0, 1].

    Args:
        rendered: (H, W, C); the loss is differentiable with respect to it.
        target: (H, W, C), constant.
        ssim_weight: w in [0, 1].
        backend: as in :func:`.econgs.splat.rasterise`.

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


def view_losses(
    colors: Tensor,
    alpha: Tensor,
    truth: Tensor,
    background: RGB | Tensor,
    *,
    ssim_weight: float = 0.2,
    alpha_weight: float = 0.0,
    backend: str | None = None,
) -> tuple[Tensor, Tensor]:
    """The losses of a drawn picture against a view: of colors over a background, and of alpha.

    The first is :func:`photometric_loss`. The second is the mean absolute error of alpha, times its weight:
    an object of the background's color looks right without alpha. It counts more while most is missing: a
    scene as pale as its background starts too dark, is dimmed for that, and once all opacities are negative
    no gradient brings it back.

    Args:
        colors: (H, W, 3) premultiplied.
        alpha: (H, W).
        truth: (H, W, 4) premultiplied, constant.
        background: color of the background.
        ssim_weight: in [0, 1].
        alpha_weight: at least 0. Above 0 it becomes :data:`RESCUE`, if that is more, while less than
            :data:`VANISHING` of the view's alpha is drawn.
        backend: as in :func:`.econgs.splat.rasterise`.

    Returns:
        Two scalars; only their sum, or a multiple of it, may be differentiated where alpha has a weight.

    Raises:
        ValueError: the shapes differ, or are not those of images.
    """
    if truth.ndim != 3 or truth.shape[2] != 4 or alpha.shape != truth.shape[:2]:
        raise ValueError(
            f"alpha has shape {tuple(alpha.shape)} and the view {tuple(truth.shape)}; (height, width) and "
            "(height, width, 4) are needed"
        )
    _check(colors, truth[..., :3])
    back = torch.as_tensor(background, dtype=colors.dtype, device=colors.device)
    if choose_backend(colors, backend) == "native":
        weights = ssim_weight, alpha_weight, VANISHING, RESCUE
        pair: tuple[Tensor, Tensor] = native().view_losses(colors, alpha, truth, back, weights)
        return pair
    target = over(truth[..., :3], truth[..., 3], back)
    picture = photometric_loss(over(colors, alpha, back), target, ssim_weight, backend=backend)
    distance = (alpha - truth[..., 3]).abs().mean()
    if 0.0 < alpha_weight < RESCUE:  # no branch on a value: on a GPU the host would wait for it
        vanishes = alpha.detach().sum() < VANISHING * truth[..., 3].sum()
        return picture, torch.where(vanishes, RESCUE, alpha_weight) * distance
    return picture, alpha_weight * distance


def ssim(rendered: Tensor, target: Tensor, *, backend: str | None = None) -> Tensor:
    """Mean SSIM over all pixels and channels: 11×11 Gaussian window, σ 1.5, zero padding.

    This is the SSIM of the training loss; the metric of the tables excludes the padded border. Arguments as
    in :func:`photometric_loss`.
    """
    _check(rendered, target)
    if choose_backend(rendered, backend) == "native":
        value: Tensor = native().ssim(rendered, target)
        return value
    return torch_ssim(rendered, target)


def torch_ssim(rendered: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM in plain PyTorch, for any dtype and device.

    The formula uses sums and differences, s = x + y and d = x − y, so that nothing large cancels in flat,
    similar regions, which fill most of a volume rendering:
    SSIM = (1 − d̄² / ((s̄² + d̄²) / 2 + C₁)) · (1 − V[d] / ((V[s] + V[d]) / 2 + C₂)).
    """
    height, width, channels = rendered.shape
    taps, inside, outside = _window(height, width, rendered.dtype, rendered.device)
    # Sums are centred at 1 (their variance does not mind).
    x, y = rendered.permute(2, 0, 1), target.permute(2, 0, 1)
    total, difference = x + y - 1, x - y
    moments = torch.cat([total, difference, total * total, difference * difference])[None]
    mean, mean_d, square, square_d = _blur(moments, taps)[0].split(channels)
    variance = square - mean * mean + outside * (2 * mean + inside)
    variance_d = square_d - mean_d * mean_d
    mean = mean + inside
    luminance = 1 - mean_d * mean_d / (0.5 * (mean * mean + mean_d * mean_d) + C1)
    structure = 1 - variance_d / (0.5 * (variance + variance_d) + C2)
    value: Tensor = (luminance * structure).mean()
    return value


@lru_cache(maxsize=8)  # once for a size of picture: a GPU would wait for the host at every step
@torch.inference_mode(False)
def _window(
    height: int, width: int, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """The taps (1, 1, 1, 11), and the window's share inside the picture and on the padding (H, W)."""
    offset = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    taps = torch.exp(-0.5 * (offset / SIGMA) ** 2)
    taps = (taps / taps.sum()).reshape(1, 1, WINDOW)
    across, down = (
        functional.conv1d(torch.ones(1, 1, length, dtype=torch.float64), taps, padding=WINDOW // 2)[0, 0]
        for length in (width, height)
    )
    covered = down[:, None] * across
    window = taps[None], covered, 1 - covered
    taps, inside, outside = (one.to(device, dtype) for one in window)
    return taps, inside, outside


def _blur(images: Tensor, taps: Tensor) -> Tensor:
    """The separable window over each of the (1, M, H, W) images, zero-padded."""
    many = images.shape[1]
    across = taps.expand(many, 1, 1, WINDOW).contiguous()
    rows = functional.conv2d(images, across, padding=(0, WINDOW // 2), groups=many)
    return functional.conv2d(rows, across.mT.contiguous(), padding=(WINDOW // 2, 0), groups=many)


def _check(rendered: Tensor, target: Tensor) -> None:
    if rendered.ndim != 3 or rendered.shape != target.shape or rendered.numel() == 0:
        raise ValueError(
            f"rendered has shape {tuple(rendered.shape)} and target {tuple(target.shape)}; "
            "both must be (height, width, channels) of one image size"
        )
