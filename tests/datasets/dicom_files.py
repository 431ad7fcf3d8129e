"""A writer of DICOM files, element by element (PS3.5): SimpleITK writes no sequences."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

CT, ENHANCED, DOSE = (
    "1.2.840.10008.5.1.4.1.1.2",
    "1.2.840.10008.5.1.4.1.1.4.1",
    "1.2.840.10008.5.1.4.1.1.481.2",
)
CAPTURE = "1.2.840.10008.5.1.4.1.1.7"
EXPLICIT, IMPLICIT, DEFLATED = "1.2.840.10008.1.2.1", "1.2.840.10008.1.2", "1.2.840.10008.1.2.1.99"
BIG = "1.2.840.10008.1.2.2"
UPRIGHT = (1, 0, 0, 0, 1, 0)

_KINDS = {
    0x00080016: "UI", 0x00080018: "UI", 0x00080060: "CS", 0x00180050: "DS", 0x00180088: "DS",
    0x0020000D: "UI", 0x0020000E: "UI", 0x00200013: "IS", 0x00200032: "DS", 0x00200037: "DS",
    0x00280002: "US", 0x00280004: "CS", 0x00280008: "IS", 0x00280009: "AT", 0x00280010: "US",
    0x00280011: "US", 0x00280030: "DS", 0x00280100: "US", 0x00280101: "US", 0x00280102: "US",
    0x00280103: "US", 0x00281052: "DS", 0x00281053: "DS", 0x00209111: "SQ", 0x00209113: "SQ",
    0x00209116: "SQ", 0x00209128: "UL", 0x00289110: "SQ", 0x00289145: "SQ", 0x3004000C: "DS",
    0x3004000E: "DS", 0x52009229: "SQ", 0x52009230: "SQ", 0x7FE00010: "OW", 0x0062000A: "SQ",
    0x0062000B: "US", 0x00280120: "US", 0x00280121: "US", 0x00283000: "SQ", 0x00283002: "US",
    0x00283006: "OW",
}  # fmt: skip


def encoded(elements: dict[int, Any], explicit: bool = True, closed: bool = True, order: str = "<") -> bytes:
    """A data set; lists are sequences of items (little-endian), of known length if ``closed``."""
    parts = []
    for tag, value in sorted(elements.items()):
        kind = _KINDS[tag]
        if kind == "SQ":
            items = [encoded(item, explicit, closed) for item in value]
            if closed:
                data = b"".join(_tag(0xFFFEE000) + struct.pack("<I", len(item)) + item for item in items)
                length = len(data)
            else:
                ends = _tag(0xFFFEE00D) + bytes(4)
                data = b"".join(_tag(0xFFFEE000) + b"\xff" * 4 + item + ends for item in items)
                data, length = data + _tag(0xFFFEE0DD) + bytes(4), 0xFFFFFFFF
        else:
            data = _value(kind, value, order)
            length = len(data)
        head = struct.pack(f"{order}I", length)
        if explicit:
            long = kind in ("SQ", "OW")
            head = kind.encode() + (b"\0\0" + head if long else struct.pack(f"{order}H", length))
        parts.append(_tag(tag, order) + head + data)
    return b"".join(parts)


def _tag(tag: int, order: str = "<") -> bytes:
    return struct.pack(f"{order}HH", tag >> 16, tag & 0xFFFF)


def _value(kind: str, value: Any, order: str) -> bytes:
    if kind == "OW":
        return bytes(value) + bytes(len(value) % 2)
    if kind in ("US", "UL"):
        return struct.pack(f"{order}{'H' if kind == 'US' else 'I'}", value)
    if kind == "AT":
        return _tag(value, order)
    many = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    text = "\\".join(str(one) for one in many).encode()
    return text + (b"\0" if kind == "UI" else b" ") * (len(text) % 2)


def write(
    path: Path,
    values: NDArray[Any],
    number: int = 0,
    elements: dict[int, Any] | None = None,
    *,
    syntax: str = EXPLICIT,
    stored: int = 0,
    photometric: str = "MONOCHROME2",
    model: str = CT,
    closed: bool = True,
) -> None:
    """A file of values (y, x) or (frames, y, x), of 0.5 x 1 per pixel unless ``elements`` say otherwise."""
    bits, order = 8 * values.dtype.itemsize, ">" if syntax == BIG else "<"
    pixels = values.astype(values.dtype.newbyteorder(order))
    own = {
        0x00080016: model, 0x00080018: f"1.2.3.4.{number + 1}", 0x00080060: "OT", 0x0020000D: "1.2.3",
        0x0020000E: "1.2.3.4", 0x00200013: number + 1, 0x00280002: 1, 0x00280004: photometric,
        0x00280010: values.shape[-2], 0x00280011: values.shape[-1], 0x00280030: (1, 0.5), 0x00280100: bits,
        0x00280101: stored or bits, 0x00280102: (stored or bits) - 1,
        0x00280103: int(values.dtype.kind == "i"), 0x7FE00010: pixels.tobytes(),
    }  # fmt: skip
    if values.ndim == 3:
        own[0x00280008] = len(values)
    own |= elements or {}
    own = {tag: value for tag, value in own.items() if value is not None}
    data = encoded(own, syntax != IMPLICIT, closed, order)
    if syntax == DEFLATED:
        packer = zlib.compressobj(wbits=-15)
        data = packer.compress(data) + packer.flush()
        data += bytes(len(data) % 2)
    name = syntax.encode() + bytes(len(syntax) % 2)
    unique = model.encode() + bytes(len(model) % 2)
    meta = _tag(0x00020001) + b"OB\0\0" + struct.pack("<I", 2) + b"\0\1"
    for tag, text in ((0x00020002, unique), (0x00020003, b"1.2.3.4\0"), (0x00020010, name)):
        meta += _tag(tag) + b"UI" + struct.pack("<H", len(text)) + text
    first = _tag(0x00020000) + b"UL" + struct.pack("<HI", 4, len(meta))
    path.write_bytes(bytes(128) + b"DICM" + first + meta + data)


def frame(z: float, slope: float | None = None, time: int | None = None, segment: int | None = None) -> Any:
    """The functional groups of a frame."""
    groups: dict[int, Any] = {0x00209113: [{0x00200032: (0, 0, z)}]}
    if slope is not None:
        groups[0x00289145] = [{0x00281052: 3, 0x00281053: slope}]
    if time is not None:
        groups[0x00209111] = [{0x00209128: time}]
    if segment is not None:
        groups[0x0062000A] = [{0x0062000B: segment}]
    return groups


def enhanced(
    path: Path,
    values: NDArray[Any],
    frames: list[Any],
    shared: Any = None,
    counted: int | None = None,
    padding: dict[int, Any] | None = None,
    **options: Any,
) -> None:
    """An enhanced multi-frame file (PS3.3 C.7.6.16)."""
    groups = {0x00209116: [{0x00200037: UPRIGHT}], 0x00289110: [{0x00280030: (1, 0.5), 0x00180050: 7}]}
    own = {0x00280009: counted, 0x00280030: None, 0x52009229: [groups | (shared or {})], 0x52009230: frames}
    write(path, values, elements=own | (padding or {}), model=ENHANCED, **options)


def values(kind: Any = np.uint16) -> NDArray[Any]:
    """(4, 5, 6): 100 z + 10 y + x."""
    z, y, x = np.ogrid[:4, :5, :6]
    return np.asarray(100 * z + 10 * y + x).astype(kind)
