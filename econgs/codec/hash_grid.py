"""Binary hash grids: the context of an anchor by its position (BiRF, Shin and Park 2023; HAC).

Entries are ±1, the signs of trained parameters. Interpolation weights are products of fractions of 7 bits, so
that every interpolated value is a multiple of 2⁻²¹ in [−1, 1], which float32 holds exactly: the order of the
sum, the number of threads and the device cannot change a bit of it, and the entropy coder may rely on it.
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn

FRACTION_BITS = 7
VALUE_BITS = 3 * FRACTION_BITS  # interpolated values are multiples of 2^-VALUE_BITS
MOST_BITS = 1 << 25
_PRIMES = (1, 2654435761, 805459861)  # spatial hash of Müller et al. 2022 (instant NGP), equation 4
_PLANES = ((0, 1), (1, 2), (2, 0))


@dataclass(frozen=True)
class GridConfig:
    """Levels of a context grid.

    Attributes:
        volume: vertices per axis of each 3-D level, ascending.
        planes: vertices per axis of each level of the three planes xy, yz and zx.
        volume_log2: binary logarithm of a 3-D level's maximum number of entries; larger levels are hashed.
        planes_log2: the same for the level of a plane.
        features: values per entry.
    """

    volume: tuple[int, ...]
    planes: tuple[int, ...]
    volume_log2: int
    planes_log2: int
    features: int = 4

    def __post_init__(self) -> None:
        levels = (*self.volume, *self.planes)
        if not levels or not all(2 <= one <= 4096 for one in levels) or len(levels) > 32:
            raise ValueError(f"levels of 2 to 4096 vertices, 1 to 32 of them, are possible, not {levels}")
        if not (1 <= self.volume_log2 <= 19 and 1 <= self.planes_log2 <= 19 and 1 <= self.features <= 8):
            raise ValueError("tables of at most 2^19 entries of 1 to 8 features are possible")
        if self.bits > MOST_BITS:
            raise ValueError(f"a grid of {self.bits} bits; at most {MOST_BITS} are possible")

    @property
    def levels(self) -> list[tuple[tuple[int, ...], int, int]]:
        """Axes, vertices per axis and entries of each level, in order."""
        each: list[tuple[tuple[int, ...], int]] = [((0, 1, 2), one) for one in self.volume]
        each += [(axes, one) for axes in _PLANES for one in self.planes]
        most = {3: 1 << self.volume_log2, 2: 1 << self.planes_log2}
        return [(axes, size, min(size ** len(axes), most[len(axes)])) for axes, size in each]

    @property
    def entries(self) -> int:
        """Entries of all levels."""
        return sum(entries for _, _, entries in self.levels)

    @property
    def outputs(self) -> int:
        """Number of values per position."""
        return len(self.levels) * self.features

    @property
    def bits(self) -> int:
        """Bits of the grid before entropy coding."""
        return self.entries * self.features


HAC_GRID = GridConfig(
    volume=(18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514),
    planes=(130, 258, 514, 1026),
    volume_log2=13,
    planes_log2=15,
)
"""The training default of HAC: 96 values, 0.211 MiB of bits."""

SMALL_GRID = GridConfig(
    volume=(16, 24, 36, 53, 79, 117, 173, 256), planes=(64, 128), volume_log2=13, planes_log2=14
)
"""56 values, 0.06 MiB of bits: the room in the published sizes."""

GRIDS = {"small": SMALL_GRID, "hac": HAC_GRID}
"""Grids by their names in options."""


@dataclass(frozen=True)
class Lookup:
    """Vertices and weights of N fixed positions in a grid, computed once for all iterations.

    Attributes:
        index: (V, N) int32, entry of each of the V vertices around a position, over all levels.
        weights: (V, N) float32, multiples of 2⁻²¹ that sum to 1 over a level.
        config: sizes of the grid.
    """

    index: Tensor
    weights: Tensor
    config: GridConfig

    def __len__(self) -> int:
        return self.index.shape[1]


@torch.no_grad()
def make_lookup(config: GridConfig, codes: Tensor, extent: Sequence[int]) -> Lookup:
    """Vertices and weights of positions, in integer arithmetic.

    Args:
        config: the grid.
        codes: (N, 3) integers, 0 ≤ codes ≤ extent.
        extent: largest code per axis, 1 to 65535; the grid spans [0, extent].
    """
    one = 1 << FRACTION_BITS
    spans = torch.tensor([int(span) for span in extent], device=codes.device)
    scaled = codes.to(torch.int64)
    # Vertices on both sides of a position and their weights, once per resolution and axis.
    sides: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
    for size in {*config.volume, *config.planes}:
        places = scaled * (size - 1)
        cells = torch.minimum(
            torch.div(places, spans, rounding_mode="floor"), torch.tensor(size - 2, device=codes.device)
        )
        rest = places - cells * spans
        fraction = torch.div(2 * one * rest + spans, 2 * spans, rounding_mode="floor")
        vertices = torch.stack([cells, cells + 1])
        weights = torch.stack([one - fraction, fraction]).to(torch.float32) / one
        for axis in range(3):
            sides[size, axis] = vertices[:, :, axis], weights[:, :, axis]
    count = len(codes)
    width = sum(2 ** len(axes) for axes, _, _ in config.levels)
    index = torch.empty((width, count), dtype=torch.int32, device=codes.device)
    weight = torch.empty((width, count), device=codes.device)
    first = row = 0
    for axes, size, entries in config.levels:
        dense = size ** len(axes) <= entries
        parts, factors = [], []
        for i, axis in enumerate(axes):
            vertices, weights = sides[size, axis]
            # A hashed table has a power of two entries: the masks of the factors do for their sum.
            part = vertices * size**i if dense else vertices * _PRIMES[i] & (entries - 1)
            parts.append(part.to(torch.int32))
            factors.append(weights)
        for corner in product((0, 1), repeat=len(axes)):
            place, share = parts[0][corner[0]], factors[0][corner[0]]
            for part, factor, bit in zip(parts[1:], factors[1:], corner[1:], strict=True):
                place = place + part[bit] if dense else place ^ part[bit]
                share = share * factor[bit]
            torch.add(place, first, out=index[row])
            weight[row] = share
            row += 1
        first += entries
    return Lookup(index, weight, config)


class _Sign(torch.autograd.Function):
    """Signs ±1 (zero counts as positive) with the straight-through gradient where |p| ≤ 1."""

    @staticmethod
    def forward(ctx: Any, parameters: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(parameters)
        return torch.where(parameters >= 0.0, 1.0, -1.0).to(parameters.dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        (parameters,) = ctx.saved_tensors
        return torch.where(parameters.abs() <= 1.0, grad, 0.0)


binarise = _Sign.apply


class _NativeLookup(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, table: Tensor, lookup: Lookup, rows: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        plain = table.detach().contiguous()
        levels = lookup.config.levels
        sizes = [entries for _, _, entries in levels]
        out = plain.new_empty((len(lookup) if rows is None else len(rows), lookup.config.outputs))
        row_indices = None if rows is None else rows.contiguous().numpy()
        corners = [2 ** len(axes) for axes, _, _ in levels]
        arguments = (plain.numpy(), lookup.index.numpy(), lookup.weights.numpy(), row_indices, corners, sizes)
        positive = native().hash_grid(*arguments, out.numpy())
        bits, ctx.slopes = _entropy(positive, [4 * one for one in sizes])
        ctx.arguments, ctx.shape = arguments, plain.shape
        return out, plain.new_tensor(bits)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor, grad_bits: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        out = grad.new_empty(ctx.shape)
        constant = [one * grad_bits.item() for one in ctx.slopes]
        native().hash_grid_backward(*ctx.arguments, grad.contiguous().numpy(), constant, out.numpy())
        return out, None, None


def _entropy(positive: Sequence[int], counts: Sequence[int]) -> tuple[float, list[float]]:
    """Bits of levels coded at their share of +1, and their derivative by a value (of ±1)."""
    bits, slopes = 0.0, []
    for ones, count in zip(positive, counts, strict=True):
        share = min(max(ones / count, 1e-6), 1.0 - 1e-6)
        bits -= count * (share * math.log2(share) + (1.0 - share) * math.log2(1.0 - share))
        slopes.append(0.5 * math.log2((1.0 - share) / share))
    return bits, slopes


class _CodedBits(torch.autograd.Function):
    """The bits alone; straight-through gradients where |p| ≤ 1."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, sizes: list[int]) -> Tensor:  # type: ignore[override]
        parts = table.split(sizes)
        positive = torch.stack([(one >= 0.0).sum() for one in parts]).tolist()
        bits, ctx.slopes = _entropy(positive, [one.numel() for one in parts])
        ctx.sizes = sizes
        ctx.save_for_backward(table)
        return table.new_tensor(bits)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (table,) = ctx.saved_tensors
        inside = (table.abs() <= 1.0).to(table.dtype)
        parts = inside.split(ctx.sizes)
        return torch.cat([part * (one * grad) for part, one in zip(parts, ctx.slopes, strict=True)]), None


