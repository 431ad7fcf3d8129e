"""Integer tables of the bitstream, made by integer arithmetic and correctly rounded decimals.

No value depends on a machine's floating point or its mathematical library: the tables are the same everywhere
(the tests hold their checksum), and so are the probabilities that the entropy coder works with.
"""

from __future__ import annotations

from decimal import Context, Decimal
from functools import cache

import numpy as np
from numpy.typing import NDArray

# Refinements: 1 + tanh(r) at r = index / 32, index -128 to 127.
REFINEMENT_SCALE = 32
REFINEMENT_LIMIT = 128
STEP_BITS = 16

# Coding tables: spreads sigma / q of 2^-4 to 2^14 in eighths of octaves, means in sixteenths of a step.
SPREAD_OCTAVES = (-4, 14)
SPREAD_PER_OCTAVE = 8
SPREADS = (SPREAD_OCTAVES[1] - SPREAD_OCTAVES[0]) * SPREAD_PER_OCTAVE + 1
MEAN_PARTS = 16
FREQUENCY_BITS = 24
FLOOR = 16  # least frequency of a symbol: 2^-20, the floor of the training loss
_FINE = (3 - SPREAD_OCTAVES[0]) * SPREAD_PER_OCTAVE  # below sigma / q = 8: one table per part of a step
TABLES = _FINE * MEAN_PARTS + SPREADS - _FINE

_CDF_PER_UNIT = 1024
CDF_REACH = 9
CDF_BITS = 38  # with 24 bits of frequencies: 62
_DECIMAL = Context(prec=50)


@cache
def step_table() -> NDArray[np.int64]:
    """(256,) round(2^16 (1 + tanh(i / 32))) for i from -128 to 127."""
    values = []
    for index in range(-REFINEMENT_LIMIT, REFINEMENT_LIMIT):
        power = _DECIMAL.exp(Decimal(-2 * index) / REFINEMENT_SCALE)
        values.append(round(_DECIMAL.divide(Decimal(2 << STEP_BITS), 1 + power)))
    return np.array(values, np.int64)


@cache
def step_log_table() -> NDArray[np.int64]:
    """(256,) 2^16 log2(1 + tanh(i / 32)), rounded, from the integers of :func:`step_table`."""
    log2 = _DECIMAL.ln(Decimal(2))
    one = Decimal(1 << STEP_BITS)
    return np.array(
        [
            round(_DECIMAL.divide(_DECIMAL.ln(_DECIMAL.divide(Decimal(int(t)), one)), log2) * one)
            for t in step_table()
        ],
        np.int64,
    )


@cache
def spread_table() -> NDArray[np.int64]:
    """(SPREADS,) 2^16 sigma / q."""
    log2 = _DECIMAL.ln(Decimal(2))
    low = SPREAD_OCTAVES[0] * SPREAD_PER_OCTAVE
    exponents = [Decimal(low + i) / SPREAD_PER_OCTAVE for i in range(SPREADS)]
    return np.array([round(_DECIMAL.exp(e * log2) * (1 << 16)) for e in exponents], np.int64)


@cache
def _cdf() -> NDArray[np.int64]:
    """Normal distribution function at i / 1024, i from 0 (value one half) to 9 · 1024, times 2^38."""
    precision = 160
    unit = 1 << precision
    # The density at the ends and middles of all intervals (a step of 1/2048) by its recurrence:
    # g(i + 1) / g(i) = exp(-(2 i + 1) h^2 / 2).
    half_square = Decimal(1) / (2 * (2 * _CDF_PER_UNIT) ** 2)
    ratio = int(_DECIMAL.exp(-half_square) * unit)
    growth = int(_DECIMAL.exp(-2 * half_square) * unit)
    value = unit
    density = [value]
    for _ in range(2 * _CDF_PER_UNIT * CDF_REACH):
        value = value * ratio >> precision
        ratio = ratio * growth >> precision
        density.append(value)
    # Simpson's rule over each interval; 1 / sqrt(2 pi) by scaling the whole to one half.
    sums = [0]
    for i in range(0, len(density) - 2, 2):
        sums.append(sums[-1] + density[i] + 4 * density[i + 1] + density[i + 2])
    half = 1 << (CDF_BITS - 1)
    return np.array([half + half * one // sums[-1] for one in sums], np.int64)


def normal(x: NDArray[np.int64]) -> NDArray[np.int64]:
    """Normal distribution function of x / 2^16, times 2^38, by linear interpolation."""
    table = _cdf()
    scaled = np.abs(x) * _CDF_PER_UNIT
    cell = np.minimum(scaled >> 16, len(table) - 2)
    rest = np.minimum(scaled - (cell << 16), 1 << 16)
    upper = table[cell] + ((table[cell + 1] - table[cell]) * rest >> 16)
    value: NDArray[np.int64] = np.where(x >= 0, upper, (1 << CDF_BITS) - upper)
    return value


def table_index(spread: NDArray[np.int64], part: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Table for a spread (0 to SPREADS - 1) and a mean ``part`` (-8 to 7) sixteenths from a lattice point."""
    fine = spread * MEAN_PARTS + (part + MEAN_PARTS // 2)
    return np.where(spread < _FINE, fine, _FINE * (MEAN_PARTS - 1) + spread).astype(np.uint16)


def low_bits(table: int) -> int:
    """Raw bits of a residual: the distribution is flat across them."""
    spread = _FINE - 1 if table < _FINE * MEAN_PARTS else table - _FINE * (MEAN_PARTS - 1)
    return max(0, (spread + SPREAD_OCTAVES[0] * SPREAD_PER_OCTAVE) // SPREAD_PER_OCTAVE - 3)


@cache
def coding_table(table: int) -> tuple[int, NDArray[np.int64]]:
    """Lowest symbol and frequencies (sum 2^24) of a table; the last frequency is that of the escape.

    A symbol is the residual (value less the lattice point next to the mean) shifted right by
    :func:`low_bits`. Its frequency is that of a normal distribution integrated over its cell.
    """
    if table < _FINE * MEAN_PARTS:
        spread, part = divmod(table, MEAN_PARTS)
        part -= MEAN_PARTS // 2
    else:
        spread, part = table - _FINE * (MEAN_PARTS - 1), 0
    sigma = int(spread_table()[spread])  # in 2^-16 steps
    raw = low_bits(table)
    reach = max(8, -(-6 * sigma // (1 << (16 + raw))) + 1)
    # Cell edges less the mean in units of 2^-5 steps: halves and sixteenths are whole.
    edges = (np.arange(-reach, reach + 2, dtype=np.int64) << (raw + 5)) - 16 - 2 * part
    # x = edge / 2^5 / (sigma / 2^16), in units of 2^-16.
    x = np.clip((edges << 27) // sigma, -(CDF_REACH << 16), CDF_REACH << 16)
    weights = np.diff(normal(x))
    free = (1 << FREQUENCY_BITS) - FLOOR * (len(weights) + 1)
    frequencies = np.append(FLOOR + (weights * free >> CDF_BITS), FLOOR)
    frequencies[np.argmax(frequencies)] += (1 << FREQUENCY_BITS) - frequencies.sum()
    return -reach, frequencies
