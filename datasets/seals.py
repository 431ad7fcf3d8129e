"""Texts of JSON objects with a checksum as their first value: damage never passes for other numbers."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

_HEAD = re.compile(r'\{"crc32": "([0-9a-f]{8})",')
_PIECE = 2**20
SEALED_SINCE = "2026-11-26"
"""Day since which every record has a checksum."""


def sealed(text: str) -> str:
    """The text of an object that is not empty, with the checksum of all that follows it."""
    return f'{{"crc32": "{zlib.crc32(text[1:].encode()):08x}",{text[1:]}'


def unsealed(text: str) -> str:
    """The text as it was before :func:`sealed`; one without a checksum, of an earlier version, as it is.

    Raises:
        ValueError: the checksum differs.
    """
    head = _HEAD.match(text)
    if head is None:
        return text
    if f"{zlib.crc32(text[head.end() :].encode()):08x}" != head[1]:
        raise ValueError("its checksum differs")
    return "{" + text[head.end() :]


def is_sealed(file: Path) -> bool:
    """Whether a text begins with a checksum."""
    with file.open("rb") as stream:
        return _HEAD.match(stream.read(64).decode("ascii", "replace")) is not None


def checksum(file: Path) -> str:
    """CRC-32 of a file, read in pieces."""
    total = 0
    with file.open("rb") as stream:
        while piece := stream.read(_PIECE):
            total = zlib.crc32(piece, total)
    return f"{total:08x}"