def compiled(like: Tensor) -> bool:
    """Whether the compiled kernels take this tensor. ``ECONGS_BACKEND=torch`` forbids them."""
    fits = like.device.type == "cpu" and like.dtype == torch.float32
    return fits and os.environ.get("ECONGS_BACKEND") != "torch" and _built()


@cache
def _built() -> bool:
    return importlib.util.find_spec("econgs_bench.econgs._native") is not None


def native() -> Any:
    """The compiled module, after the choice of threads and instruction set."""
    import econgs_bench.econgs.splat.native  # noqa: F401  (chooses the number of threads)
    from econgs_bench.econgs import _native

    return _native


def interpolate(table: Tensor, lookup: Lookup, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Values of ±1 (the signs of ``table``, entries × features) at positions, and the table's bits.

    See :meth:`HashGrid.forward`.
    """
    config = lookup.config
    if table.shape != (config.entries, config.features):
        raise ValueError("the lookup was made for another grid")
    if compiled(table) and config.features == 4:
        values_and_bits: tuple[Tensor, Tensor] = _NativeLookup.apply(table, lookup, rows)
        return values_and_bits
    index, weights = lookup.index, lookup.weights
    if rows is not None:
        index, weights = index[:, rows], weights[:, rows]
    values = binarise(table)[index.long()] * weights[..., None]
    split, count = 8 * len(config.volume), index.shape[1]
    parts = [
        part.unflatten(0, (part.shape[0] // corners, corners)).sum(1).transpose(0, 1)
        for part, corners in ((values[:split], 8), (values[split:], 4))
    ]
    bits: Tensor = _CodedBits.apply(table, [entries for _, _, entries in config.levels])
    return torch.cat(parts, 1).reshape(count, config.outputs), bits


class HashGrid(nn.Module):
    """A trained binary hash grid.

    Attributes:
        table: (entries, features), drawn from U(±1e-4); only the signs count.
    """

    def __init__(self, config: GridConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        start = torch.empty((config.entries, config.features)).uniform_(-1e-4, 1e-4, generator=generator)
        self.table = nn.Parameter(start)

    def lookup(self, codes: Tensor, extent: Sequence[int]) -> Lookup:
        """:func:`make_lookup` with this grid."""
        return make_lookup(self.config, codes, extent)

    def forward(self, lookup: Lookup, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Interpolated values of ±1, and the bits of the grid.

        Args:
            lookup: lookup of N positions.
            rows: (M,) int64 indices of positions; default: all, in order.

        Returns:
            (M, outputs), multiples of 2⁻²¹ in [−1, 1]: level after level, ``features`` values each;
            and the bits of the grid coded at the measured share of +1 per level, a scalar (L_hash).
        """
        return interpolate(self.table, lookup, rows)
