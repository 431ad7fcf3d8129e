"""Range coding with integer frequencies, by constriction (Bamler 2022).

constriction turns floating-point probabilities into 24-bit integers. Given whole numbers f − 1 that sum to
2²⁴ − n, its scale is exactly 1 and every cumulative sum a whole number below 2²⁴, so the frequencies are
exactly f whatever the machine: no probability depends on floating point. (``perfect=False`` names that
conversion.)
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import constriction
import numpy as np
from numpy.typing import NDArray

from econgs_bench.econgs.codec.tables import FREQUENCY_BITS, coding_table, low_bits

Categorical, Uniform = constriction.stream.model.Categorical, constriction.stream.model.Uniform
RangeEncoder, RangeDecoder = constriction.stream.queue.RangeEncoder, constriction.stream.queue.RangeDecoder

Symbols = NDArray[np.int32]
_FAMILY = Categorical(perfect=False)
SYMBOL_LIMIT = 1 << 24  # float32 holds every whole number below
_RAW = 16  # bits of one raw symbol


def exact_model(frequencies: NDArray[np.int64]) -> Any:
    """The model with exactly these frequencies: at least two of them, each ≥ 1, sum 2²⁴."""
    if len(frequencies) < 2 or frequencies.min() < 1 or frequencies.sum() != 1 << FREQUENCY_BITS:
        raise ValueError("frequencies of at least 1 with sum 2^24 are needed")
    return Categorical((frequencies - 1).astype(np.float64), perfect=False)


@cache
def _table_model(table: int) -> Any:
    return exact_model(coding_table(table)[1])


@cache
def _table_costs(table: int) -> NDArray[np.float64]:
    return FREQUENCY_BITS - np.log2(coding_table(table)[1])


@cache
def _raw_model(bits: int) -> Any:
    return Uniform(1 << bits)


class Encoder:
    """A range encoder; each method has its counterpart of the same name in :class:`Decoder`."""

    def __init__(self) -> None:
        self._coder = RangeEncoder()

    def symbols(self, symbols: NDArray, model: Any) -> None:
        """Symbols 0 … n − 1 under one model."""
        self._coder.encode(np.ascontiguousarray(symbols, np.int32), model)

    def flags(self, flags: NDArray, models: NDArray[np.float64]) -> None:
        """0 or 1, each under its own row of :func:`flag_models`."""
        self._coder.encode(np.ascontiguousarray(flags, np.int32), _FAMILY, models)

    def raw(self, values: NDArray, bits: int) -> None:
        """Unsigned numbers of ``bits`` bits each, up to 32."""
        values = np.ascontiguousarray(values, np.int64)
        for shift, many in _pieces(bits):
            self.symbols((values >> shift) & ((1 << many) - 1), _raw_model(many))

    def finish(self) -> bytes:
        """All bytes: a whole number of 4-byte words, little-endian."""
        return bytes(self._coder.get_compressed().astype("<u4").tobytes())


class Decoder:
    """Reader of :class:`Encoder`'s bytes; other data give wrong symbols or ``ValueError``, never worse."""

    def __init__(self, data: bytes) -> None:
        if len(data) % 4:
            raise ValueError("entropy-coded data is not a whole number of words")
        self._coder = RangeDecoder(np.frombuffer(data, "<u4").astype(np.uint32))

    def symbols(self, count: int, model: Any) -> Symbols:
        return self._decode(model, count)

    def flags(self, models: NDArray[np.float64]) -> Symbols:
        return self._decode(_FAMILY, models)

    def raw(self, count: int, bits: int) -> NDArray[np.int64]:
        values = np.zeros(count, np.int64)
        for shift, many in _pieces(bits):
            values |= self.symbols(count, _raw_model(many)).astype(np.int64) << shift
        return values

    def finish(self) -> None:
        """Check the end of the data.

        Raises:
            ValueError: the data hold more.
        """
        if not self._coder.maybe_exhausted():
            raise ValueError("entropy-coded data is longer than its symbols")

    def _decode(self, model: Any, *arguments: Any) -> Symbols:
        try:
            decoded: Symbols = self._coder.decode(model, *arguments)
        except AssertionError as error:  # constriction's word for invalid data
            raise ValueError(f"entropy-coded data is invalid: {error}") from error
        return decoded


def flag_models(frequencies: NDArray[np.int64]) -> NDArray[np.float64]:
    """(n, 2) models of flags from the frequencies of 1 in 2⁻¹⁶, 1 to 2¹⁶ − 1."""
    ones = np.asarray(frequencies, np.int64) << (FREQUENCY_BITS - 16)
    return np.stack([(1 << FREQUENCY_BITS) - ones - 1, ones - 1], 1).astype(np.float64)


def _pieces(bits: int) -> Iterator[tuple[int, int]]:
    for shift in range(0, bits, _RAW):
        yield shift, min(_RAW, bits - shift)


def _by_table(tables: NDArray[np.uint16]) -> tuple[NDArray, list[tuple[int, slice, int, int, int]]]:
    """Order that puts the symbols of one table together; of each table: index, places, low, shift, escape.

    Args:
        tables: (n,) index of each symbol's table; both sides know it before any symbol.
    """
    ends, spans = np.cumsum(np.bincount(tables)).tolist(), []
    for table in np.unique(tables).tolist():
        low, frequencies = coding_table(table)
        places = slice(ends[table - 1] if table else 0, ends[table])
        spans.append((table, places, low, low_bits(table), len(frequencies) - 1))
    return np.argsort(tables, kind="stable"), spans


