"""Calling layer of the compiled CPU kernels (``econgs._native``): torch tensors in, autograd works.

All tensors are float32 on the CPU. The kernels exist once per instruction set; the environment
variable ``ECONGS_ISA`` names one, by default the best one of the processor runs. ``ECONGS_THREADS`` sets
the number of threads (default: ``torch.get_num_threads()``). Results do not depend on that number.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import econgs_bench.econgs._native as _native
from econgs_bench.datasets.names import unknown
from econgs_bench.econgs.splat.low_pass import LowPass
from econgs_bench.econgs.splat.splats import Splats


def available_isas(*, testing: bool = False) -> list[str]:
    """Instruction sets that this processor and build can run, best first.

    Args:
        testing: also list variants that exist for tests only ("avx2x16": the 16-lane source of AVX-512
            compiled for AVX2, so that machines without AVX-512 test its logic).
    """
    return list(_native.available_isas(testing))


def isa() -> str:
    """The instruction set in use."""
    return str(_native.isa())


def set_isa(name: str) -> None:
    """Force an instruction set, for tests and comparisons.

    Raises:
        econgs_bench.datasets.errors.UnknownName: the build has no kernels of that name.
        RuntimeError: the processor lacks it.
    """
    built = list(_native.built_isas())
    if name not in built:
        raise unknown("instruction set", name, built, of="the native kernels")
    if name not in available_isas(testing=True):
        raise RuntimeError(f"this processor lacks {name}; it has {', '.join(available_isas())}")
    _native.set_isa(name)


def threads() -> int:
    """The number of threads in use."""
    return int(_native.threads())


def set_threads(count: int) -> None:
    """Set the number of threads, including the caller's.

    Raises:
        ValueError: fewer than 1 or more than 1024.
    """
    if not 1 <= count <= 1024:
        raise ValueError(f"{count} threads: 1 to 1024 are possible")
    _native.set_threads(count)


def _configure() -> None:
    name = os.environ.get("ECONGS_ISA")
    if name:
        set_isa(name)
    count = os.environ.get("ECONGS_THREADS")
    if count is not None and not count.strip().isdigit():
        raise ValueError(f"ECONGS_THREADS is {count!r}, not a number of threads")
    set_threads(int(count) if count is not None else torch.get_num_threads())


def _plain(tensor: Tensor) -> Tensor:
    """The tensor in the kernels' form: contiguous, without history."""
    return tensor.detach().contiguous()


def _array(tensor: Tensor | None) -> Any:
    """The memory of a plain tensor as a NumPy array: nanobind converts it far faster than a tensor."""
    return None if tensor is None else tensor.numpy()


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        screen_offset: Tensor | None,
        view: NDArray[np.float64],
        size: tuple[int, int],
        near: float,
        low_pass: LowPass,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        width, height = size
        channels = features.shape[1]
        inputs = [_plain(one) for one in (means, quats, scales, opacities, features)]
        offset = None if screen_offset is None else _plain(screen_offset)
        image = means.new_empty((height, width, channels))
        alpha = means.new_empty((height, width))
        depth = means.new_empty((height, width))
        radii = torch.empty(means.shape[0], dtype=torch.int32)
        keep = any(ctx.needs_input_grad[:6])
        outputs = (image, alpha, depth, radii)
        settings = (near, low_pass.variance, low_pass.compensated, low_pass.ray_power)
        arrays = (*map(_array, (*inputs, offset)), view, *settings, *map(_array, outputs), keep)
        frame = _native.forward(*arrays)
        ctx.frame = frame if keep else None
        ctx.inputs = inputs
        ctx.images = (image, alpha, depth)
        ctx.offset = offset
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        # ctx holds the outputs: returning the tensors themselves would make a reference cycle.
        return image.view_as(image), alpha.view_as(alpha), depth.view_as(depth), radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, grad_image: Tensor | None, grad_alpha: Tensor | None, grad_depth: Tensor | None, _: Any
    ) -> tuple[Tensor | None, ...]:
        if ctx.frame is None:
            raise RuntimeError("a frame's gradients can be asked for only once")
        grads = [torch.empty_like(one) for one in ctx.inputs]
        grad_offset = torch.empty_like(ctx.offset) if ctx.needs_input_grad[5] else None
        outer = [None if one is None else _plain(one) for one in (grad_image, grad_alpha, grad_depth)]
        arrays = map(_array, (*ctx.inputs, *ctx.images, *outer, *grads, grad_offset, ctx.offset))
        _native.backward(ctx.frame, *arrays)
        needs = ctx.needs_input_grad
        results = [grad if need else None for grad, need in zip(grads, needs[:5], strict=True)]
        return (*results, grad_offset, None, None, None, None)


