"""DICOM's data elements, as far as SimpleITK hides them.

SimpleITK passes on no element within a sequence, where enhanced multi-frame files keep position, distances
and rescale of each frame (DICOM PS3.3 C.7.6.16), and says no place of an element in its file.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from dataclasses import dataclass, field
from typing import Literal

ORIENTATION, POSITION = 0x00200037, 0x00200032
SPACING, BETWEEN, THICKNESS = 0x00280030, 0x00180088, 0x00180050
INTERCEPT, SLOPE = 0x00281052, 0x00281053
TIME, SEGMENT = 0x00209128, 0x0062000B
PHOTOMETRIC, COUNTED = 0x00280004, 0x00280009
TABLE = 0x00283000
"""The Modality LUT: a table from stored values to those that are meant, in place of a rescale."""

_SHARED, _EACH = 0x52009229, 0x52009230
_MACROS = frozenset({0x00209113, 0x00209116, 0x00209111, 0x00289110, 0x00289145, 0x0062000A})
"""Sequences of functional groups: position, orientation, content of a frame, measures, values, segments."""
_DECIMAL = frozenset({ORIENTATION, POSITION, SPACING, BETWEEN, THICKNESS, INTERCEPT, SLOPE})
_WHOLE = frozenset({TIME, SEGMENT})
_KEPT = _DECIMAL | _WHOLE | {PHOTOMETRIC, COUNTED}
_PIXELS = 0x7FE00008
_ITEM, _ITEM_END, _SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
_LONG = frozenset((b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"))
_OPEN = 0xFFFFFFFF
"""Length of a sequence or item with an end of its own."""
_DEPTH = 16
_IMPLICIT, _BIG, _DEFLATED = b"1.2.840.10008.1.2", b"1.2.840.10008.1.2.2", b"1.2.840.10008.1.2.1.99"
_TAG, _SHORT, _INT = struct.Struct("<HH"), struct.Struct("<H"), struct.Struct("<I")

Bytes = bytes | mmap.mmap
Values = dict[int, tuple[float, ...]]


class Malformed(ValueError):
    """A file does not follow DICOM's encoding."""


@dataclass
class Elements:
    """What a file says of its frames.

    Attributes:
        shared: values by tag of all frames of a file with functional groups.
        frames: values by tag of each frame, those of all included; empty where a file has none of its frames.
        counted: tags of what tells frames apart (Frame Increment Pointer).
        places: tag, first byte and length of the elements that change values of pixels.
        deflated: these bytes are of the inflated data.
        table: whether the values are indices into a Modality LUT.
    """

    shared: Values = field(default_factory=dict)
    frames: list[Values] = field(default_factory=list)
    counted: tuple[int, ...] = ()
    places: list[tuple[int, int, int]] = field(default_factory=list)
    deflated: bool = False
    table: bool = False


def numbers(text: str) -> tuple[float, ...]:
    """Decimal numbers between backslashes; none if one of them is missing or no number."""
    try:
        return tuple(float(part) for part in text.strip(" \0").split("\\"))
    except ValueError:
        return ()


def inflated(data: Bytes) -> bytes | None:
    """The data set of a deflated file (PS3.5 A.5); None for other files.

    Raises:
        Malformed: the compressed data have no end.
    """
    start, syntax = _begin(data)
    if syntax != _DEFLATED:
        return None
    stream = zlib.decompressobj(-15)
    try:
        values = stream.decompress(data[start:])
    except zlib.error as error:
        raise Malformed(str(error)) from error
    if not stream.eof:
        raise Malformed("its compressed data have no end")
    return values


def byte_order(data: Bytes) -> Literal["little", "big"]:
    """The order of bytes of the numbers in a file.

    Raises:
        Malformed: the meta information cannot be read.
    """
    return "big" if _begin(data)[1] == _BIG else "little"


def packed(tag: int, order: Literal["little", "big"]) -> bytes:
    """A tag as it stands in a file."""
    return (tag >> 16).to_bytes(2, order) + (tag & 0xFFFF).to_bytes(2, order)


def names_table(data: Bytes) -> bool:
    """Whether a file may have a Modality LUT: its tag is among the bytes."""
    return (inflated(data) or data).find(packed(TABLE, byte_order(data))) >= 0


def read(data: Bytes) -> Elements:
    """The elements before the pixels of a file.

    Raises:
        Malformed: an element ends beyond the file, or is of no known form.
    """
    try:
        start, syntax = _begin(data)
        if syntax == _BIG:
            raise Malformed("its byte order is big-endian")
        explicit = syntax != _IMPLICIT if syntax else data[start + 4 : start + 6].isupper()
        values = inflated(data)
        if values is None:
            return _Walk(data, explicit).elements(start)
        elements = _Walk(values, True).elements(0)
    except struct.error as error:
        raise Malformed("its last element is incomplete") from error
    elements.deflated = True
    return elements


