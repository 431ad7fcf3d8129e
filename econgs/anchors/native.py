"""Calling layer of the compiled decoder kernels: float32 on the CPU, torch tensors in, autograd works.

Results and gradients do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

import econgs_bench.econgs._native as _native
import econgs_bench.econgs.splat.native  # noqa: F401  (chooses instruction set and threads)
from econgs_bench.econgs.anchors.decoders import Decoders
from econgs_bench.econgs.anchors.gaussians import ViewGaussians
from econgs_bench.econgs.anchors.shading import Factors


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        directions: bool,
        sigmoid_color: bool,
        eye: Tensor,
        light: Tensor | None,
        factors: list[float],
        *tensors: Tensor,  # anchors, features, scalings, offsets, embedding, palette, weights
    ) -> tuple[Tensor, ...]:
        plain = [one.detach().contiguous() for one in tensors]
        anchors, *_ = plain
        many = plain[3].shape[1]
        x, f, s, o, embedding, palette, *weights = (one.numpy() for one in plain)
        keep = any(ctx.needs_input_grad)
        raw = anchors.new_empty((len(anchors), many))
        toward = None if light is None else light.numpy()
        frame = _native.decode_begin(
            x, f, s, o, weights, embedding, palette, eye.numpy(), toward, factors, directions, sigmoid_color,
            raw.numpy(), keep,
        )  # fmt: skip
        count = frame.gaussians
        shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, 3)]
        outputs = [anchors.new_empty(shape) for shape in shapes]
        slots = torch.empty(count, dtype=torch.int64)
        _native.decode_finish(frame, x, f, s, o, *(one.numpy() for one in (raw, *outputs, slots)))
        if keep:
            ctx.frame = frame
            ctx.save_for_backward(raw, *plain)
        ctx.mark_non_differentiable(slots, raw)
        ctx.set_materialize_grads(False)
        return (*outputs, slots, raw)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        raw, *plain = ctx.saved_tensors
        x, f, s, o, embedding, _, *weights = (one.numpy() for one in plain)
        means, quats, scales, opacities, colors = (
            None if one is None else one.contiguous().numpy() for one in grads[:5]
        )
        needs = ctx.needs_input_grad[5:]
        outputs = [torch.empty_like(one) for one in plain]
        to_x, to_f, to_s, to_o, to_embedding, to_palette, *to_weights = (one.numpy() for one in outputs)
        _native.decode_backward(
            ctx.frame, x, f, s, o, weights, embedding, raw.numpy(), means, quats, scales, opacities, colors,
            to_x if needs[0] else None, to_f, to_s, to_o, to_weights, to_embedding, to_palette,
        )  # fmt: skip
        return (None,) * 5 + tuple(one if need else None for one, need in zip(outputs, needs, strict=True))


def visible_anchors(
    pose: Tensor, near: float, middle: Sequence[float], anchors: Tensor, scalings: Tensor
) -> Tensor:
    """Native part of :func:`.econgs.anchors.decode.visible_anchors`.

    The pose is (3, 4), world to camera; ``middle`` is the shift of the image's middle along x and y, then
    half its size, all over the focal length.
    """
    shown = torch.empty(len(anchors), dtype=torch.uint8)
    numbers = np.array(middle, dtype=np.float32)
    arrays = (anchors.detach().contiguous().numpy(), scalings.detach().contiguous().numpy(), shown.numpy())
    _native.visible_anchors(pose.contiguous().numpy(), near, numbers, *arrays)
    return shown.view(torch.bool)


def record_view(statistics: Iterable[Tensor], view: Iterable[Tensor], size: tuple[int, int]) -> None:
    """Native part of :meth:`.econgs.anchors.growing.AnchorStatistics.record`: its fields, its arguments."""
    arrays = (one.numpy() for one in (*statistics, *(one.detach().contiguous() for one in view)))
    given: list[Any] = [*arrays, 0.5 * size[0], 0.5 * size[1]]
    _native.record_view(*given)


def decode(
    *inputs: Tensor, decoders: Decoders, eye: Tensor, light: Tensor | None, factors: Factors
) -> ViewGaussians:
    """Native part of :func:`.econgs.anchors.decode.decode`; inputs in the same order, without the decoders.

    Raises:
        ValueError: NaN or infinity among the inputs.
    """
    numbers = [factors.opacity, factors.ambient, factors.diffuse, factors.specular, factors.shininess]
    sigmoid = decoders.offset_color == "sigmoid"
    outputs: tuple[Tensor, ...] = _Decode.apply(
        decoders.view_direction, sigmoid, eye, light, numbers, *inputs, *decoders.tensors()
    )
    return ViewGaussians(*outputs)


def decode_plain(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], eye: Tensor, visible: bool
) -> ViewGaussians:
    """Native part of :func:`.econgs.anchors.direct.decode_colors`: networks, sigmoid colors, no shading.

    Args:
        inputs: anchors, features, scalings, offsets.
        weights: first weight and bias, second weight and bias of the three networks.
        eye: (3,) camera centre.
        visible: False culls every Gaussian.

    Raises:
        ValueError: NaN or infinity among the inputs.
    """
    none = (eye.new_zeros(0), eye.new_zeros(3))  # neither embedding nor palette
    factors = [float(visible), 1.0, 1.0, 1.0, 1.0]
    return ViewGaussians(*_Decode.apply(True, True, eye, None, factors, *inputs, *none, *weights))