def rasterise(splats: Splats) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features H×W×C, alpha H×W, depth H×W and radii N.

    Raises:
        ValueError: NaN or infinity, a zero quaternion, a negative scale or an opacity outside [0, 1].
    """
    means, quats, scales, opacities, features, camera, screen_offset, low_pass = splats
    pose = camera.world_to_camera[:3, :4].ravel()
    view = np.array([*pose.tolist(), camera.fx, camera.fy, camera.cx, camera.cy])
    size = (camera.width, camera.height)
    images: tuple[Tensor, Tensor, Tensor, Tensor] = _Rasterise.apply(
        means, quats, scales, opacities, features, screen_offset, view, size, camera.near, low_pass
    )
    return images


class _SphericalHarmonics(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, degree: int, means: Tensor, position: Tensor, coefficients: Tensor, rest: Tensor | None
    ) -> Tensor:
        inputs = [None if one is None else _plain(one) for one in (means, position, coefficients, rest)]
        colors = means.new_empty((means.shape[0], 3))
        _native.sh_forward(degree, *map(_array, (*inputs, colors)))
        ctx.degree = degree
        ctx.save_for_backward(*inputs, colors)
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *inputs, colors = ctx.saved_tensors
        means, _, coefficients, rest = inputs
        grad_means, grad_coefficients = torch.empty_like(means), torch.empty_like(coefficients)
        grad_rest = None if rest is None else torch.empty_like(rest)
        arrays = (*inputs, colors.detach(), _plain(grad), grad_means, grad_coefficients, grad_rest)
        _native.sh_backward(ctx.degree, *map(_array, arrays))
        grad_position = -grad_means.sum(0) if ctx.needs_input_grad[2] else None
        return None, grad_means, grad_position, grad_coefficients, grad_rest


def spherical_harmonics(
    degree: int, means: Tensor, camera_position: Tensor, coefficients: Tensor, rest: Tensor | None = None
) -> Tensor:
    """(N, 3) colors; arguments as in :func:`.econgs.splat.spherical_harmonics`."""
    colors: Tensor = _SphericalHarmonics.apply(degree, means, camera_position, coefficients, rest)
    return colors


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rendered: Tensor, target: Tensor, absolute: float, structural: float) -> Tensor:  # type: ignore[override]
        # The loss is a scalar: its gradient is computed here and only scaled in the backward pass.
        grad = rendered.new_empty(rendered.shape) if ctx.needs_input_grad[0] else None
        images = _array(_plain(rendered)), _array(_plain(target))
        mean_absolute, ssim = _native.photometric(*images, absolute, structural, _array(grad))
        ctx.grad = grad
        return rendered.new_tensor(absolute * mean_absolute + structural * ssim)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        factor = grad.item()  # 1 if the loss itself is minimised: saves a pass over the image
        return ctx.grad if factor == 1.0 else ctx.grad * factor, None, None, None


def photometric_loss(rendered: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 − w) · mean |rendered − target| + w · (1 − SSIM) of two (H, W, C) images, as a scalar."""
    loss: Tensor = _Photometric.apply(rendered, target, 1.0 - ssim_weight, -ssim_weight)
    return loss + ssim_weight


