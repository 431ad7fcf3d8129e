"""Scenes that share decoders and a context model, as one self-contained stream of bytes and back.

``decode_group(encode_group(group).data)`` gives the attributes rounded to multiples of their steps, bit for
bit the same wherever it runs: whole-number symbols times steps from a table, in float32.
docs/reference/bitstream.md describes the format.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.context.arrays import Arrays, Precision, read_arrays, round_arrays, write_arrays
from econgs_bench.econgs.context.coder import SYMBOL_LIMIT, Decoder, Encoder, read_bits, write_bits
from econgs_bench.econgs.context.container import (
    ANEW,
    VERSIONS,
    Kind,
    Reader,
    Section,
    overhead,
    read_container,
    write_container,
)
from econgs_bench.econgs.context.culling import kept_offsets
from econgs_bench.econgs.context.hash_grid import GridConfig, interpolate, make_lookup
from econgs_bench.econgs.context.integer import (
    MOST_INPUTS,
    Coding,
    IntegerHead,
    IntegerIntra,
    IntegerLayer,
    joined,
    step_sizes,
    whole_values,
)
from econgs_bench.econgs.context.model import MOST_ELEMENTS, ContextConfig, ContextModel
from econgs_bench.econgs.context.positions import (
    PositionGrid,
    decode_positions,
    encode_positions,
    morton_order,
    read_plain_positions,
    write_plain_positions,
)
from econgs_bench.econgs.context.symbols import (
    Present,
    columns_of,
    present_of,
    read_features,
    read_masks,
    read_symbols,
    write_features,
    write_masks,
    write_symbols,
)

ANCHORS_PER_BYTE = 4  # maximum number of anchors per byte of positions: bounds a reader's allocations
_CONTEXT, _MASKS, _CULLING, _PLAIN_POSITIONS, _MIXTURES = 1, 2, 4, 8, 16
_MIXED_KINDS = (_CONTEXT | _MIXTURES, _CONTEXT | _MASKS | _MIXTURES)
_CODED_KINDS = (0, _CONTEXT, _MASKS, _CONTEXT | _MASKS, _CONTEXT | _CULLING, *_MIXED_KINDS)
_ALL_KINDS = (*_CODED_KINDS, *(kinds | _PLAIN_POSITIONS for kinds in _CODED_KINDS))
_PIECE = 8192  # anchors per lookup
_KINDS = (Kind.FEATURES, Kind.SCALINGS, Kind.OFFSETS)
_PARTS = {
    Kind.GROUP: "metadata",
    Kind.CONTEXT: "context head",
    Kind.GRID: "hash grid",
    Kind.DECODERS: "decoders",
    Kind.SCENE: "scene parameters",
    Kind.POSITIONS: "positions",
    Kind.FEATURES: "features",
    Kind.SCALINGS: "scalings",
    Kind.OFFSETS: "offsets",
    Kind.MASKS: "masks",
}


@dataclass(frozen=True)
class CodedContext:
    """A context model in its coded form.

    Attributes:
        config: sizes; steps rounded to float32.
        head: integer weights.
        positive: (entries, features) True for the bits +1 of the hash grid.
        intra: networks between features; only where these are mixtures.
    """

    config: ContextConfig
    head: IntegerHead
    positive: NDArray[np.bool_]
    intra: IntegerIntra | None = None

    @classmethod
    def of(cls, model: ContextModel) -> CodedContext:
        """Coded form of a trained model on any device."""
        a, b, c, d = (float(np.float32(one)) for one in model.config.steps)
        positive = (model.grid.table.detach() >= 0.0).cpu().numpy()
        config = replace(model.config, steps=(a, b, c, d))
        return cls(config, model.integer_head(), positive, model.integer_intra())

    def coding(self, codes: NDArray[np.int64], grid: PositionGrid) -> Coding:
        """Coding parameters of anchors at (N, 3) position codes."""
        table = torch.from_numpy(np.where(self.positive, np.float32(1), np.float32(-1)))
        parts = []
        with torch.no_grad():
            for begin in range(0, max(len(codes), 1), _PIECE):
                piece = torch.from_numpy(codes[begin : begin + _PIECE])
                lookup = make_lookup(self.config.grid, piece, grid.extent)
                values, _ = interpolate(table, lookup)
                parts.append(self.head(whole_values(values)))
        return joined(parts)

    def steps(self, coding: Coding) -> NDArray[np.float32]:
        """(N, D) step of every element."""
        each = [
            step_sizes(coding.steps[:, group], base)[:, None].repeat(width, 1)
            for group, (base, width) in enumerate(zip(self.config.steps, self.config.widths, strict=True))
        ]
        return np.concatenate(each, 1)


@dataclass(frozen=True)
class SceneAttributes:
    """One scene: N anchors and the scene's own parameters.

    Attributes:
        name: name of the scene.
        positions: (N, 3) float32, on the group's grid of positions.
        features: (N, F) float32.
        scalings: (N, 6) float32, activated.
        offsets: (N, K, 3) float32.
        parameters: further float32 arrays by name: palette, embedding.
        masks: (N, K) True for existing offsets; the others become 0 and take no bits. None: all exist.
    """

    name: str
    positions: NDArray[np.float32]
    features: NDArray[np.float32]
    scalings: NDArray[np.float32]
    offsets: NDArray[np.float32]
    parameters: Arrays = field(default_factory=dict)
    masks: NDArray[Any] | None = None

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def values(self) -> NDArray[np.float32]:
        """(N, D): features, scalings, offsets."""
        flat = self.offsets.reshape(len(self), self.offsets.shape[1] * self.offsets.shape[2])
        return np.concatenate([self.features, self.scalings, flat], 1, dtype=np.float32)


@dataclass(frozen=True)
class GroupAttributes:
    """Scenes that share decoders and a context model.

    Attributes:
        scenes: one or more scenes with equal numbers of features and offsets.
        grid: grid of the anchor positions.
        context: None stores attributes as plain float32.
        decoders: weights of the shared decoders by name, float32.
        metadata: JSON object (options for the renderer).
        culling: whether offsets of Gaussians that the decoder ``opacity`` culls become 0 and take no bits
            (:mod:`.econgs.context.culling`); only with context and without masks.
        plain_positions: whether positions are stored as float32, not coded.
    """

    scenes: tuple[SceneAttributes, ...]
    grid: PositionGrid
    context: CodedContext | None = None
    decoders: Arrays = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)
    culling: bool = False
    plain_positions: bool = False

    @property
    def masked(self) -> bool:
        """Whether the scenes have masks."""
        return self.scenes[0].masks is not None

    @property
    def mixtures(self) -> bool:
        """Whether features are mixtures."""
        return self.context is not None and self.context.intra is not None


@dataclass(frozen=True)
class Encoded:
    """A stream and its contents.

    Attributes:
        data: the bytes.
        ledger: bytes by part, summing to ``len(data)``.
        ideal_bits: cross-entropy of the attributes under their coding tables; 0 without context.
    """

    data: bytes
    ledger: dict[str, int]
    ideal_bits: float

    @property
    def attribute_bits(self) -> int:
        """Bits of features, scalings and offsets, for comparison with :attr:`ideal_bits`."""
        return 8 * sum(self.ledger[_PARTS[kind]] for kind in _KINDS)


@dataclass(frozen=True)
class _Quantised:
    """A scene in Morton order: position codes, symbols (N, D) and their coding (None without context).

    Of the offsets, those that are present have symbols; None: all.
    """

    scene: SceneAttributes
    codes: NDArray[np.int64]
    symbols: NDArray[np.int32] | None
    coding: Coding | None
    present: Present | None
    intra: IntegerIntra | None = None


def _quantise(scene: SceneAttributes, group: GroupAttributes) -> _Quantised:
    codes = _checked(scene, group)
    order = morton_order(codes)
    codes = codes[order]
    arrays = (scene.features, scene.scalings, scene.offsets)
    features, scalings, offsets = (np.ascontiguousarray(one[order], np.float32) for one in arrays)
    masks = None if scene.masks is None else scene.masks[order]
    if masks is not None:
        offsets = np.where(masks[..., None], offsets, np.float32(0))
    ordered = replace(
        scene,
        positions=group.grid.positions(codes),
        features=features,
        scalings=scalings,
        offsets=offsets,
        parameters={name: np.asarray(one, np.float32) for name, one in scene.parameters.items()},
        masks=masks,
    )
    if group.context is None:
        return _Quantised(ordered, codes, None, None, masks)
    coding = group.context.coding(codes, group.grid)
    steps = group.context.steps(coding)
    symbols = np.floor(ordered.values.astype(np.float64) / steps + 0.5)
    if symbols.size and np.abs(symbols).max() >= SYMBOL_LIMIT:
        worst = np.unravel_index(np.abs(symbols).argmax(), symbols.shape)
        raise DataError(
            f"scene {scene.name}",
            f"an attribute ({worst[1]}) is {ordered.values[worst]:g}, over 2^24 steps of {steps[worst]:g}",
            "Training has diverged, or the base step is too small",
        )
    whole, (width, many) = symbols.astype(np.int32), (features.shape[1], offsets.shape[1])
    if group.culling:
        values = whole[:, :width].astype(np.float32) * steps[:, :width]
        masks = kept_offsets(group.decoders, values, ordered.parameters)
        whole[:, width + 6 :][~masks.repeat(3, 1)] = 0
    rounded = _with_values(ordered, whole.astype(np.float32) * steps, width, many)
    return _Quantised(rounded, codes, whole, coding, masks, group.context.intra)


def _with_values(
    scene: SceneAttributes, values: NDArray[np.float32], width: int, many: int
) -> SceneAttributes:
    return replace(
        scene,
        features=values[:, :width],
        scalings=values[:, width : width + 6],
        offsets=values[:, width + 6 :].reshape(len(values), many, 3),
    )


def _checked(scene: SceneAttributes, group: GroupAttributes) -> NDArray[np.int64]:
    """Position codes of a scene, after checks."""
    count = len(scene)
    first = group.scenes[0]
    width, many = first.features.shape[1], first.offsets.shape[1]
    shapes = {
        "positions": (count, 3),
        "features": (count, width),
        "scalings": (count, 6),
        "offsets": (count, many, 3),
    }
    remedy = "Training has gone wrong before"
    for name, shape in shapes.items():
        array = getattr(scene, name)
        if array.shape != shape:
            raise DataError(f"scene {scene.name}", f"{name} have shape {array.shape}, not {shape}", remedy)
        if not np.isfinite(array).all():
            raise DataError(f"scene {scene.name}", f"{name} hold a value that is not finite", remedy)
    if scene.masks is not None and scene.masks.shape != (count, many):
        reason = f"masks have shape {scene.masks.shape}, not {(count, many)}"
        raise DataError(f"scene {scene.name}", reason, remedy)
    context = group.context
    if context is not None and (context.config.features, context.config.offsets) != (width, many):
        raise DataError(f"scene {scene.name}", "the context model is for other features or offsets", remedy)
    codes = group.grid.codes(scene.positions)
    away = np.abs(group.grid.positions(codes) - scene.positions)
    if (away > np.asarray(group.grid.cell) * 0.51 + 1e-5).any():
        raise DataError(f"scene {scene.name}", "an anchor lies outside the grid of positions", remedy)
    return codes


def round_group(group: GroupAttributes) -> GroupAttributes:
    """The group after encoding and decoding (decoders at full precision), without coding."""
    scenes = tuple(_quantise(scene, group).scene for scene in group.scenes)
    decoders = {name: np.asarray(one, np.float32) for name, one in group.decoders.items()}
    return replace(group, scenes=scenes, decoders=decoders)


def encode_group(group: GroupAttributes, *, weights: Precision = "float32") -> Encoded:
    """The stream of a group.

    Args:
        group: the scenes; decoding returns anchors in Morton order.
        weights: precision of the decoders' weights: "float32", "float16", or "int8" (8 bits with a scale
            per row of a matrix, 16 for vectors).

    Raises:
        DataError: values that are not finite or far beyond their steps, or an anchor outside the grid.
    """
    if not group.scenes:
        raise DataError("stream", "a group without scenes", "Add at least one")
    if group.culling and (group.context is None or group.masked):
        raise DataError("stream", "culling without context, or with masks", "Choose one of them")
    if group.culling and group.mixtures:
        raise DataError("stream", "culling with features that are mixtures", "Choose one of them")
    if any((scene.masks is not None) != group.masked for scene in group.scenes):
        raise DataError("stream", "only some of the scenes have masks", "Give masks to all or to none")
    if group.culling:  # the reader has no other decoders than these
        group = replace(group, decoders=round_arrays(group.decoders, weights))
    shared = [Section(Kind.GROUP, 0, _write_group(group))]
    if group.context is not None:
        shared.append(Section(Kind.CONTEXT, 0, _write_context(group.context)))
        shared.append(Section(Kind.GRID, 0, _write_grid(group.context)))
    shared.append(Section(Kind.DECODERS, 0, write_arrays(group.decoders, weights)))
    sections, ideal = list(shared), 0.0
    columns_each = columns_of(group.scenes[0].features.shape[1], group.scenes[0].offsets.shape[1])
    for index, scene in enumerate(group.scenes):
        quantised = _quantise(scene, group)
        write = write_plain_positions if group.plain_positions else encode_positions
        positions = write(quantised.codes, group.grid) if len(scene) else b""
        padding = bytes(max(-(-len(scene) // ANCHORS_PER_BYTE) - len(positions), 0))
        header = _text(scene.name) + np.array([len(scene), len(positions)], "<u4").tobytes()
        header += write_arrays(scene.parameters, "float32")
        sections.append(Section(Kind.SCENE, index, header))
        sections.append(Section(Kind.POSITIONS, index, positions + padding))
        if quantised.scene.masks is not None:
            sections.append(Section(Kind.MASKS, index, write_masks(quantised.scene.masks)))
        present_each = present_of(quantised.present)
        for kind, columns, present in zip(_KINDS, columns_each, present_each, strict=True):
            payload, bits = _write_attributes(quantised, columns, present)
            sections.append(Section(kind, index, payload))
            ideal += bits
    ledger = {"container": overhead(len(sections))}
    for one in sections:
        ledger[_PARTS[one.kind]] = ledger.get(_PARTS[one.kind], 0) + len(one.payload)
    newest = 3 if group.mixtures else 2 if group.plain_positions else int(group.culling)
    version = VERSIONS[newest]
    return Encoded(write_container(sections, version), ledger, ideal)


def decode_group(data: bytes, what: str = "stream") -> GroupAttributes:
    """The group of a stream, bit for bit equal to :func:`round_group`.

    Args:
        data: the whole stream.
        what: file, for messages.

    Raises:
        DataError: foreign, truncated, damaged or inconsistent data; the message names the section.
    """
    sections = {(one.kind, one.scene): one for one in read_container(data, what)}

    def reader(kind: Kind, scene: int = 0) -> Reader:
        try:
            return Reader(sections.pop((kind, scene)), what)
        except KeyError:
            raise DataError(what, f"section {kind.name} of scene {scene} is missing", ANEW) from None

    grid, kinds, count, width, many, metadata = _guarded(reader(Kind.GROUP), _read_group)
    context: CodedContext | None = None
    if kinds & _CONTEXT:
        context = _guarded(reader(Kind.CONTEXT), partial(_read_context, mixtures=bool(kinds & _MIXTURES)))
        if (context.config.features, context.config.offsets) != (width, many):
            raise DataError(what, "its context model is for other attributes", ANEW)
        context = _guarded(reader(Kind.GRID), partial(_read_grid, context=context))
    decoders = _guarded(reader(Kind.DECODERS), read_arrays)
    scenes = []
    for index in range(count):
        name, anchors, length, parameters = _guarded(reader(Kind.SCENE, index), _read_scene)
        place = reader(Kind.POSITIONS, index)
        decode = read_plain_positions if kinds & _PLAIN_POSITIONS else decode_positions
        read_places = partial(_read_positions, anchors=anchors, length=length, grid=grid, decode=decode)
        codes = _guarded(place, read_places)
        none = np.empty((0, 0), np.float32)
        places = grid.positions(codes)
        coding = None if context is None else context.coding(codes, grid)
        masks: Present | None = None
        if kinds & _MASKS:
            masks = _guarded(reader(Kind.MASKS, index), partial(read_masks, anchors=anchors, many=many))
        read = partial(_read_attributes, coding=coding, anchors=anchors)
        steps = None if context is None or coding is None else context.steps(coding)
        present, parts = masks, list[NDArray[Any]]()
        for kind, columns in zip(_KINDS, columns_of(width, many), strict=True):
            if kind == Kind.OFFSETS and kinds & _CULLING:
                present = _kept(decoders, parts[0], parameters, many, what)
            coded = None if kind != Kind.OFFSETS or present is None else present.repeat(3, 1)
            intra = context.intra if context is not None and kind == Kind.FEATURES else None
            part = _guarded(reader(kind, index), partial(read, columns=columns, present=coded, intra=intra))
            parts.append(part if steps is None else part.astype(np.float32) * steps[:, columns])
        values = np.concatenate(parts, 1)
        empty = SceneAttributes(name, places, none, none, none, parameters, masks)
        scenes.append(_with_values(empty, values, width, many))
    if sections:
        raise DataError(what, "it has sections that belong to nothing", ANEW)
    flags = bool(kinds & _CULLING), bool(kinds & _PLAIN_POSITIONS)
    return GroupAttributes(tuple(scenes), grid, context, decoders, metadata, *flags)


def _kept(
    decoders: Arrays, features: NDArray[np.float32], parameters: Arrays, many: int, what: str
) -> Present:
    try:
        kept = kept_offsets(decoders, features, parameters)
    except ValueError as error:
        raise DataError(what, str(error), ANEW) from error
    if kept.shape[1] != many:
        raise DataError(what, "its decoders cull another number of Gaussians", ANEW)
    return kept


def _guarded(reader: Reader, read: Callable[[Reader], Any]) -> Any:
    """The contents of a section; an error names the section."""
    try:
        result = read(reader)
    except (ValueError, RecursionError, UnicodeDecodeError) as error:
        raise reader.fail(str(error)) from error
    reader.finish()
    return result


def _text(text: str) -> bytes:
    data = text.encode()
    return np.array([len(data)], "<u4").tobytes() + data


def _read_text(reader: Reader) -> str:
    (length,) = reader.unpack("I")
    return reader.take(length).decode()


def _write_group(group: GroupAttributes) -> bytes:
    first = group.scenes[0]
    kinds = _CONTEXT * (group.context is not None) + _MASKS * group.masked + _CULLING * group.culling
    kinds += _PLAIN_POSITIONS * group.plain_positions + _MIXTURES * group.mixtures
    shape = (len(group.scenes), first.features.shape[1], first.offsets.shape[1], kinds)
    sizes = [*shape, *group.grid.extent]
    places = np.array([*group.grid.origin, *group.grid.cell], "<f8").tobytes()
    text = json.dumps(group.metadata, separators=(",", ":"), sort_keys=True)
    return np.array(sizes, "<u2").tobytes() + places + _text(text)


def _read_group(reader: Reader) -> tuple:
    count, width, many, kinds, *extent = reader.unpack("7H")
    numbers = reader.unpack("6d")
    if not (count and width and many and kinds in _ALL_KINDS and width + 6 + 3 * many <= MOST_ELEMENTS):
        raise ValueError(f"no scenes, features or offsets, or more than {MOST_ELEMENTS} elements per anchor")
    grid = PositionGrid(numbers[:3], numbers[3:], tuple(extent))
    metadata = json_of(_read_text(reader))
    if not isinstance(metadata, dict):
        raise ValueError("metadata is no object")
    return grid, kinds, count, width, many, metadata


def _write_context(context: CodedContext) -> bytes:
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


def _read_context(reader: Reader, mixtures: bool) -> CodedContext:
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


def _write_grid(context: CodedContext) -> bytes:
    encoder, at, shares = Encoder(), 0, []
    for _, _, entries in context.config.grid.levels:
        shares.append(write_bits(encoder, context.positive[at : at + entries]))
        at += entries
    return np.array(shares, "<u2").tobytes() + encoder.finish()


def _read_grid(reader: Reader, context: CodedContext) -> CodedContext:
    grid = context.config.grid
    shares = reader.unpack(f"{len(grid.levels)}H")
    decoder = Decoder(reader.rest())
    bits = [
        read_bits(decoder, entries * grid.features, share)
        for (_, _, entries), share in zip(grid.levels, shares, strict=True)
    ]
    decoder.finish()
    return replace(context, positive=np.concatenate(bits).reshape(-1, grid.features))


def _read_scene(reader: Reader) -> tuple[str, int, int, Arrays]:
    name = _read_text(reader)
    anchors, length = reader.unpack("2I")
    return name, anchors, length, read_arrays(reader)


def _read_positions(
    reader: Reader,
    anchors: int,
    length: int,
    grid: PositionGrid,
    decode: Callable[[bytes, int, PositionGrid], NDArray[np.int64]],
) -> NDArray[np.int64]:
    payload = reader.rest()
    if anchors > ANCHORS_PER_BYTE * len(payload) or length > len(payload):
        raise ValueError(f"{anchors} anchors in {len(payload)} bytes")
    if any(payload[length:]):
        raise ValueError("its padding is not zero")
    if anchors == 0:
        return np.zeros((0, 3), np.int64)
    return decode(payload[:length], anchors, grid)


def _write_attributes(quantised: _Quantised, columns: slice, present: Present | None) -> tuple[bytes, float]:
    """Bytes of some columns and their ideal bits."""
    if quantised.symbols is None or quantised.coding is None:
        return np.ascontiguousarray(quantised.scene.values[:, columns]).astype("<f4").tobytes(), 0.0
    if quantised.intra is not None and columns.start == 0:
        return write_features(quantised.symbols[:, columns], quantised.coding, quantised.intra)
    return write_symbols(quantised.symbols, quantised.coding, columns, present)


def _read_attributes(
    reader: Reader,
    coding: Coding | None,
    anchors: int,
    columns: slice,
    present: Present | None,
    intra: IntegerIntra | None,
) -> NDArray:
    """Symbols (or values, without context) of some columns."""
    if coding is not None and intra is not None:
        return read_features(reader, coding, intra)
    if coding is not None:
        return read_symbols(reader, coding, columns, present)
    width = columns.stop - columns.start
    values = np.frombuffer(reader.take(4 * anchors * width), "<f4").astype(np.float32)
    if not np.isfinite(values).all():
        raise ValueError("a value that is not finite")
    return values.reshape(anchors, width)
