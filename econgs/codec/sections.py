"""The payloads of a stream's sections: what writes each beside what reads it (docs/reference/bitstream.md).

Those of attributes and masks are in :mod:`.econgs.codec.symbols`, of float arrays in
:mod:`.econgs.codec.arrays`.
"""

from __future__ import annotations

import json
from dataclasses import replace
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.bounded import json_of
from econgs_bench.econgs.codec.arrays import Arrays, read_arrays, write_arrays
from econgs_bench.econgs.codec.coder import Decoder, Encoder, read_bits, write_bits
from econgs_bench.econgs.codec.container import Reader
from econgs_bench.econgs.codec.group import CodedContext, GroupAttributes
from econgs_bench.econgs.codec.hash_grid import GridConfig
from econgs_bench.econgs.codec.integer import (
    MOST_INPUTS,
    Coding,
    IntegerHead,
    IntegerIntra,
    IntegerLayer,
)
from econgs_bench.econgs.codec.model import MOST_ELEMENTS, ContextConfig
from econgs_bench.econgs.codec.positions import (
    PositionGrid,
    decode_positions,
    encode_positions,
    read_plain_positions,
    write_plain_positions,
)
from econgs_bench.econgs.codec.quantiser import Quantised
from econgs_bench.econgs.codec.symbols import (
    SCALINGS,
    Present,
    read_features,
    read_symbols,
    write_features,
    write_symbols,
)

ANCHORS_PER_BYTE = 4  # maximum number of anchors per byte of positions: bounds a reader's allocations


class Parts(IntFlag):
    """What a group's stream has beyond plain attributes at coded positions."""

    CONTEXT = 1
    MASKS = 2
    CULLING = 4
    PLAIN_POSITIONS = 8
    MIXTURES = 16


_MIXED = Parts.CONTEXT | Parts.MIXTURES
_COMBINATIONS = (
    Parts(0), Parts.CONTEXT, Parts.MASKS, Parts.CONTEXT | Parts.MASKS, Parts.CONTEXT | Parts.CULLING,
    _MIXED, _MIXED | Parts.MASKS,
)  # fmt: skip
"""Those that occur, each with coded or with plain positions."""


class Header(NamedTuple):
    """What the first section says of a group.

    Attributes:
        grid: grid of the positions.
        parts: what the stream has.
        scenes: number of scenes.
        features: values of an anchor's feature.
        offsets: Gaussians of an anchor.
        metadata: JSON object.
    """

    grid: PositionGrid
    parts: Parts
    scenes: int
    features: int
    offsets: int
    metadata: dict[str, Any]

    @classmethod
    def of(cls, group: GroupAttributes) -> Header:
        """The header of a group's stream."""
        has = {
            Parts.CONTEXT: group.context is not None,
            Parts.MASKS: group.masked,
            Parts.CULLING: group.culling,
            Parts.PLAIN_POSITIONS: group.plain_positions,
            Parts.MIXTURES: group.mixtures,
        }
        parts, first = Parts(sum(part for part, there in has.items() if there)), group.scenes[0]
        shape = (first.features.shape[1], first.offsets.shape[1])
        return cls(group.grid, parts, len(group.scenes), *shape, group.metadata)


def write_header(header: Header) -> bytes:
    """Bytes of the section of a group."""
    grid, parts, *shape, metadata = header
    places = np.array([*grid.origin, *grid.cell], "<f8").tobytes()
    text = json.dumps(metadata, separators=(",", ":"), sort_keys=True)
    return np.array([*shape, parts, *grid.extent], "<u2").tobytes() + places + _write_text(text)


def read_header(reader: Reader) -> Header:
    """Inverse of :func:`write_header`."""
    count, width, many, parts, *extent = reader.unpack("7H")
    numbers = reader.unpack("6d")
    known = parts & ~int(Parts.PLAIN_POSITIONS) in _COMBINATIONS
    if not (count and width and many and known and width + SCALINGS + 3 * many <= MOST_ELEMENTS):
        raise ValueError(f"no scenes, features or offsets, or more than {MOST_ELEMENTS} elements per anchor")
    grid = PositionGrid(numbers[:3], numbers[3:], tuple(extent))
    metadata = json_of(_read_text(reader))
    if not isinstance(metadata, dict):
        raise ValueError("metadata is no object")
    return Header(grid, Parts(parts), count, width, many, metadata)


def write_context(context: CodedContext) -> bytes:
    """Bytes of a context model without its hash grid."""
    config, grid = context.config, context.config.grid
    sizes = [config.features, config.offsets, config.hidden, len(grid.volume), len(grid.planes),
             grid.volume_log2, grid.planes_log2, grid.features, *grid.volume, *grid.planes]  # fmt: skip
    parts = [np.array(sizes, "<u2").tobytes(), np.array(config.steps, "<f4").tobytes()]
    layers = [context.head.first, context.head.second]
    if (intra := context.intra) is not None:
        hidden = len(intra.layers[0][0].weight) if intra.layers else 0
        parts.insert(1, np.array([config.chunk, hidden], "<u2").tobytes())
        layers += [layer for pair in intra.layers for layer in pair]
    for layer in layers:
        parts += [layer.weight.tobytes(), layer.exponent.tobytes(), layer.bias.astype("<i4").tobytes()]
    if intra is not None:
        parts += [intra.units.tobytes(), intra.free.astype("<i4").tobytes()]
    return b"".join(parts)


