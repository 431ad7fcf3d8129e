"""Last steps of every reader: checks for any format, and bounded decompression."""

from __future__ import annotations

import gzip
import math
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.notices import notice
from econgs_bench.datasets.scratch import converted, new_array

Spacing = tuple[float, float, float]
UNIT: Spacing = (1.0, 1.0, 1.0)

DEFLATE_LIMIT = 1032
"""Maximum expansion of a deflate stream."""
_CHUNK = 1 << 24


def checked_grid(values: NDArray[np.generic], path: Path | str) -> NDArray[np.generic]:
    """The values, in native byte order and booleans as uint8, if they make a grid.

    Raises:
        DataError: not three axes of at least two samples, or no real numbers.
    """
    shape = " x ".join(str(n) for n in reversed(values.shape)) or "a single number"
    if 0 in values.shape:
        raise DataError(path, f"has no samples (size {shape})", "Write it again with positive dims")
    if values.ndim != 3:
        remedy = "Write one scalar field on a 3-D grid (one time step, one component)"
        raise DataError(path, f"is {values.ndim}-D data ({shape})", remedy)
    if min(values.shape) < 2:
        raise DataError(path, f"is 2-D data ({shape})", "Every axis needs at least two samples")
    if values.dtype.kind == "b":
        values = values.view(np.uint8)
    if values.dtype.kind not in "iuf" or values.dtype.itemsize > 8:
        remedy = "Convert it to an integer or floating type of at most 64 bits"
        raise DataError(path, f"values of type {values.dtype} are no scalar field", remedy)
    if not values.dtype.isnative:
        values = converted(values, values.dtype.newbyteorder("="))
    return values


def check_spacing(spacing: Spacing, path: Path | str) -> Spacing:
    """Three positive sample distances as floats.

    Raises:
        DataError: they are not.
    """
    if len(spacing) != 3 or not all(math.isfinite(s) and s > 0.0 for s in spacing):
        raise DataError(path, f"spacing {spacing} is not positive", "Give three positive distances x, y, z")
    return float(spacing[0]), float(spacing[1]), float(spacing[2])


def unpacked_type(dtype: np.dtype, scale: float, offset: float) -> type[np.floating[Any]]:
    """The type of ``scale * values + offset``: single precision where it errs by less than 1/16 of a step.

    Integers of two bytes and less then all stay apart.
    """
    single = dtype.itemsize <= 2 and abs(offset) <= abs(scale) * 2.0**20
    return np.float32 if single else np.float64


def unpacked(values: NDArray[np.generic], scale: float, offset: float) -> NDArray[np.generic]:
    """``scale * values + offset`` in :func:`unpacked_type`; the values themselves where nothing changes."""
    if scale == 1.0 and offset == 0.0:
        return values
    out: NDArray[Any] = converted(values, unpacked_type(values.dtype, scale, offset))
    out *= scale
    out += offset
    return out


