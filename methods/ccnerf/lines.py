"""Sums of products of lines: a field is Σ over ranks of x[r] · y[r] · z[r], each interpolated along its axis.

The product of linear interpolations is the trilinear interpolation of the product, so such a field is that of
the dense grid that its lines span (CP decomposition; Chen et al. 2022, TensoRF).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from econgs_bench.econgs.codec.hash_grid import compiled, native

Lines = tuple[Tensor, Tensor, Tensor]
"""(size, ranks) along x, y and z; the first row lies at place 0, the last one at place 1."""
_UNIT = 16  # the compiled kernels take ranks of a group in multiples of it


class _Products(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        x: Tensor,
        y: Tensor,
        z: Tensor,
        mixing: Tensor | None,
        places: Tensor,
        rays: Tensor,
        groups: int,
    ) -> Tensor:
        lines = [one.detach().contiguous() for one in (x, y, z)]
        mixed = None if mixing is None else mixing.detach().contiguous()
        out = x.new_empty((len(places), groups, 1 if mixed is None else 3))
        given = _arrays(*lines), groups, _array(mixed), places.numpy(), rays.numpy()
        native().line_products(*given[0], *given[1:], out.numpy())
        ctx.groups = groups
        ctx.save_for_backward(*lines, mixed, places, rays)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        *lines, mixed, places, rays = ctx.saved_tensors
        to = [torch.zeros_like(one) for one in lines]
        to_mixing = None if mixed is None else torch.zeros_like(mixed)
        native().line_products_backward(
            *_arrays(*lines), ctx.groups, _array(mixed), places.numpy(), rays.numpy(),
            grad.contiguous().numpy(), *_arrays(*to), _array(to_mixing),
        )  # fmt: skip
        return (*to, to_mixing, None, None, None)


def line_products(
    lines: Lines, places: Tensor, groups: int = 1, mixing: Tensor | None = None, rays: Tensor | None = None
) -> Tensor:
    """Products of interpolated lines, summed within each group of consecutive ranks.

    Differentiable with respect to lines and mixing.

    Args:
        lines: of at least 2 rows; their ranks split evenly into groups.
        places: (N, 3) in [0, 1].
        groups: number of groups.
        mixing: (B, 3, ranks), three weights of every rank for each ray; without it all weigh 1.
        rays: (N,) int32, the ray of each place, where there is mixing.

    Returns:
        (N, groups, 3), without mixing (N, groups, 1).
    """
    if not compiled(lines[0]):
        return _torch_products(lines, places, groups, mixing, rays)
    ranks = lines[0].shape[1] // groups
    if short := -ranks % _UNIT:
        x, y, z = (_padded(one, groups, short) for one in lines)
        lines = x, y, z
        mixing = None if mixing is None else _padded(mixing, groups, short)
    of = torch.empty(0, dtype=torch.int32) if rays is None else rays
    out: Tensor = _Products.apply(*lines, mixing, places, of, groups)
    return out


def dense(lines: Lines) -> Tensor:
    """(z, y, x) sums of products at all rows of the lines."""
    x, y, z = lines
    pairs = (z[:, None] * y[None]).reshape(-1, z.shape[1])
    return (pairs @ x.T).reshape(len(z), len(y), len(x))


def resampled(line: Tensor, size: int) -> Tensor:
    """(size, ranks): a line interpolated at other, evenly spaced places, of which the ends are the same."""
    moved = functional.interpolate(line.T[None], size=size, mode="linear", align_corners=True)
    return moved[0].T.contiguous()


def _padded(values: Tensor, groups: int, more: int) -> Tensor:
    """Values (…, ranks) with zeros behind each group."""
    shape = values.shape[:-1]
    return functional.pad(values.reshape(*shape, groups, -1), (0, more)).reshape(*shape, -1)


def _torch_products(
    lines: Lines, places: Tensor, groups: int, mixing: Tensor | None, rays: Tensor | None
) -> Tensor:
    values = torch.ones((), dtype=places.dtype, device=places.device)
    for axis, line in enumerate(lines):
        at = places[:, axis] * (len(line) - 1)
        cell = at.long().clamp(0, len(line) - 2)
        values = values * torch.lerp(line[cell], line[cell + 1], (at - cell)[:, None].to(line))
    if mixing is None or rays is None:
        return values.reshape(len(places), groups, -1).sum(-1, keepdim=True)
    mixed = values[:, None] * mixing[rays.long()]
    return mixed.reshape(len(places), 3, groups, -1).sum(-1).transpose(1, 2)


def _array(tensor: Tensor | None) -> Any:
    return None if tensor is None else tensor.numpy()


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    return tuple(one.numpy() for one in tensors)
