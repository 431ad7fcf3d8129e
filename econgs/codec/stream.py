"""Scenes that share decoders and a context model, as one self-contained stream of bytes and back.

``decode_group(encode_group(group).data)`` gives the attributes rounded to multiples of their steps, bit for
bit the same wherever it runs: whole-number symbols times steps from a table, in float32.
docs/reference/bitstream.md describes the format.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.econgs.codec.arrays import Arrays, Precision, read_arrays, round_arrays, write_arrays
from econgs_bench.econgs.codec.container import (
    ANEW,
    VERSIONS,
    Kind,
    Reader,
    Section,
    overhead,
    read_container,
    write_container,
)
from econgs_bench.econgs.codec.culling import kept_offsets
from econgs_bench.econgs.codec.group import CodedContext, GroupAttributes, SceneAttributes
from econgs_bench.econgs.codec.quantiser import quantise
from econgs_bench.econgs.codec.sections import (
    Header,
    Parts,
    read_attributes,
    read_context,
    read_grid,
    read_header,
    read_positions,
    read_scene,
    write_attributes,
    write_context,
    write_grid,
    write_header,
    write_positions,
    write_scene,
)
from econgs_bench.econgs.codec.symbols import (
    SCALINGS,
    Present,
    columns_of,
    present_of,
    read_masks,
    write_masks,
)

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
    shared = [Section(Kind.GROUP, 0, write_header(Header.of(group)))]
    if group.context is not None:
        shared.append(Section(Kind.CONTEXT, 0, write_context(group.context)))
        shared.append(Section(Kind.GRID, 0, write_grid(group.context)))
    shared.append(Section(Kind.DECODERS, 0, write_arrays(group.decoders, weights)))
    sections, ideal = list(shared), 0.0
    columns_each = columns_of(group.scenes[0].features.shape[1], group.scenes[0].offsets.shape[1])
    for index, scene in enumerate(group.scenes):
        quantised = quantise(scene, group)
        positions, length = write_positions(quantised.codes, group.grid, group.plain_positions)
        header = write_scene(scene.name, len(scene), length, scene.parameters)
        sections.append(Section(Kind.SCENE, index, header))
        sections.append(Section(Kind.POSITIONS, index, positions))
        if quantised.scene.masks is not None:
            sections.append(Section(Kind.MASKS, index, write_masks(quantised.scene.masks)))
        present_each = present_of(quantised.present)
        for kind, columns, present in zip(_KINDS, columns_each, present_each, strict=True):
            payload, bits = write_attributes(quantised, columns, present)
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

    grid, parts, count, width, many, metadata = _guarded(reader(Kind.GROUP), read_header)
    plain = Parts.PLAIN_POSITIONS in parts
    context: CodedContext | None = None
    if Parts.CONTEXT in parts:
        context = _guarded(reader(Kind.CONTEXT), partial(read_context, mixtures=Parts.MIXTURES in parts))
        if (context.config.features, context.config.offsets) != (width, many):
            raise DataError(what, "its context model is for other attributes", ANEW)
        context = _guarded(reader(Kind.GRID), partial(read_grid, context=context))
    decoders = _guarded(reader(Kind.DECODERS), read_arrays)
    scenes = []
    for index in range(count):
        name, anchors, length, parameters = _guarded(reader(Kind.SCENE, index), read_scene)
        read_places = partial(read_positions, anchors=anchors, length=length, grid=grid, plain=plain)
        codes = _guarded(reader(Kind.POSITIONS, index), read_places)
        coding = None if context is None else context.coding(codes, grid)
        masks: Present | None = None
        if Parts.MASKS in parts:
            masks = _guarded(reader(Kind.MASKS, index), partial(read_masks, anchors=anchors, many=many))
        read = partial(read_attributes, coding=coding, anchors=anchors)
        steps = None if context is None or coding is None else context.steps(coding)
        present, each = masks, list[NDArray[Any]]()
        for kind, columns in zip(_KINDS, columns_of(width, many), strict=True):
            if kind == Kind.OFFSETS and Parts.CULLING in parts:
                present = _kept(decoders, each[0], parameters, many, what)
            coded = None if kind != Kind.OFFSETS or present is None else present.repeat(3, 1)
            intra = context.intra if context is not None and kind == Kind.FEATURES else None
            part = _guarded(reader(kind, index), partial(read, columns=columns, present=coded, intra=intra))
            each.append(part if steps is None else part.astype(np.float32) * steps[:, columns])
        none = [np.empty(one, np.float32) for one in ((0, width), (0, SCALINGS), (0, many, 3))]
        empty = SceneAttributes(name, grid.positions(codes), none[0], none[1], none[2], parameters, masks)
        scenes.append(empty.with_values(np.concatenate(each, 1)))
    if sections:
        raise DataError(what, "it has sections that belong to nothing", ANEW)
    culling = Parts.CULLING in parts
    return GroupAttributes(tuple(scenes), grid, context, decoders, metadata, culling, plain)


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