def value_range(
    values: NDArray[np.generic], path: Path | str, mask: NDArray[np.bool_] | None = None
) -> tuple[float, float]:
    """Minimum and maximum of valid values, slice by slice: a memory-mapped file is never in memory twice.

    Raises:
        DataError: a value is NaN or infinite, or none is valid.
    """
    slices = max(1, (_CHUNK >> 3) // values[0].nbytes)
    low, high, bad = math.inf, -math.inf, 0
    for start in range(0, len(values), slices):
        part = values[start : start + slices]
        if mask is not None:
            part = part[mask[start : start + slices]]
            if not part.size:
                continue
        a, b = float(part.min()), float(part.max())  # type: ignore[attr-defined]
        if not (math.isfinite(a) and math.isfinite(b)):
            bad += int(np.count_nonzero(~np.isfinite(part)))  # type: ignore[call-overload]
        low, high = min(low, a), max(high, b)
    if bad:
        remedy = "Where they stand for missing data, name them: missing = nan (inf, -inf)"
        raise DataError(path, f"{bad} of {values.size} values are NaN or infinite", remedy)
    if low > high:
        raise DataError(path, "all values are missing", "Choose another variable or time step")
    return low, high


def check_range(low: float, high: float, path: Path | str) -> None:
    """Check that a transfer function can show the values.

    Raises:
        DataError: they exceed single precision, or are constant.
    """
    if high - low > 1e38 or max(abs(low), abs(high)) > 1e38:
        raise DataError(path, f"values from {low:g} to {high:g} exceed single precision", "Rescale them")
    if high - low < 1e-30:
        if low < high:
            reason = f"values from {low:g} to {high:g} are closer than single precision tells apart"
            raise DataError(path, reason, "Rescale them")
        remedy = "A constant field shows nothing; check that the file holds what you expect"
        raise DataError(path, f"all values are {low:g}", remedy)


def positive_dims(dims: tuple[int, ...], path: Path) -> None:
    """Check for three positive numbers before any allocation."""
    text = " x ".join(str(n) for n in dims)
    if len(dims) != 3:
        remedy = "Write one scalar field on a 3-D grid (one time step, one component)"
        raise DataError(path, f"is {len(dims)}-D data ({text})", remedy)
    if min(dims) < 1:
        raise DataError(path, f"has no samples (size {text})", "Write it again with positive dims")


def wrong_size(path: Path, expected: int, actual: str, dims: tuple[int, ...], dtype: str) -> DataError:
    """Error for a file of another size than its dims and type need."""
    text = " x ".join(str(n) for n in dims)
    return DataError(
        path,
        f"holds {actual} where {text} values of {dtype} need {expected} bytes",
        "Check dims and type, or copy the file again if it is truncated",
    )


def check_expansion(path: Path, compressed: int, expected: int, dims: tuple[int, ...], dtype: str) -> None:
    """Check, before allocation, that a compressed file of that size can hold so many bytes."""
    if expected > compressed * DEFLATE_LIMIT + 1024:
        raise wrong_size(path, expected, f"{compressed} compressed bytes", dims, dtype)


def left_out(size: int, end: int) -> str:
    """A line on bytes after the values, where a header says how many values there are; "" for none.

    Formats' libraries ignore such bytes. Only where nothing but the size checks dims and type (raw values)
    are they an error.
    """
    return f"bytes after its values are left out: {size - end}" if size > end else ""


def read_values(
    path: Path, start: int, skip: int, dims: tuple[int, ...], dtype: np.dtype, gzipped: bool, exact: bool
) -> NDArray[np.generic]:
    """Values (nz, ny, nx) at the end of a file, memory-mapped, or from a gzip stream.

    Args:
        path: the file.
        start: where the values or their stream begin.
        skip: further bytes before the first value, within the stream; -1: all that are not values.
        dims: samples along x, y, z.
        dtype: type in the file.
        gzipped: whether a gzip stream holds them.
        exact: whether bytes after them are an error (in a stream they always are), not a line in the log.

    Raises:
        DataError: the file has another size than dims and type need, or its stream is damaged.
    """
    size, expected = path.stat().st_size, math.prod(dims) * dtype.itemsize
    if gzipped:
        with path.open("rb") as file:
            file.seek(start)
            data = _gunzip(file, path, size - start, max(skip, 0), dims, dtype)
        return np.asarray(data.view(dtype).reshape(dims[::-1]))
    offset = size - expected if skip == -1 else start + max(skip, 0)
    end = offset + expected
    if offset < start or end > size or (exact and end < size):
        raise wrong_size(path, expected, f"{size - max(offset, start)} bytes", dims, dtype.name)
    if text := left_out(size, end):
        notice(f"{path}: {text}")
    return np.memmap(path, dtype, mode="r", offset=offset, shape=dims[::-1])


def _gunzip(
    file: BinaryIO, path: Path, compressed: int, skip: int, dims: tuple[int, ...], dtype: np.dtype
) -> NDArray[np.uint8]:
    """Decompress a gzip stream to exactly the bytes that dims and type need."""
    expected = math.prod(dims) * dtype.itemsize
    check_expansion(path, compressed, expected, dims, dtype.name)
    data, filled = new_array((expected,), np.uint8), 0
    try:
        with gzip.GzipFile(fileobj=file) as stream:
            if skip:
                stream.read(skip)
            while chunk := stream.read(min(_CHUNK, expected + 1 - filled)):
                filled += len(chunk)
                if filled > expected:
                    break
                data[filled - len(chunk) : filled] = np.frombuffer(chunk, np.uint8)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(path, f"its gzip stream is damaged ({error})", "Copy or download it again") from error
    if filled != expected:
        actual = f"more than {expected} bytes" if filled > expected else f"{filled} bytes"
        raise wrong_size(path, expected, actual, dims, dtype.name)
    return data
