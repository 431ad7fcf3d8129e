"""NRRD: pynrrd parses the header; this module reads raw and gzip data after checking sizes."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.fields import Variable, channels_of
from econgs_bench.datasets.readers.finish import Spacing, positive_dims, read_values
from econgs_bench.datasets.readers.lengths import in_one_unit
from econgs_bench.datasets.readers.single import Single

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


_COMPONENTS = ("vector", "point", "normal", "gradient", "complex", "quaternion", "matrix")
_SPACE = ("domain", "space", "")
_UNKNOWN = ("???", "none", "")


def open_nrrd(path: Path) -> Single:
    """The field of a file; axes as in the file (orientation is not applied).

    A fourth axis holds components, if its kind says so, else time steps.
    """
    import nrrd

    with path.open("rb") as file:
        head = re.split(rb"\r?\n\r?\n", file.read(1 << 16), maxsplit=1)[0]
        if re.search(rb"(?im)^data ?file:=? *(LIST|.*%)", head):
            raise DataError(path, "its data lie in several files", _REMEDY)
        file.seek(0)
        try:
            header = nrrd.read_header(file)
            lacks = [field for field in ("sizes", "type", "encoding") if field not in header]
            if lacks:
                raise ValueError(f"it lacks {', '.join(lacks)}")
            sizes = tuple(int(n) for n in header["sizes"])
            kind, encoding = str(header["type"]), str(header["encoding"]).lower()
            big = header.get("endian", "little") == "big"
            skips = [
                int(header.get(key, header.get(key.replace(" ", ""), 0)))
                for key in ("line skip", "byte skip")
            ]
            apart = _apart(header, sizes)
            spacing = _spacing(header, [i for i in range(len(sizes)) if i not in apart])
        except MemoryError:
            raise
        except Exception as error:  # a damaged header fails in pynrrd's parser in many ways
            raise DataError(path, f"has no readable NRRD header ({error!r})", _REMEDY) from error
        start = file.tell()
    dims = tuple(n for i, n in enumerate(sizes) if i not in apart)
    positive_dims(dims, path)
    positive_dims((*sizes, 1, 1, 1)[:3] if min(sizes) > 0 else sizes[:3], path)
    dtype = _dtype(kind, big, path)
    if dtype.itemsize > 1 and "endian" not in header:
        raise DataError(
            path, "does not say its byte order", 'Add the field "endian: little", or "endian: big"'
        )
    detached = header.get("data file", header.get("datafile"))
    at = path if detached is None else path.parent / str(detached)
    if not at.is_file():
        raise DataError(path, f"its data file {at} does not exist", "Keep header and data together")
    x, y, z = dims
    others = [(i, sizes[i]) for i in apart if sizes[i] > 1]
    kinds = [str(k).lower() for k in header.get("kinds", [])] or [""] * len(sizes)
    axis, count = others[0] if others else (0, 1)
    colors = bool(others) and kinds[axis].endswith("-color")
    vector = colors or (bool(others) and any(word in kinds[axis] for word in _COMPONENTS))

    def load(step: int) -> NDArray[np.generic]:
        with at.open("rb") as file:
            file.seek(start if detached is None else 0)
            values = _data(file, at, sizes, dtype, encoding, *skips)
        values = np.moveaxis(values, [len(sizes) - 1 - i for i in apart], range(len(apart)))
        values = values.reshape(-1, z, y, x)
        return np.moveaxis(values, 0, -1) if vector else values[step]

    steps, components = (1, count) if vector else (count, 1)
    channels = min(count, 3) if colors else channels_of(components, dtype)
    variable = Variable("value", (x, y, z), steps, components, channels)
    return Single(path, variable, load, spacing)


def _apart(header: dict[str, Any], sizes: tuple[int, ...]) -> list[int]:
    """Axes that are not of space: by their kinds, else by their directions, else of one sample or last.

    Of up to three axes none may be apart: what has one is a picture of colors, vectors or times.
    """
    axes = range(len(sizes))
    kinds = [str(kind).lower() for kind in header.get("kinds", [])]
    kinds = kinds if len(kinds) == len(sizes) else [""] * len(sizes)
    directions = header.get("space directions")
    rows = directions if directions is not None and len(directions) == len(sizes) else []
    apart = [i for i in axes if kinds[i] not in _SPACE]
    named = [i for i in apart if kinds[i] not in _UNKNOWN]
    aimless = [i for i, row in enumerate(rows) if row is None or np.isnan(np.asarray(row, float)).all()]
    if len(sizes) <= 3:
        found = aimless if set(kinds) <= set(_UNKNOWN) else named
        return found if len(found) < len(sizes) else []
    ones = [i for i in axes if sizes[i] == 1]
    found = next(
        (choice for choice in (named, apart, aimless, ones) if len(sizes) - len(choice) == 3),
        [3] if len(sizes) == 4 else [],
    )
    return found if sum(sizes[i] > 1 for i in found) <= 1 else []


def _dtype(kind: str, big: bool, path: Path) -> np.dtype:
    for name, spellings in _DTYPES.items():
        if kind in spellings:
            return np.dtype(name).newbyteorder(">" if big else "<")
    raise DataError(path, f"unknown type {kind!r}", f"Known types: {', '.join(_DTYPES)}")


def _spacing(header: dict[str, Any], axes: list[int]) -> Spacing | None:
    """Length of each space direction, the plain spacings, or those of the axes' ends, in one unit.

    None where an axis has none of them.
    """
    if "space directions" in header:
        rows = list(header["space directions"])
        lengths = [math.nan if row is None else float(np.linalg.norm(np.asarray(row, float))) for row in rows]
    elif "spacings" in header:
        lengths = [float(s) for s in header["spacings"]]
    else:
        lengths = _between_ends(header)
    if len(lengths) != len(header["sizes"]):
        return None
    units = [str(unit) for unit in header.get("units", header.get("space units", []))]
    lengths = [lengths[i] for i in axes]
    if len(units) == len(header["sizes"]):
        units = [units[i] for i in axes]
    if len(units) == len(lengths):
        lengths = in_one_unit(lengths, units) or lengths
    if len(lengths) != 3 or not all(math.isfinite(s) and s != 0.0 for s in lengths):
        return None
    return abs(lengths[0]), abs(lengths[1]), abs(lengths[2])


def _between_ends(header: dict[str, Any]) -> list[float]:
    """Sample distances by the ends of the axes: of their cells, unless samples lie at the ends."""
    ends = [header.get(f"axis {end}", header.get(f"axis{end}", ())) for end in ("mins", "maxs")]
    centers = header.get("centers", header.get("centerings", ""))
    centers = centers.split() if isinstance(centers, str) else [str(center) for center in centers]
    sizes = [int(n) for n in header["sizes"]]
    centers = centers if len(centers) == len(sizes) else [""] * len(sizes)
    return [
        (float(high) - float(low)) / max(n - (center.lower() == "node"), 1)
        for low, high, n, center in zip(*ends, sizes, centers, strict=False)
    ]


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
    return read_values(path, file.tell(), byte_skip, dims, dtype, encoding != "raw", False)