def _begin(data: Bytes) -> tuple[int, bytes]:
    """First byte after the meta information (group 2), and the encoding that it names."""
    at, syntax = 132 if data[128:132] == b"DICM" else 0, b""
    walk = _Walk(data, True)
    while data[at : at + 2] == b"\2\0":
        tag, _, start, length = walk.head(at)
        at = start + length
        if tag == 0x00020010:
            syntax = bytes(data[start:at]).rstrip(b" \0")
    return at, syntax


class _Walk:
    """A walk over the elements of a file: it visits each at most once, and skips what it does not need."""

    def __init__(self, data: Bytes, explicit: bool) -> None:
        self._data, self._explicit = data, explicit
        self._groups: dict[int, list[Values]] = {}
        self._places: list[tuple[int, int, int]] = []
        self._table = False

    def elements(self, at: int) -> Elements:
        """Those of the whole file, from its first byte."""
        values: Values = {}
        self._set(at, len(self._data), 0, values)
        shared = self._groups.get(_SHARED) or [{}]
        if len(shared) > 1:
            raise Malformed("its shared functional groups are several items")
        frames = [shared[0] | each for each in self._groups.get(_EACH, [])]
        counted = tuple(int(tag) for tag in values.get(COUNTED, ()))
        return Elements(shared[0], frames, counted, self._places, table=self._table)

    def head(self, at: int) -> tuple[int, bytes, int, int]:
        """Tag, type, first byte of the value, and its length."""
        group, element = _TAG.unpack_from(self._data, at)
        tag = group << 16 | element
        if group == 0xFFFE or not self._explicit:
            return tag, b"", at + 8, _INT.unpack_from(self._data, at + 4)[0]
        kind = bytes(self._data[at + 4 : at + 6])
        if not re.fullmatch(b"[A-Z]{2}", kind):
            raise Malformed(f"its element ({group:04x},{element:04x}) has no type")
        if kind in _LONG:
            return tag, kind, at + 12, _INT.unpack_from(self._data, at + 8)[0]
        return tag, kind, at + 8, _SHORT.unpack_from(self._data, at + 6)[0]

    def _set(self, at: int, end: int, depth: int, values: Values | None) -> int:
        """Walk over a data set or an item; its values go into ``values``. Returns where it ends."""
        if depth > _DEPTH:
            raise Malformed("its sequences are nested too deeply")
        while at < end:
            tag, kind, start, length = self.head(at)
            if depth == 0 and tag >= _PIXELS:
                break
            if tag == _ITEM_END:
                return start
            if length != _OPEN and start + length > end:
                raise Malformed("an element ends beyond its end")
            self._table |= depth == 0 and tag == TABLE and length > 0
            within = values is not None and tag in (_MACROS if depth else (_SHARED, _EACH))
            if within or length == _OPEN:
                before = self._explicit
                self._explicit = before and kind != b"UN"  # which is encoded without types (PS3.5 6.2.2)
                stop = end if length == _OPEN else start + length
                at = self._sequence(tag, start, stop, length == _OPEN, depth, values if within else None)
                self._explicit = before
                continue
            if values is not None and tag in _KEPT:
                self._keep(tag, start, length, values)
            at = start + length
        return at

    def _sequence(
        self, tag: int, at: int, stop: int, is_open: bool, depth: int, values: Values | None
    ) -> int:
        """Walk over the items of a sequence, or over fragments of pixels. Returns where it ends."""
        if tag in (_SHARED, _EACH) and values is not None and self._groups.setdefault(tag, []):
            raise Malformed("it has functional groups twice")
        count = 0
        while at < stop:
            mark, _, start, length = self.head(at)
            if mark == _SEQUENCE_END and is_open:
                return start
            if mark != _ITEM or (length != _OPEN and start + length > stop):
                raise Malformed("a sequence ends within an item")
            count += 1
            end = stop if length == _OPEN else start + length
            if values is None:
                at = end if length != _OPEN else self._set(start, end, depth + 1, None)
                continue
            into = values
            if tag in (_SHARED, _EACH):
                into = {}
                self._groups[tag].append(into)
            elif count > 1:
                raise Malformed(f"its sequence ({tag >> 16:04x},{tag & 0xFFFF:04x}) has several items")
            after = self._set(start, end, depth + 1, into)
            at = after if length == _OPEN else end
        if is_open:
            raise Malformed("a sequence has no end")
        return stop

    def _keep(self, tag: int, start: int, length: int, values: Values) -> None:
        if tag in values:
            raise Malformed(f"its element ({tag >> 16:04x},{tag & 0xFFFF:04x}) is there twice")
        if tag in (PHOTOMETRIC, SLOPE, INTERCEPT):
            self._places.append((tag, start, length))
        value = bytes(self._data[start : start + min(length, 200)])
        if tag == COUNTED:
            pairs = struct.iter_unpack("<HH", value[: len(value) // 4 * 4])
            values[tag] = tuple(float(group << 16 | element) for group, element in pairs)
        elif tag in _WHOLE:
            values[tag] = (float(int.from_bytes(value[:4], "little")),)
        elif tag in _DECIMAL and (several := numbers(value.decode("latin-1"))):
            values[tag] = several
