"""Binary hash grids: the context of an anchor is looked up at its position (BiRF, Shin and Park 2023; HAC).

Entries are ±1, the signs of trained parameters. Interpolation weights are products of fractions of 7 bits, so that
every interpolated value is a multiple of 2⁻²¹ in [−1, 1], which float32 holds exactly: the order of the sum, the
number of threads and the device cannot change a bit of it, and the entropy coder may rely on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn

from econgs.splat.rasterise import choose_backend

FRACTION_BITS = 7
VALUE_BITS = 3 * FRACTION_BITS  # interpolated values are multiples of 2^-VALUE_BITS
_PRIMES = (1, 2654435761, 805459861)  # spatial hash of Müller et al. 2022 (instant NGP), equation 4
_PLANES = ((0, 1), (1, 2), (2, 0))


@dataclass(frozen=True)
class GridConfig:
    """Levels of a context grid.

    Attributes:
        volume: vertices per axis of each 3-D level, ascending.
        planes: vertices per axis of each level of the three planes xy, yz and zx.
        volume_log2: logarithm of the number of entries that a 3-D level has at most; larger levels are hashed.
        planes_log2: the same of a plane's level.
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

    @property
    def levels(self) -> list[tuple[tuple[int, ...], int, int]]:
        """Of each level in order: its axes, vertices per axis and entries."""
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
        """Values looked up for a position."""
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
"""56 values, 0.06 MiB of bits: what the published sizes leave room for."""


@dataclass(frozen=True)
class Lookup:
    """Where N fixed positions fall in a grid: computed once, used in every iteration.

    Attributes:
        index: (N, V) int32, entry of each of the V vertices around a position, over all levels.
        weights: (N, V) float32, multiples of 2⁻²¹; those of a level sum to 1.
        config: the grid it was made for.
    """

    index: Tensor
    weights: Tensor
    config: GridConfig

    def __len__(self) -> int:
        return len(self.index)


@torch.no_grad()
def make_lookup(config: GridConfig, codes: Tensor, extent: Sequence[int]) -> Lookup:
    """Vertices and weights of positions, in integer arithmetic.

    Args:
        config: the grid.
        codes: (N, 3) integers, 0 ≤ codes ≤ extent.
        extent: largest code per axis, 1 to 65535; the grid spans [0, extent].
    """
    codes = codes.to(torch.int64)
    one = 1 << FRACTION_BITS
    indices, weights = [], []
    first = 0
    for axes, size, entries in config.levels:
        cells, fractions = [], []
        for axis in axes:
            scaled = codes[:, axis] * (size - 1)
            span = int(extent[axis])
            cell = torch.div(scaled, span, rounding_mode="floor").clamp_(max=size - 2)
            rest = scaled - cell * span
            fractions.append(torch.div(rest * one * 2 + span, 2 * span, rounding_mode="floor"))
            cells.append(cell)
        dense = size ** len(axes) <= entries
        for corner in product((0, 1), repeat=len(axes)):
            place = torch.zeros_like(cells[0])
            weight = torch.ones_like(place)
            for i, (cell, fraction, bit) in enumerate(zip(cells, fractions, corner, strict=True)):
                place = place + (cell + bit) * size**i if dense else place ^ ((cell + bit) * _PRIMES[i])
                weight = weight * (fraction if bit else one - fraction)
            # A hashed table has a power of two entries.
            indices.append((place if dense else place & (entries - 1)).add_(first).to(torch.int32))
            weights.append(weight.to(torch.float32) / float(one ** len(axes)))
        first += entries
    return Lookup(torch.stack(indices, 1), torch.stack(weights, 1), config)


def signs(parameters: Tensor) -> Tensor:
    """±1: what is stored of the parameters; zero counts as positive."""
    return torch.where(parameters >= 0.0, 1.0, -1.0).to(parameters.dtype)


