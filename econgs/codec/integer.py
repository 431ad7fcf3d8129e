"""The context model in integer arithmetic, for the entropy coder.

Weights are 8-bit integers with one power of two per row, biases 32-bit integers of 2⁻¹⁶, activations integers
of 2⁻¹⁶, looked-up values integers of 2⁻²¹; steps and spreads come from tables. Every sum stays below 2⁵³, so
that the fast path may multiply matrices in float64: each partial sum is a whole number that float64 holds,
and neither the order nor the number of threads nor the instruction set can change the result.
Values in int64 make all products in int64, as a reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs_bench.econgs.codec.hash_grid import VALUE_BITS
from econgs_bench.econgs.codec.tables import (
    MEAN_PARTS,
    REFINEMENT_LIMIT,
    REFINEMENT_SCALE,
    SPREAD_OCTAVES,
    SPREAD_PER_OCTAVE,
    SPREADS,
    step_log_table,
    step_table,
    table_index,
)

ACTIVATION_BITS = 16
WEIGHT_LIMIT = 127
EXPONENT_RANGE = (-16, 20)
HIDDEN_LIMIT = (1 << (7 + ACTIVATION_BITS)) - 1  # hidden values below 128
OUTPUT_LIMIT = (1 << 31) - 1
MOST_INPUTS = 512
MEAN_LIMIT = 1 << 26  # no trained model predicts a mean this far out

Ints = NDArray[np.int64]


def row_exponents(weight: Tensor) -> Tensor:
    """(rows,) int32 exponents e for which round(weight · 2^e) uses the range of 8 bits."""
    largest = weight.detach().abs().amax(1)
    mantissa, exponent = torch.frexp(largest)  # largest = mantissa 2^exponent, mantissa in [1/2, 1)
    # 127 / 128 is the largest mantissa that still rounds to 127 after scaling by 2^(7 - exponent).
    fits = 7 - exponent.to(torch.int32) - (mantissa > WEIGHT_LIMIT / 128).to(torch.int32)
    return torch.where(largest > 0.0, fits.clamp(*EXPONENT_RANGE), 0).to(torch.int32)


def rounded_weight(weight: Tensor) -> Tensor:
    """The weight as the coder uses it, with a straight-through gradient."""
    with torch.no_grad():
        scale = torch.exp2(row_exponents(weight).to(weight.dtype))[:, None]
        whole = (weight * scale).round().clamp_(-WEIGHT_LIMIT, WEIGHT_LIMIT)
        difference = whole / scale - weight
    return weight + difference


def rounded_steps(refinements: Tensor) -> Tensor:
    """1 + tanh(r) by the coder's table; the gradient is that of 1 + tanh(r)."""
    smooth = 1.0 + torch.tanh(refinements)
    with torch.no_grad():
        limits = -REFINEMENT_LIMIT, REFINEMENT_LIMIT - 1
        index = torch.floor(refinements * REFINEMENT_SCALE + 0.5).clamp_(*limits).to(torch.int64)
        table = torch.from_numpy(step_table()).to(refinements.device)
        difference = table[index + REFINEMENT_LIMIT].to(smooth) / 65536.0 - smooth
    return smooth + difference


@dataclass(frozen=True)
class IntegerLayer:
    """Weights (rows, inputs) int8, exponents (rows,) int8, biases (rows,) int32 of 2⁻¹⁶."""

    weight: NDArray[np.int8]
    exponent: NDArray[np.int8]
    bias: NDArray[np.int32]

    @classmethod
    def of(cls, weight: Tensor, bias: Tensor) -> IntegerLayer:
        """The nearest integer layer to a float layer."""
        weight, bias = weight.detach().cpu().double(), bias.detach().cpu().double()
        if not (weight.isfinite().all() and bias.isfinite().all()):
            raise ValueError("the context model has weights that are not finite")
        exponent = row_exponents(weight)
        whole = (weight * torch.exp2(exponent.double())[:, None]).round().clamp_(-WEIGHT_LIMIT, WEIGHT_LIMIT)
        shift = (bias * (1 << ACTIVATION_BITS)).round().clamp_(-OUTPUT_LIMIT, OUTPUT_LIMIT)
        return cls(
            whole.to(torch.int8).numpy(), exponent.to(torch.int8).numpy(), shift.to(torch.int32).numpy()
        )

    def checked(self) -> IntegerLayer:
        """Itself.

        Raises:
            ValueError: numbers outside the range of :meth:`of`.
        """
        low, high = EXPONENT_RANGE
        if (self.weight == -128).any() or (self.exponent < low).any() or (self.exponent > high).any():
            raise ValueError("weights or exponents out of range")
        return self

    def __call__(self, inputs: NDArray, input_bits: int) -> Ints:
        """Outputs of 2⁻¹⁶ from inputs of 2^-input_bits: rounded half up, clamped to 32 bits.

        Args:
            inputs: (N, inputs), whole numbers in float64 or int64, in which they are multiplied.
            input_bits: at least 16.
        """
        products = inputs @ self.weight.T.astype(inputs.dtype)
        sums: Ints = products.astype(np.int64, copy=False)
        shift = self.exponent.astype(np.int64) + (input_bits - ACTIVATION_BITS)
        down, up = np.maximum(shift, 0), np.maximum(-shift, 0)
        half = np.where(down > 0, np.left_shift(1, np.maximum(down - 1, 0)), 0)
        sums += half
        sums >>= down
        sums <<= up
        sums += self.bias
        return np.clip(sums, -OUTPUT_LIMIT, OUTPUT_LIMIT, out=sums)


