"""Numbers written as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError

_CHUNK = 1 << 20


def numbers_until(
    text: bytes | memoryview, dtype: np.dtype, count: int, path: Path, start: int = 0
) -> tuple[NDArray[np.generic], int]:
    """``count`` numbers from ``start`` on, separated by white space, and the position after them.

    Parsing goes chunk by chunk.

    Raises:
        DataError: the text holds fewer, or one is malformed.
    """
    remedy = "Copy it again, or write it in binary"
    if 2 * count - 1 > len(text) - start:
        raise DataError(
            path, f"is truncated: {len(text) - start} characters do not hold {count} numbers", remedy
        )
    out = np.empty(count, dtype)
    fill, at = 0, start
    while fill < count and at < len(text):
        part = bytes(text[at : at + _CHUNK])
        if at + _CHUNK < len(text):  # never cut a number in two
            end = max(part.rfind(c) for c in (b" ", b"\n", b"\t"))
            if end < 0:
                break
            part = part[: end + 1]
        words = part.split(None, count - fill)[: count - fill]
        if words:
            try:
                out[fill : fill + len(words)] = _parse(words, dtype)
            except (ValueError, OverflowError) as error:
                raise DataError(path, f"a number is not understood ({error})", remedy) from error
        fill += len(words)
        if fill == count:
            rest = part.split(None, len(words))
            at += len(part) - (len(rest[-1]) if len(rest) > len(words) else 0)
            break
        at += len(part)
    if fill < count:
        raise DataError(path, f"is truncated: {fill} numbers where {count} are needed", remedy)
    return out, at


def _parse(words: list[bytes], dtype: np.dtype) -> NDArray[np.generic]:
    if dtype.kind == "f":
        return np.array(words).astype(dtype)
    wide = np.array(words).astype(np.uint64 if dtype.kind == "u" else np.int64)
    bounds = np.iinfo(dtype)
    if len(wide) and (int(wide.min()) < bounds.min or int(wide.max()) > bounds.max):
        raise ValueError(f"beyond the range of {dtype}")
    return wide
