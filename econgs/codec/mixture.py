"""Coding of symbols under mixtures of two normal distributions, in whole numbers (HAC++'s features).

Tables, as of a single distribution, would be nearly as many as symbols. Instead a symbol is found by halving
a window that holds both distributions: each half is a flag, whose frequency is the half's share of the
mixture's mass. Masses are differences of one whole-number distribution function, so writer and reader agree
on every machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from econgs_bench.econgs.codec.coder import (
    Decoder,
    Encoder,
    flag_models,
    read_bits_at,
    read_escapes,
    write_bits_at,
    write_escapes,
)
from econgs_bench.econgs.codec.tables import (
    CDF_BITS,
    CDF_REACH,
    MEAN_PARTS,
    REFINEMENT_LIMIT,
    normal,
    spread_table,
    step_table,
)

Ints = NDArray[np.int64]

WEIGHT_BITS = 17
"""Weights of a mixture are whole numbers of 2^-17."""
_FLAG_BITS = 16
_ESCAPE = 1  # in 2^-16: frequency of symbols outside the window
_FLOOR_BITS = CDF_BITS - 20  # least probability of a symbol, 2^-20 as in the training loss
_WIDE = 10  # halvings from which on the least probabilities shrink, so that they sum to 2^-10 at most
_LEAST_REACH = 3


def first_weight(logits: Ints) -> Ints:
    """Weights of the first distribution, 2^-17, from differences of logits in 2^-16, in sixteenths.

    1 / (1 + exp(-d)) is (1 + tanh(d / 2)) / 2, whose table the steps have.
    """
    sixteenth = 16 - 4
    index = np.clip((logits + (1 << (sixteenth - 1))) >> sixteenth, -REFINEMENT_LIMIT, REFINEMENT_LIMIT - 1)
    weights: Ints = step_table()[index + REFINEMENT_LIMIT]
    return weights


@dataclass(frozen=True)
class Mixture:
    """Mixtures of two normal distributions for n symbols.

    Attributes:
        parts: (2, n) means, in sixteenths of a step.
        spreads: (2, n) indices of :func:`.econgs.codec.tables.spread_table`.
        weight: (n,) of the first distribution, 2^-17, between 0 and 1 exclusively.
    """

    parts: Ints
    spreads: Ints
    weight: Ints

    def of(self, rows: Ints) -> Mixture:
        """Those of some symbols."""
        return Mixture(self.parts[:, rows], self.spreads[:, rows], self.weight[rows])

    def window(self) -> tuple[Ints, Ints]:
        """(n,) first symbol and number of halvings of a window that holds both distributions to six sigma."""
        center = (self.parts + MEAN_PARTS // 2) >> 4
        reach = np.maximum(_LEAST_REACH, -(-6 * spread_table()[self.spreads] >> 16) + 1)
        low, high = (center - reach).min(0), (center + reach).max(0)
        return low, np.frexp((high - low).astype(np.float64))[1].astype(np.int64)

    def cumulative(self, edges: Ints) -> Ints:
        """(n,) mass below the lower edge of the symbols ``edges``, 2^-38."""
        # Edges less the means in units of 2^-5 steps: halves and sixteenths are whole.
        scaled = (edges << 5) - 16 - 2 * self.parts
        x = np.clip((scaled << 27) // spread_table()[self.spreads], -(CDF_REACH << 16), CDF_REACH << 16)
        first, second = normal(x)
        mass: Ints = (self.weight * first + ((1 << WEIGHT_BITS) - self.weight) * second) >> WEIGHT_BITS
        return mass


def write_mixture(encoder: Encoder, symbols: NDArray[np.int32], mixture: Mixture) -> float:
    """Code symbols, each under its own mixture.

    Flags of all symbols come halving by halving; before them one flag per symbol whether it lies outside
    its window, and how far.

    Returns:
        Their cross-entropy in bits, escapes included.
    """
    low, levels = mixture.window()
    places = symbols.astype(np.int64) - low
    outside = (places < 0) | (places >> levels > 0)
    bits = write_bits_at(encoder, outside, _ESCAPE) + write_escapes(encoder, places[outside])

    def flags(rows: Ints, level: int, frequencies: Ints) -> NDArray[np.bool_]:
        nonlocal bits
        found: NDArray[np.bool_] = (places[inside[rows]] >> level) & 1 == 1
        encoder.flags(found, flag_models(frequencies))
        chances = np.where(found, frequencies, (1 << _FLAG_BITS) - frequencies)
        bits += float((_FLAG_BITS - np.log2(chances)).sum())
        return found

    inside = np.flatnonzero(~outside)
    _halve(mixture.of(inside), flags)
    return bits


def read_mixture(decoder: Decoder, mixture: Mixture) -> Ints:
    """Inverse of :func:`write_mixture`."""
    low, _ = mixture.window()
    outside = read_bits_at(decoder, len(low), _ESCAPE)
    symbols = np.empty(len(low), np.int64)
    symbols[outside] = low[outside] + read_escapes(decoder, int(outside.sum()))
    inside = np.flatnonzero(~outside)

    def flags(rows: Ints, level: int, frequencies: Ints) -> NDArray[np.bool_]:
        return decoder.flags(flag_models(frequencies)).astype(np.bool_)

    symbols[inside] = _halve(mixture.of(inside), flags)
    return symbols


def _halve(mixture: Mixture, flags: Callable[[Ints, int, Ints], NDArray[np.bool_]]) -> Ints:
    """(n,) symbols to which flags lead.

    Args:
        mixture: of n symbols, each within its window.
        flags: which of ``rows`` lie in the upper half at a level, from the frequencies of that in 2^-16.
    """
    low, levels = mixture.window()
    begin = low.copy()
    floor = np.minimum(_FLOOR_BITS, _FLOOR_BITS + _WIDE - levels)
    below, above = mixture.cumulative(low), mixture.cumulative(low + (1 << levels))
    for level in range(int(levels.max(initial=0)) - 1, -1, -1):
        rows = np.flatnonzero(levels > level)
        middle = mixture.of(rows).cumulative(begin[rows] + (1 << level))
        least = 1 << (floor[rows] + level)
        left, right = middle - below[rows] + least, above[rows] - middle + least
        frequencies = np.clip((right << _FLAG_BITS) // (left + right), 1, (1 << _FLAG_BITS) - 1)
        upper = flags(rows, level, frequencies)
        begin[rows] += upper.astype(np.int64) << level
        below[rows] = np.where(upper, middle, below[rows])
        above[rows] = np.where(upper, above[rows], middle)
    return begin