class Normals(NamedTuple):
    """One of the two normal distributions of each feature of N anchors (:mod:`.econgs.codec.mixture`).

    Attributes:
        parts: (N, F) means, in sixteenths of a step.
        spreads: (N, F) indices of the table of spreads.
        logits: (N, F) of its weight, 2⁻¹⁶.
    """

    parts: Ints
    spreads: Ints
    logits: Ints

    @classmethod
    def of(cls, means: Ints, spreads: Ints, logits: Ints, step: Ints, log: Ints) -> Normals:
        """From outputs of 2⁻¹⁶.

        Args:
            means: (N, F) in units of Q.
            spreads: (N, F) logarithms to base 2, in the same units.
            logits: (N, F).
            step: (N, 1) 2¹⁶ q / Q.
            log: (N, 1) its logarithm to base 2, 2⁻¹⁶.
        """
        return cls(_mean_parts(means, step), _spread_index(spreads, log), logits)


@dataclass(frozen=True)
class Coding:
    """Coding parameters of the attributes of N anchors.

    Attributes:
        steps: (N, G) int64, 2¹⁶ q / Q per attribute group.
        center: (N, D) int32, the lattice point next to the mean.
        table: (N, D) uint16, index of the coding table.
    """

    steps: Ints
    center: NDArray[np.int32]
    table: NDArray[np.uint16]


@dataclass(frozen=True)
class MixedCoding(Coding):
    """Coding parameters where features are mixtures; their columns of ``center`` and ``table`` are not used.

    Attributes:
        logs: (N, 1) logarithm to base 2 of the features' steps, 2⁻¹⁶.
        normals: what the position says of the features.
    """

    logs: Ints
    normals: Normals


def joined(pieces: Sequence[Coding]) -> Coding:
    """Coding parameters of all anchors from those of pieces, of at least one."""
    steps, center, table = (
        np.concatenate(part)
        for part in zip(*((one.steps, one.center, one.table) for one in pieces), strict=True)
    )
    mixed = [one for one in pieces if isinstance(one, MixedCoding)]
    if not mixed:
        return Coding(steps, center, table)
    normals = Normals(*(np.concatenate(part) for part in zip(*(one.normals for one in mixed), strict=True)))
    return MixedCoding(steps, center, table, np.concatenate([one.logs for one in mixed]), normals)


def _mean_parts(means: Ints, step: Ints) -> Ints:
    """Means in sixteenths of a step, rounded half up: mean / q = output / step."""
    parts = (2 * MEAN_PARTS * means + step) // (2 * step)
    return np.clip(parts, -MEAN_LIMIT, MEAN_LIMIT, out=parts)


def _spread_index(spreads: Ints, log: Ints) -> Ints:
    """Indices of spreads: log2(sigma / q) in eighths, rounded half up."""
    eighth = ACTIVATION_BITS - 3
    index = ((spreads - log + (1 << (eighth - 1))) >> eighth) - SPREAD_OCTAVES[0] * SPREAD_PER_OCTAVE
    return np.clip(index, 0, SPREADS - 1, out=index)