def write_residuals(encoder: Encoder, residuals: NDArray[np.int32], tables: NDArray[np.uint16]) -> float:
    """Code residuals (symbol less the lattice point next to its mean), each by its own table.

    The symbols come table by table, in ascending order; then the raw low bits of the tables that have any;
    then the escapes: 5 bits for the length of a number, and the number, in zigzag.

    Returns:
        Their cross-entropy in bits under the tables, raw and escape bits included.
    """
    order, spans = _by_table(tables)
    sorted_residuals = residuals[order]
    escaped = np.zeros(len(tables), np.bool_)
    raw: list[tuple[NDArray, int]] = []
    bits = 0.0
    for table, places, low, shift, escape in spans:
        part = sorted_residuals[places]
        symbols = (part >> shift) - low
        outside = (symbols < 0) | (symbols >= escape)
        if outside.any():
            symbols = np.where(outside, escape, symbols)
            escaped[places] = outside
        encoder.symbols(symbols, _table_model(table))
        bits += float(_table_costs(table)[symbols].sum())
        if shift:
            regular = part[~outside] if outside.any() else part
            raw.append((regular & ((1 << shift) - 1), shift))
    for values, many in raw:
        encoder.raw(values, many)
        bits += many * len(values)
    return bits + write_escapes(encoder, sorted_residuals[escaped])


def read_residuals(decoder: Decoder, tables: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Inverse of :func:`write_residuals`."""
    order, spans = _by_table(tables)
    sorted_residuals = np.empty(len(tables), np.int32)
    escaped = np.zeros(len(tables), np.bool_)
    raw: list[tuple[slice, int]] = []
    for table, places, low, shift, escape in spans:
        symbols = decoder.symbols(places.stop - places.start, _table_model(table))
        escaped[places] = symbols == escape
        sorted_residuals[places] = (symbols + low) << shift
        if shift:
            raw.append((places, shift))
    for places, bits in raw:
        regular = np.flatnonzero(~escaped[places]) + places.start
        sorted_residuals[regular] |= decoder.raw(len(regular), bits).astype(np.int32)
    sorted_residuals[escaped] = read_escapes(decoder, int(escaped.sum()))
    residuals = np.empty_like(sorted_residuals)
    residuals[order] = sorted_residuals
    return residuals


def write_escapes(encoder: Encoder, numbers: NDArray) -> float:
    """Code whole numbers of at most 30 bits, in zigzag: all lengths, then numbers by length; their bits."""
    if not len(numbers):
        return 0.0
    values = _zigzag(numbers)
    lengths = _lengths(values)
    encoder.raw(lengths, 5)
    for length in np.unique(lengths):
        encoder.raw(values[lengths == length], int(length))
    return float((5 + lengths).sum())


def read_escapes(decoder: Decoder, count: int) -> NDArray[np.int64]:
    """Inverse of :func:`write_escapes`."""
    if not count:
        return np.zeros(0, np.int64)
    lengths = decoder.raw(count, 5)
    values = np.zeros(count, np.int64)
    for length in np.unique(lengths):
        at = lengths == length
        values[at] = decoder.raw(int(at.sum()), int(length))
    return (values >> 1) ^ -(values & 1)


def _zigzag(values: NDArray) -> NDArray[np.int64]:
    wide = values.astype(np.int64)
    return (wide << 1) ^ (wide >> 63)


def _lengths(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bits of non-negative numbers; 0 for 0. Exact: numbers here are far below 2^53."""
    return np.frexp(values.astype(np.float64))[1].astype(np.int64)


def write_bits(encoder: Encoder, plus: NDArray[np.bool_]) -> int:
    """Code bits at their frequency of ones; returns it in units of 2⁻¹⁶, for the reader."""
    share = int(np.clip(round(float(plus.mean()) * 65536), 1, 65535)) if plus.size else 32768
    encoder.symbols(plus.ravel(), _bit_model(share))
    return share


def read_bits(decoder: Decoder, count: int, share: int) -> NDArray[np.bool_]:
    """Inverse of :func:`write_bits`."""
    if not 1 <= share <= 65535:
        raise ValueError("a frequency of ones outside 1 to 65535")
    return decoder.symbols(count, _bit_model(share)).astype(np.bool_)


def write_bits_at(encoder: Encoder, plus: NDArray[np.bool_], share: int) -> float:
    """Code bits at a frequency of ones (2⁻¹⁶) that the reader knows; their cross-entropy in bits."""
    encoder.symbols(plus, _bit_model(share))
    ones = int(plus.sum())
    return float(ones * (16 - np.log2(share)) + (plus.size - ones) * (16 - np.log2(65536 - share)))


def read_bits_at(decoder: Decoder, count: int, share: int) -> NDArray[np.bool_]:
    """Inverse of :func:`write_bits_at`."""
    return decoder.symbols(count, _bit_model(share)).astype(np.bool_)


def _bit_model(share: int) -> Any:
    ones = share << (FREQUENCY_BITS - 16)
    return exact_model(np.array([(1 << FREQUENCY_BITS) - ones, ones], np.int64))
