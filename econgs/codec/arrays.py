"""Named float arrays in a stream: weights of decoders, embeddings, palettes."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from econgs_bench.econgs.codec.container import Kind, Reader, Section

Arrays = dict[str, NDArray[np.float32]]
Precision = Literal["float32", "float16", "int8"]

_FLOAT32, _FLOAT16, _ROWS8 = 0, 1, 2
_MOST_DIMENSIONS = 4


def write_arrays(arrays: Mapping[str, NDArray], precision: Precision) -> bytes:
    """Bytes of float arrays.

    Args:
        arrays: finite arrays by name, in order.
        precision: "int8" stores matrices as 8 bits with a float32 scale per row, vectors as float16.
    """
    if precision not in ("float32", "float16", "int8"):
        raise ValueError(f"weights are stored as float32, float16 or int8, not {precision}")
    parts = [struct.pack("<H", len(arrays))]
    for name, array in arrays.items():
        values = np.ascontiguousarray(array, np.float32)
        if not np.isfinite(values).all() or values.ndim > _MOST_DIMENSIONS:
            raise ValueError(f"{name} holds a value that is not finite, or has too many dimensions")
        kind = {"float32": _FLOAT32, "float16": _FLOAT16, "int8": _ROWS8}[precision]
        if kind == _ROWS8 and values.ndim < 2:
            kind = _FLOAT16
        payload, restored = _pack(values, kind)
        if not np.isfinite(restored).all():
            raise ValueError(f"{name} holds values beyond the range of {precision}")
        label = name.encode()
        parts.append(struct.pack("<BBB", len(label), kind, values.ndim) + label)
        parts.append(struct.pack(f"<{values.ndim}I", *values.shape) + payload)
    return b"".join(parts)


def round_arrays(arrays: Mapping[str, NDArray], precision: Precision) -> Arrays:
    """The arrays after writing with this precision and :func:`read_arrays`."""
    return read_arrays(Reader(Section(Kind.DECODERS, 0, write_arrays(arrays, precision)), "arrays"))


def read_arrays(reader: Reader) -> Arrays:
    """Inverse of :func:`write_arrays`.

    Raises:
        ValueError: the section holds no such arrays. Allocation stays below the section's own length.
    """
    arrays: Arrays = {}
    (count,) = reader.unpack("H")
    for _ in range(count):
        length, kind, dimensions = reader.unpack("BBB")
        name = reader.take(length).decode()
        if kind > _ROWS8 or dimensions > _MOST_DIMENSIONS or name in arrays:
            raise ValueError("an array of unknown kind or of a name that was there before")
        shape = reader.unpack(f"{dimensions}I")
        size = math.prod(shape)
        if kind == _ROWS8:
            if not shape:
                raise ValueError("rows of a number")
            scales = np.frombuffer(reader.take(4 * shape[0]), "<f4")
            whole = np.frombuffer(reader.take(size), np.int8).reshape(shape[0], -1 if size else 0)
            with np.errstate(over="ignore"):  # of a damaged file; refused below
                values = (whole.astype(np.float32) * scales[:, None].astype(np.float32)).reshape(shape)
        else:
            form, width = ("<f4", 4) if kind == _FLOAT32 else ("<f2", 2)
            values = np.frombuffer(reader.take(width * size), form).astype(np.float32).reshape(shape)
        if not np.isfinite(values).all():
            raise ValueError(f"{name} holds a value that is not finite")
        arrays[name] = values
    return arrays


def _pack(values: NDArray[np.float32], kind: int) -> tuple[bytes, NDArray[np.float32]]:
    """The bytes of an array, and the array that reading them gives."""
    if kind == _FLOAT32:
        return values.astype("<f4").tobytes(), values
    if kind == _FLOAT16:
        with np.errstate(over="ignore"):
            halves = values.astype("<f2")
        return halves.tobytes(), halves.astype(np.float32)
    rows = values.reshape(len(values), math.prod(values.shape[1:]))
    # Few digits: 127 scales is exact, and a restored array packs to the same bytes again.
    mantissa, exponent = np.frexp(np.abs(rows).max(1, initial=0.0) / 127.0)
    scales = np.ldexp(np.ceil(mantissa * 2048.0) / 2048.0, exponent).astype(np.float32)
    safe = np.where(scales > 0, scales, np.float32(1))
    whole = np.clip(np.rint(rows / safe[:, None]), -127, 127).astype(np.int8)
    restored = whole.astype(np.float32) * scales[:, None]
    return scales.astype("<f4").tobytes() + whole.tobytes(), restored.reshape(values.shape)
