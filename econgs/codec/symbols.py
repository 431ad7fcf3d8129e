"""The attributes of a scene as sections of a stream: symbols of some columns, and masks of offsets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from econgs_bench.econgs.codec.coder import (
    Decoder,
    Encoder,
    read_bits,
    read_residuals,
    write_bits,
    write_residuals,
)
from econgs_bench.econgs.codec.container import Reader
from econgs_bench.econgs.codec.integer import Coding, IntegerIntra, MixedCoding
from econgs_bench.econgs.codec.mixture import Mixture, first_weight, read_mixture, write_mixture

Present = NDArray[np.bool_]
SCALINGS = 6
"""Scalings of an anchor: three of its offsets, three of its Gaussians' scales."""


def columns_of(width: int, many: int) -> list[slice]:
    """Columns of features, scalings and offsets among the D elements."""
    end = width + SCALINGS
    return [slice(0, width), slice(width, end), slice(end, end + 3 * many)]


def present_of(masks: Present | None) -> list[Present | None]:
    """(N, columns) masks of the coded symbols for each part of :func:`columns_of`; None: all."""
    return [None, None, None if masks is None else masks.repeat(3, 1)]


def write_masks(masks: Present) -> bytes:
    """Bytes of (N, K) masks: the frequency of ones in 2⁻¹⁶, then the bits coded at it."""
    encoder = Encoder()
    share = write_bits(encoder, masks)
    return np.array([share], "<u2").tobytes() + encoder.finish()


def read_masks(reader: Reader, anchors: int, many: int) -> Present:
    """Inverse of :func:`write_masks`."""
    (share,) = reader.unpack("H")
    decoder = Decoder(reader.rest())
    masks = read_bits(decoder, anchors * many, share).reshape(anchors, many)
    decoder.finish()
    return masks


def write_symbols(
    symbols: NDArray[np.int32], coding: Coding, columns: slice, present: Present | None
) -> tuple[bytes, float]:
    """Bytes of some columns and their ideal bits; symbols that are not present must be 0."""
    residuals = _select(symbols[:, columns] - coding.center[:, columns], present)
    tables = _select(coding.table[:, columns], present)
    encoder = Encoder()
    ideal = write_residuals(encoder, residuals, tables)
    return encoder.finish(), ideal


def read_symbols(
    reader: Reader, coding: Coding, columns: slice, present: Present | None
) -> NDArray[np.int32]:
    """Inverse of :func:`write_symbols`."""
    center = coding.center[:, columns]
    decoder = Decoder(reader.rest())
    residuals = read_residuals(decoder, _select(coding.table[:, columns], present))
    decoder.finish()
    if present is None:
        return residuals.reshape(center.shape) + center
    symbols = np.zeros(center.shape, np.int32)
    symbols[present] = residuals + center[present]
    return symbols


def write_features(symbols: NDArray[np.int32], coding: Coding, intra: IntegerIntra) -> tuple[bytes, float]:
    """Bytes of features (N, F) that are mixtures, chunk by chunk, and their ideal bits."""
    encoder, ideal, at = Encoder(), 0.0, 0
    for chunk, width in enumerate(intra.widths):
        mixture = _mixture(chunk, symbols[:, :at].astype(np.int64), coding, intra)
        ideal += write_mixture(encoder, symbols[:, at : at + width].ravel(), mixture)
        at += width
    return encoder.finish(), ideal


def read_features(reader: Reader, coding: Coding, intra: IntegerIntra) -> NDArray[np.int32]:
    """Inverse of :func:`write_features`."""
    decoder = Decoder(reader.rest())
    symbols = np.empty((len(coding.steps), 0), np.int64)
    for chunk, width in enumerate(intra.widths):
        part = read_mixture(decoder, _mixture(chunk, symbols, coding, intra))
        symbols = np.concatenate([symbols, part.reshape(len(symbols), width)], 1)
    decoder.finish()
    return symbols.astype(np.int32)


def _mixture(chunk: int, before: NDArray[np.int64], coding: Coding, intra: IntegerIntra) -> Mixture:
    """Mixtures of a chunk's symbols, anchor by anchor, from those of the chunks before it."""
    assert isinstance(coding, MixedCoding)
    columns = slice(before.shape[1], before.shape[1] + intra.widths[chunk])
    own = intra(chunk, before, coding.steps[:, :1], coding.logs)
    pairs = [
        np.stack([of_place[:, columns].ravel(), of_others.ravel()])
        for of_place, of_others in zip(coding.normals, own, strict=True)
    ]
    logits = pairs[2][0] - pairs[2][1]
    return Mixture(pairs[0], pairs[1], first_weight(logits))


def _select(values: NDArray, present: Present | None) -> NDArray:
    return values.ravel() if present is None else values[present]