@dataclass(frozen=True)
class IntegerHead:
    """The head of the context model: looked-up values → coding parameters of each attribute.

    The rows of ``second`` are D means in units of Q (the group's base step), D logarithms to base 2 of the
    spreads in the same units, and G refinements of the step. Where features are mixtures, one logit per
    feature follows.

    Attributes:
        first, second: the two layers.
        widths: attributes per group; D is their sum, G their number.
    """

    first: IntegerLayer
    second: IntegerLayer
    widths: tuple[int, ...]

    def __call__(self, values: NDArray) -> Coding:
        """Evaluate for N anchors.

        Args:
            values: (N, inputs) whole numbers of 2⁻²¹, as float64 or int64; the result is the same.
        """
        hidden = self.first(values, VALUE_BITS)
        np.clip(hidden, 0, HIDDEN_LIMIT, out=hidden)
        outputs = self.second(hidden.astype(values.dtype, copy=False), ACTIVATION_BITS)
        total, groups = sum(self.widths), len(self.widths)
        refinements = outputs[:, 2 * total : 2 * total + groups]
        half = 1 << (ACTIVATION_BITS - 6)  # 1/32 is 2^11 units of 2^-16
        index = np.clip(
            (refinements + half) >> (ACTIVATION_BITS - 5), -REFINEMENT_LIMIT, REFINEMENT_LIMIT - 1
        )
        index += REFINEMENT_LIMIT
        steps, logs = step_table()[index], step_log_table()[index]
        center = np.empty((len(outputs), total), np.int32)
        table = np.empty((len(outputs), total), np.uint16)
        at = 0
        for group in range(groups):
            columns = slice(at, at + self.widths[group])
            at = columns.stop
            step, log = steps[:, group, None], logs[:, group, None]
            parts = _mean_parts(outputs[:, columns], step)
            near = (parts + MEAN_PARTS // 2) >> 4
            spreads = _spread_index(outputs[:, total + columns.start : total + columns.stop], log)
            center[:, columns] = near
            table[:, columns] = table_index(spreads, parts - MEAN_PARTS * near)
        logits = outputs[:, 2 * total + groups :]
        if not logits.shape[1]:
            return Coding(steps, center, table)
        width, log = self.widths[0], logs[:, :1]
        means, spreads = outputs[:, :width], outputs[:, total : total + width]
        normals = Normals.of(means, spreads, logits, steps[:, :1], log)
        return MixedCoding(steps, center, table, log, normals)


@dataclass(frozen=True)
class IntegerIntra:
    """What features say of later ones of the same anchor: chunks of channels, each from all chunks before it.

    A chunk's outputs are w means in units of Q, w logarithms to base 2 of the spreads in the same units, and
    w logits; those of the first chunk are numbers that nothing enters.

    Attributes:
        widths: (chunks,) channels w of each.
        units: (F,) int8; a channel enters in units of Q times 2 to this power.
        free: (3 w,) int32 outputs of the first chunk, 2⁻¹⁶.
        layers: two for every later chunk.
    """

    widths: tuple[int, ...]
    units: NDArray[np.int8]
    free: NDArray[np.int32]
    layers: tuple[tuple[IntegerLayer, IntegerLayer], ...]

    def checked(self) -> IntegerIntra:
        """Itself.

        Raises:
            ValueError: numbers outside the range of what training makes.
        """
        low, high = EXPONENT_RANGE
        if (self.units < low).any() or (self.units > high).any() or (self.free == -(1 << 31)).any():
            raise ValueError("units or first outputs out of range")
        return self

    def __call__(self, chunk: int, symbols: Ints, step: Ints, log: Ints) -> Normals:
        """Distributions of a chunk.

        Args:
            chunk: its number.
            symbols: (N, channels before it).
            step: (N, 1) 2¹⁶ q / Q.
            log: (N, 1) its logarithm to base 2, 2⁻¹⁶.
        """
        if chunk == 0:
            outputs = self.free.astype(np.int64)[None].repeat(len(step), 0)
        else:
            first, second = self.layers[chunk - 1]
            units = self.units[: symbols.shape[1]].astype(np.int64)
            values = (symbols * step << np.maximum(-units, 0)) >> np.maximum(units, 0)
            inputs = np.clip(values, -OUTPUT_LIMIT, OUTPUT_LIMIT).astype(np.float64)
            hidden = np.clip(first(inputs, ACTIVATION_BITS), 0, HIDDEN_LIMIT)
            outputs = second(hidden.astype(np.float64), ACTIVATION_BITS)
        means, spreads, logits = np.split(outputs, 3, 1)
        return Normals.of(means, spreads, logits, step, log)


def whole_values(values: Tensor) -> NDArray[np.float64]:
    """Looked-up values as whole numbers of 2⁻²¹ in float64, exactly."""
    return values.detach().cpu().double().mul_(float(1 << VALUE_BITS)).numpy()


def step_sizes(steps: Ints, base: float) -> NDArray[np.float32]:
    """Step q in float32: Q rounded to float32 times the table's integer, rounded once, times 2⁻¹⁶ (exact)."""
    return steps.astype(np.float32) * np.float32(base) * np.float32(1.0 / 65536.0)
