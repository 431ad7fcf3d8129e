"""The container of a bitstream (docs/reference/bitstream.md): a table of sections with lengths and checksums.

A reader never passes the announced ends, checks every announced length against the data, and never parses a
section with a wrong checksum.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from econgs_bench.datasets.errors import DataError

MAGIC = b"\x89ECONGS\n"
VERSIONS = (1, 2, 3, 4)
"""Since the second, offsets of culled Gaussians may have no symbols; in the third, positions are plain; in
the fourth, features are mixtures."""
MOST_SECTIONS = 4096
LIMIT = (1 << 32) - 1  # bytes of a section
_HEADER = struct.Struct("<8sHHQ")  # magic, version, sections, length of the whole
_ENTRY = struct.Struct("<BBHII")  # kind, zero, scene, length, checksum
_CHECK = struct.Struct("<I")  # of header and table

ANEW = "Fetch or encode it anew"


class Kind(IntEnum):
    """Kind of a section; those from ``SCENE`` on belong to one scene."""

    GROUP = 1
    CONTEXT = 2
    GRID = 3
    DECODERS = 4
    SCENE = 16
    POSITIONS = 17
    FEATURES = 18
    SCALINGS = 19
    OFFSETS = 20
    MASKS = 21


@dataclass(frozen=True)
class Section:
    """A part of a stream: its kind, the scene it belongs to (0 for parts of the group) and its bytes."""

    kind: Kind
    scene: int
    payload: bytes


def overhead(sections: int) -> int:
    """Bytes of the container itself."""
    return _HEADER.size + sections * _ENTRY.size + _CHECK.size


def write_container(sections: Sequence[Section], version: int = VERSIONS[0]) -> bytes:
    """The bytes of a container."""
    if len(sections) > MOST_SECTIONS:
        raise ValueError(f"{len(sections)} sections; a container has at most {MOST_SECTIONS}")
    if any(len(one.payload) > LIMIT or one.scene > 65535 for one in sections):
        raise ValueError("a section of 4 GiB or more, or more than 65536 scenes")
    whole = overhead(len(sections)) + sum(len(one.payload) for one in sections)
    head = _HEADER.pack(MAGIC, version, len(sections), whole)
    for one in sections:
        head += _ENTRY.pack(one.kind, 0, one.scene, len(one.payload), zlib.crc32(one.payload))
    return b"".join([head, _CHECK.pack(zlib.crc32(head)), *(one.payload for one in sections)])


def read_container(data: bytes, what: str) -> list[Section]:
    """The sections of a container, all checked.

    Args:
        data: all bytes.
        what: file or object, for messages.

    Raises:
        DataError: the data are foreign, of another version, truncated, too long or damaged.
    """
    if len(data) < _HEADER.size or not data.startswith(MAGIC):
        if MAGIC.startswith(data[: len(MAGIC)]):
            raise DataError(what, f"it ends after {len(data)} bytes, within its header", ANEW)
        raise DataError(
            what, "it is not a stream of this program (its first bytes differ)", "Name another file"
        )
    _, version, count, whole = _HEADER.unpack_from(data)
    if version not in VERSIONS:
        # The checksum cannot distinguish damage from the layout of a later version.
        known = f"versions {VERSIONS[0]} to {VERSIONS[-1]}"
        reason = f"it has format version {version}; this program reads {known}"
        raise DataError(what, reason, "Update the program, or encode it anew")
    if count > MOST_SECTIONS:
        raise DataError(what, f"it announces {count} sections, more than {MOST_SECTIONS}", ANEW)
    start = overhead(count)
    if len(data) < start:
        raise DataError(what, f"it ends after {len(data)} bytes, within its table of sections", ANEW)
    (expected,) = _CHECK.unpack_from(data, start - _CHECK.size)
    if zlib.crc32(data[: start - _CHECK.size]) != expected:
        raise DataError(what, "its table of sections is damaged (checksum)", ANEW)
    if len(data) != whole:
        state = "truncated" if len(data) < whole else "followed by something else"
        raise DataError(what, f"it has {len(data)} bytes where {whole} were announced: it is {state}", ANEW)
    sections, keys = [], set()
    for index in range(count):
        kind, zero, scene, length, check = _ENTRY.unpack_from(data, _HEADER.size + index * _ENTRY.size)
        if zero or kind not in Kind.__members__.values():
            raise DataError(what, f"section {index} is of an unknown kind ({kind})", ANEW)
        if (kind, scene) in keys:
            raise DataError(what, f"section {Kind(kind).name} of scene {scene} comes twice", ANEW)
        keys.add((kind, scene))
        payload = data[start : start + length]
        if len(payload) != length:
            raise DataError(what, f"section {Kind(kind).name} of scene {scene} reaches beyond the end", ANEW)
        if zlib.crc32(payload) != check:
            raise DataError(what, f"section {Kind(kind).name} of scene {scene} is damaged (checksum)", ANEW)
        sections.append(Section(Kind(kind), scene, payload))
        start += length
    if start != len(data):
        raise DataError(what, "bytes beyond its last section", ANEW)
    return sections


class Reader:
    """Reader of fixed-size fields of a section, never beyond its end."""

    def __init__(self, section: Section, what: str) -> None:
        self._data = section.payload
        self._at = 0
        self._name = f"section {section.kind.name} of scene {section.scene}"
        self._what = what

    def fail(self, reason: str) -> DataError:
        """Error that names the section."""
        return DataError(self._what, f"{self._name}: {reason}", ANEW)

    def take(self, count: int) -> bytes:
        """The next ``count`` bytes."""
        if count < 0 or count > len(self._data) - self._at:
            raise self.fail(f"it ends before byte {self._at + count}")
        part = self._data[self._at : self._at + count]
        self._at += count
        return part

    def unpack(self, layout: str) -> tuple:
        """The next fields, little-endian, by :mod:`struct`'s letters."""
        form = "<" + layout
        return struct.unpack(form, self.take(struct.calcsize(form)))

    def rest(self) -> bytes:
        """The remaining bytes."""
        return self.take(len(self._data) - self._at)

    def finish(self) -> None:
        """Check that no bytes remain."""
        if self._at != len(self._data):
            raise self.fail(f"{len(self._data) - self._at} bytes too many")