def read_context(reader: Reader, mixtures: bool) -> CodedContext:
    """Inverse of :func:`write_context`; the hash grid is empty.

    Args:
        reader: reader of the section.
        mixtures: whether features are mixtures.
    """
    features, offsets, hidden, volume, planes, volume_log2, planes_log2, values = reader.unpack("8H")
    levels = reader.unpack(f"{volume + planes}H")
    grid = GridConfig(levels[:volume], levels[volume:], volume_log2, planes_log2, values)
    chunk, between = reader.unpack("2H") if mixtures else (0, 0)
    if mixtures and not (chunk and (0 < between <= MOST_INPUTS or chunk >= features)):
        raise ValueError(f"chunks of {chunk} features with {between} hidden units between them")
    steps = reader.unpack("4f")
    config = ContextConfig(features, offsets, steps, grid, hidden, chunk)

    def layer(rows: int, inputs: int) -> IntegerLayer:
        weight = np.frombuffer(reader.take(rows * inputs), np.int8).reshape(rows, inputs)
        exponent = np.frombuffer(reader.take(rows), np.int8)
        bias = np.frombuffer(reader.take(4 * rows), "<i4").astype(np.int32)
        return IntegerLayer(weight, exponent, bias).checked()

    first = layer(hidden, grid.outputs)
    rows = 2 * config.total + len(config.widths) + (features if mixtures else 0)
    head = IntegerHead(first, layer(rows, hidden), config.widths)
    intra = None
    if mixtures:
        widths = config.chunks
        layers = tuple(
            (layer(between, sum(widths[:at])), layer(3 * widths[at], between)) for at in range(1, len(widths))
        )
        units = np.frombuffer(reader.take(features), np.int8)
        free = np.frombuffer(reader.take(12 * widths[0]), "<i4").astype(np.int32)
        intra = IntegerIntra(widths, units, free, layers).checked()
    return CodedContext(config, head, np.zeros((0, values), np.bool_), intra)


def write_grid(context: CodedContext) -> bytes:
    """Bytes of the hash grid of a context model."""
    encoder, at, shares = Encoder(), 0, []
    for _, _, entries in context.config.grid.levels:
        shares.append(write_bits(encoder, context.positive[at : at + entries]))
        at += entries
    return np.array(shares, "<u2").tobytes() + encoder.finish()


def read_grid(reader: Reader, context: CodedContext) -> CodedContext:
    """The context model with the hash grid of :func:`write_grid`."""
    grid = context.config.grid
    shares = reader.unpack(f"{len(grid.levels)}H")
    decoder = Decoder(reader.rest())
    bits = [
        read_bits(decoder, entries * grid.features, share)
        for (_, _, entries), share in zip(grid.levels, shares, strict=True)
    ]
    decoder.finish()
    return replace(context, positive=np.concatenate(bits).reshape(-1, grid.features))


def write_scene(name: str, anchors: int, length: int, parameters: Arrays) -> bytes:
    """Bytes of a scene's header: its name, number of anchors, bytes of their positions, and parameters."""
    sizes = np.array([anchors, length], "<u4").tobytes()
    return _write_text(name) + sizes + write_arrays(parameters, "float32")


def read_scene(reader: Reader) -> tuple[str, int, int, Arrays]:
    """Inverse of :func:`write_scene`."""
    name = _read_text(reader)
    anchors, length = reader.unpack("2I")
    return name, anchors, length, read_arrays(reader)


def write_positions(codes: NDArray[np.int64], grid: PositionGrid, plain: bool) -> tuple[bytes, int]:
    """Bytes of (N, 3) positions, and how many of these are no padding."""
    write = write_plain_positions if plain else encode_positions
    data = write(codes, grid) if len(codes) else b""
    return data + bytes(max(-(-len(codes) // ANCHORS_PER_BYTE) - len(data), 0)), len(data)


def read_positions(
    reader: Reader, anchors: int, length: int, grid: PositionGrid, plain: bool
) -> NDArray[np.int64]:
    """Inverse of :func:`write_positions`: (N, 3) codes."""
    payload = reader.rest()
    if anchors > ANCHORS_PER_BYTE * len(payload) or length > len(payload):
        raise ValueError(f"{anchors} anchors in {len(payload)} bytes")
    if any(payload[length:]):
        raise ValueError("its padding is not zero")
    if anchors == 0:
        return np.zeros((0, 3), np.int64)
    decode = read_plain_positions if plain else decode_positions
    return decode(payload[:length], anchors, grid)


def write_attributes(quantised: Quantised, columns: slice, present: Present | None) -> tuple[bytes, float]:
    """Bytes of some columns and their ideal bits."""
    if quantised.symbols is None or quantised.coding is None:
        return np.ascontiguousarray(quantised.scene.values[:, columns]).astype("<f4").tobytes(), 0.0
    if quantised.intra is not None and columns.start == 0:
        return write_features(quantised.symbols[:, columns], quantised.coding, quantised.intra)
    return write_symbols(quantised.symbols, quantised.coding, columns, present)


def read_attributes(
    reader: Reader,
    coding: Coding | None,
    anchors: int,
    columns: slice,
    present: Present | None,
    intra: IntegerIntra | None,
) -> NDArray:
    """Inverse of :func:`write_attributes`: symbols, or values where there is no context."""
    if coding is not None and intra is not None:
        return read_features(reader, coding, intra)
    if coding is not None:
        return read_symbols(reader, coding, columns, present)
    width = columns.stop - columns.start
    values = np.frombuffer(reader.take(4 * anchors * width), "<f4").astype(np.float32)
    if not np.isfinite(values).all():
        raise ValueError("a value that is not finite")
    return values.reshape(anchors, width)


def _write_text(text: str) -> bytes:
    data = text.encode()
    return np.array([len(data)], "<u4").tobytes() + data


def _read_text(reader: Reader) -> str:
    (length,) = reader.unpack("I")
    return reader.take(length).decode()
