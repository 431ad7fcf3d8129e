"""NRRD: pynrrd parses the header; this module reads raw and gzip data after checking sizes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.readers.finish import UNIT, Spacing, positive_dims, read_values

_DTYPES = {
    "uint8": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "int8": ("signed char", "int8", "int8_t"),
    "int16": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "uint16": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "int32": ("int", "signed int", "int32", "int32_t"),
    "uint32": ("uint", "unsigned int", "uint32", "uint32_t"),
    "int64": ("longlong", "long long", "long long int", "signed long long", "signed long long int")
    + ("int64", "int64_t"),
    "uint64": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "float32": ("float",),
    "float64": ("double",),
}
_REMEDY = "Write it again, for example with pynrrd: one scalar field, raw or gzip encoding"


def read_nrrd(path: Path) -> tuple[NDArray[np.generic], Spacing]:
    """Values (nz, ny, nx) and spacing; axes as in the file (orientation is not applied)."""
    import nrrd

    with path.open("rb") as file:
        try:
            header = nrrd.read_header(file)
            sizes = tuple(int(n) for n in header["sizes"])
            kind, encoding = str(header["type"]), str(header["encoding"]).lower()
            big = header.get("endian", "little") == "big"
            line_skip, byte_skip = (
                int(header.get(key, header.get(key.replace(" ", ""), 0)))
                for key in ("line skip", "byte skip")
            )
            spacing = _spacing(header, len(sizes))
        except MemoryError:
            raise
        except Exception as error:  # a damaged header fails in pynrrd's parser in many ways
            raise DataError(path, f"has no readable NRRD header ({error!r})", _REMEDY) from error
        if len(sizes) > 3 and sizes.count(1) == len(sizes) - 3:
            sizes = tuple(n for n in sizes if n > 1)
        positive_dims(sizes, path)
        dtype = _dtype(kind, big, path)
        detached = header.get("data file", header.get("datafile"))
        if detached is None:
            return _data(file, path, sizes, dtype, encoding, line_skip, byte_skip), spacing
    if isinstance(detached, list) or "%" in str(detached) or str(detached).startswith("LIST"):
        raise DataError(path, "its data lie in several files", _REMEDY)
    beside = path.parent / str(detached)
    if not beside.is_file():
        raise DataError(path, f"its data file {beside} does not exist", "Keep header and data together")
    with beside.open("rb") as file:
        return _data(file, beside, sizes, dtype, encoding, line_skip, byte_skip), spacing


def _dtype(kind: str, big: bool, path: Path) -> np.dtype:
    for name, spellings in _DTYPES.items():
        if kind in spellings:
            return np.dtype(name).newbyteorder(">" if big else "<")
    raise DataError(path, f"unknown type {kind!r}", f"Known types: {', '.join(_DTYPES)}")


def _spacing(header: dict[str, Any], axes: int) -> Spacing:
    """Length of each space direction, or the plain spacings; 1 for an axis without either."""
    if "space directions" in header:
        rows = [np.asarray(row, dtype=np.float64) for row in header["space directions"]]
        lengths = [float(np.linalg.norm(row)) for row in rows]
    elif "spacings" in header:
        lengths = [float(s) for s in header["spacings"]]
    else:
        return UNIT
    if axes > 3:  # only their size tells which axes vanish
        lengths = [s for s, n in zip(lengths, header["sizes"], strict=True) if n > 1]
    x, y, z = (s if math.isfinite(s) else 1.0 for s in lengths)
    return abs(x), abs(y), abs(z)


def _data(
    file: BinaryIO,
    path: Path,
    dims: tuple[int, ...],
    dtype: np.dtype,
    encoding: str,
    line_skip: int,
    byte_skip: int,
) -> NDArray[np.generic]:
    if encoding not in ("raw", "gzip", "gz"):
        raise DataError(path, f"encoding {encoding!r} is not supported", _REMEDY)
    for _ in range(max(line_skip, 0)):
        if not file.readline():
            break
    return read_values(path, file.tell(), byte_skip, dims, dtype, encoding != "raw")