class _Sign(torch.autograd.Function):
    """Sign with the straight-through gradient where |p| ≤ 1."""

    @staticmethod
    def forward(ctx: Any, parameters: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(parameters)
        return signs(parameters)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        (parameters,) = ctx.saved_tensors
        return torch.where(parameters.abs() <= 1.0, grad, 0.0)


binarise = _Sign.apply


class _NativeLookup(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        parameters: Tensor,
        lookup: Lookup,
        rows: Tensor | None,
        corners: list[int],
        sizes: list[int],
    ) -> Tensor:
        import econgs._native as _native

        plain = parameters.detach().contiguous()
        count = len(lookup) if rows is None else len(rows)
        out = plain.new_empty((count, 4 * len(corners)))
        taken = None if rows is None else rows.contiguous()
        arrays = (lookup.index.numpy(), lookup.weights.numpy(), None if taken is None else taken.numpy())
        _native.hash_grid(plain.numpy(), *arrays, corners, sizes, out.numpy())
        ctx.kept = (plain, arrays, corners, sizes)
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        import econgs._native as _native

        plain, arrays, corners, sizes = ctx.kept
        out = torch.empty_like(plain)
        _native.hash_grid_backward(
            plain.numpy(), *arrays, corners, sizes, grad.detach().contiguous().numpy(), out.numpy()
        )
        return out, None, None, None, None


class HashGrid(nn.Module):
    """A trained binary hash grid.

    Attributes:
        table: (entries, features); what counts is their sign. Drawn from U(±1e-4).
    """

    def __init__(self, config: GridConfig, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.config = config
        start = torch.empty((config.entries, config.features)).uniform_(-1e-4, 1e-4, generator=generator)
        self.table = nn.Parameter(start)
        self._corners = [2 ** len(axes) for axes, _, _ in config.levels]
        self._sizes = [entries for _, _, entries in config.levels]

    def lookup(self, codes: Tensor, extent: Sequence[int]) -> Lookup:
        """:func:`make_lookup` with this grid."""
        return make_lookup(self.config, codes, extent)

    def forward(self, lookup: Lookup, rows: Tensor | None = None) -> Tensor:
        """Interpolated values of ±1.

        Args:
            lookup: of N positions.
            rows: (M,) indices (int64) of those asked for; default all, in order.

        Returns:
            (M, outputs), multiples of 2⁻²¹ in [−1, 1]: level after level, ``features`` values each.
        """
        if lookup.config != self.config:
            raise ValueError("the lookup was made for another grid")
        native = choose_backend(self.table) == "native" and self.config.features == 4
        if native:
            looked_up: Tensor = _NativeLookup.apply(
                self.table, lookup, rows, self._corners, self._sizes
            )
            return looked_up
        index, weights = lookup.index, lookup.weights
        if rows is not None:
            index, weights = index[rows], weights[rows]
        values = binarise(self.table)[index.long()] * weights[..., None]
        split = 8 * len(self.config.volume)
        count, features = len(index), self.config.features
        parts = [
            part.reshape(count, -1, corners, features).sum(2).reshape(count, -1)
            for part, corners in ((values[:, :split], 8), (values[:, split:], 4))
            if part.shape[1]
        ]
        return torch.cat(parts, 1)

    def plus_share(self) -> Tensor:
        """(levels,) share of +1 in each level, by which its bits are coded; carries the gradient of ±1."""
        binary = binarise(self.table)
        return torch.stack([0.5 + 0.5 * level.mean() for level in binary.split(self._sizes)])

    def bits(self) -> Tensor:
        """Bits of the grid coded at the measured share of +1 per level (L_hash of the paper), a scalar."""
        share = self.plus_share().clamp(1e-6, 1.0 - 1e-6)
        sizes = share.new_tensor(self._sizes) * self.config.features
        entropy = -(share * share.log2() + (1.0 - share) * (1.0 - share).log2())
        return (sizes * entropy).sum()


def geometric_levels(first: int, last: int, count: int) -> tuple[int, ...]:
    """``count`` resolutions that grow by a constant factor."""
    if count == 1:
        return (first,)
    growth = math.log(last / first) / (count - 1)
    return tuple(round(first * math.exp(growth * i)) for i in range(count))
