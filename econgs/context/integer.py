"""The context model in integer arithmetic, for the entropy coder.

Weights are 8-bit integers with one power of two per row, biases 32-bit integers of 2⁻¹⁶, activations integers
of 2⁻¹⁶, looked-up values integers of 2⁻²¹; steps and spreads come from tables. Every sum stays below 2⁵³, so
that the fast path may multiply matrices in float64: each partial sum is a whole number that float64 holds,
and neither the order nor the number of threads nor the instruction set can change the result.
Values in int64 make all products in int64, as a reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from econgs.context.hash_grid import VALUE_BITS
from econgs.context.tables import (
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
class IntegerHead:
    """The head of the context model: looked-up values → coding parameters of each attribute.

    The rows of ``second`` are D means in units of Q (the group's base step), D logarithms to base 2 of the
    spreads in the same units, and G refinements of the step.

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
        refinements = outputs[:, 2 * total :]
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
            # mean / q = output / step; in sixteenths, rounded half up
            parts = (2 * MEAN_PARTS * outputs[:, columns] + step) // (2 * step)
            np.clip(parts, -MEAN_LIMIT, MEAN_LIMIT, out=parts)
            near = (parts + MEAN_PARTS // 2) >> 4
            spreads = outputs[:, total + columns.start : total + columns.stop] - log
            eighth = ACTIVATION_BITS - 3
            spreads = ((spreads + (1 << (eighth - 1))) >> eighth) - SPREAD_OCTAVES[0] * SPREAD_PER_OCTAVE
            np.clip(spreads, 0, SPREADS - 1, out=spreads)
            center[:, columns] = near
            table[:, columns] = table_index(spreads, parts - MEAN_PARTS * near)
        return Coding(steps, center, table)


def whole_values(values: Tensor) -> NDArray[np.float64]:
    """Looked-up values as whole numbers of 2⁻²¹ in float64, exactly."""
    return values.detach().cpu().double().mul_(float(1 << VALUE_BITS)).numpy()


def step_sizes(steps: Ints, base: float) -> NDArray[np.float32]:
    """Step q in float32: Q rounded to float32 times the table's integer, rounded once, times 2⁻¹⁶ (exact)."""
    return steps.astype(np.float32) * np.float32(base) * np.float32(1.0 / 65536.0)