def ssim(rendered: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM of two (H, W, C) images: 11×11 window, σ 1.5, zero padding."""
    value: Tensor = _Photometric.apply(rendered, target, 0.0, 1.0)
    return value


class _ViewLoss(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, colors: Tensor, alpha: Tensor, truth: Tensor, back: Tensor, weights: tuple[float, ...]
    ) -> tuple[Tensor, Tensor]:
        # As above: gradients, those of the sum of both losses, are computed here.
        ctx.grads = None
        if any(ctx.needs_input_grad):
            ctx.grads = colors.new_empty(colors.shape), alpha.new_empty(alpha.shape)
        images = (_plain(colors), _plain(alpha), _plain(truth), _plain(back))
        structural, of_alpha, vanishing, rescue = weights
        numbers = (1.0 - structural, -structural, of_alpha, vanishing, rescue)
        arrays = (*map(_array, images), *numbers, *map(_array, ctx.grads or (None, None)))
        absolute, ssim, distance = _native.view_loss(*arrays)
        ctx.both = of_alpha > 0.0
        picture = (1.0 - structural) * absolute + structural * (1.0 - ssim)
        return colors.new_tensor(picture), alpha.new_tensor(distance)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, picture: Tensor, distance: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        factor = picture.item()
        if ctx.both and distance.item() != factor:
            raise RuntimeError("the two losses of a view have the gradient of their sum alone")
        colors, alpha = ctx.grads
        if factor != 1.0:
            colors, alpha = colors * factor, alpha * factor
        return colors, alpha, None, None, None


def view_losses(
    colors: Tensor, alpha: Tensor, truth: Tensor, back: Tensor, weights: tuple[float, ...]
) -> tuple[Tensor, Tensor]:
    """Native part of :func:`.econgs.losses.view_losses`, over a background (3,).

    The weights are those of SSIM and of alpha, the share of alpha under which the latter grows, and to what.
    """
    losses: tuple[Tensor, Tensor] = _ViewLoss.apply(colors, alpha, truth, back, weights)
    return losses


def adam_step(
    params: Sequence[Tensor],
    grads: Sequence[Tensor],
    m: Sequence[Tensor],
    v: Sequence[Tensor],
    lrs: Sequence[float],
    beta1: float,
    beta2: float,
    eps: float,
    step: int,
) -> None:
    """One step of Adam (Kingma and Ba 2015) on all tensors at once, in place.

    Elements with zero gradient and zero moments (spherical harmonics above the active degree) are read but
    not written.

    Args:
        params: tensors to update; contiguous, as are all others.
        grads: their gradients.
        m: first moments.
        v: second moments.
        lrs: one learning rate per tensor.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: guard of the division.
        step: count of steps including this one, ≥ 1.

    Raises:
        ValueError: lists or tensors of different sizes, or a parameter that is not contiguous.
    """
    values, first, second = ([_in_place(one) for one in column] for column in (params, m, v))
    plain = [_array(_plain(one)) for one in grads]
    _native.adam(values, plain, first, second, list(lrs), beta1, beta2, eps, step)


def _in_place(tensor: Tensor) -> Any:
    if not tensor.is_contiguous():
        raise ValueError("adam_step takes contiguous parameters and moments")
    return _array(tensor.detach())


def bench_blend(channels: int = 3) -> float:
    """Lane evaluations (pixel × Gaussian) per second of one thread's blend loop on L1-resident data."""
    return float(_native.bench_blend(channels))


def statistics(image: Tensor) -> dict[str, float]:
    """Seconds by stage, visible Gaussians, intersections with tiles and lane evaluations of a frame.

    Args:
        image: an output of :func:`rasterise` that has a gradient.
    """
    node: Any = image.grad_fn
    return dict(node.frame.statistics)


_configure()
