"""Calling layer of the compiled decoder kernels: float32 on the CPU, torch tensors in, autograd works.

Results and gradients do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import econgs._native as _native
import econgs.splat.native  # noqa: F401  (chooses instruction set and threads)
from econgs.anchors.decoders import Decoders
from econgs.anchors.gaussians import ViewGaussians
from econgs.anchors.shading import Factors

INPUTS = 6  # tensors before the weights: anchors, features, scalings, offsets, embedding, palette


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        directions: bool,
        sigmoid_color: bool,
        eye: Tensor,
        light: Tensor | None,
        factors: list[float],
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        plain = [one.detach().contiguous() for one in tensors]
        anchors, *_ = plain
        many = plain[3].shape[1]
        arrays = [one.numpy() for one in plain]
        keep = any(ctx.needs_input_grad)
        raw = anchors.new_empty((len(anchors), many))
        weights, embedding, palette = arrays[INPUTS:], arrays[4], arrays[5]
        toward = None if light is None else light.numpy()
        frame = _native.decode_begin(
            *arrays[:4], weights, embedding, palette, eye.numpy(), toward, factors, directions, sigmoid_color,
            raw.numpy(), keep,
        )  # fmt: skip
        count = frame.gaussians
        shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, 3)]
        outputs = [anchors.new_empty(shape) for shape in shapes]
        slots = torch.empty(count, dtype=torch.int64)
        _native.decode_finish(
            frame, *arrays[:4], raw.numpy(), *(one.numpy() for one in outputs), slots.numpy()
        )
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
        arrays = [one.numpy() for one in plain]
        outer = [None if one is None else one.contiguous().numpy() for one in grads[:5]]
        needed = ctx.needs_input_grad[5:]
        made = [torch.empty_like(one) for one in plain]
        to = [one.numpy() for one in made]
        _native.decode_backward(
            ctx.frame, *arrays[:4], arrays[INPUTS:], arrays[4], raw.numpy(), *outer,
            to[0] if needed[0] else None, *to[1:4], to[INPUTS:], to[4], to[5],
        )  # fmt: skip
        kept = [one if need else None for one, need in zip(made, needed, strict=True)]
        return (None,) * 5 + tuple(kept)


def decode(
    *inputs: Tensor, decoders: Decoders, eye: Tensor, light: Tensor | None, factors: Factors
) -> ViewGaussians:
    """What :func:`econgs.anchors.decode.decode` does; inputs as there, in its order, without the decoders.

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
    inputs: Sequence[Tensor], weights: Sequence[Tensor], eye: Tensor, shown: bool
) -> ViewGaussians:
    """What :func:`econgs.anchors.direct.decode_colors` does: three networks, sigmoid colors, no shading.

    Args:
        inputs: anchors, features, scalings, offsets.
        weights: first weight and bias, second weight and bias of the three networks.
        eye: (3,) camera centre.
        shown: False: everything is culled.

    Raises:
        ValueError: NaN or infinity among the inputs.
    """
    none = (eye.new_zeros(0), eye.new_zeros(3))  # neither embedding nor palette
    factors = [float(shown), 1.0, 1.0, 1.0, 1.0]
    return ViewGaussians(*_Decode.apply(True, True, eye, None, factors, *inputs, *none, *weights))
