"""Large arrays: in memory up to :data:`LIMIT`, beyond it in files that the system reads and drops as needed.

Values are the same bit for bit wherever they lie. A scratch file has no name and goes with its array.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError

LIMIT = 2**29
"""Bytes of arrays that are held together, up to which they lie in memory."""
_ALIGNMENT = 64
_PART = 1 << 24


def cache_root() -> Path:
    """The folder of all that can be made again: ``BENCH_CACHE``, or the user's cache folder."""
    if folder := os.environ.get("BENCH_CACHE"):
        return Path(folder).expanduser()
    from platformdirs import user_cache_path

    return user_cache_path("econgs-bench", appauthor=False)


def new_array(shape: Sequence[int], dtype: Any, together: int = 0) -> NDArray[Any]:
    """A new array with any content, at an address that is a multiple of 64 bytes.

    Args:
        shape: of the array.
        dtype: of the array.
        together: bytes of all arrays that are held with it; default: its own.

    Raises:
        DataError: the array belongs into a file, and the cache's folder has no room or cannot be written.
    """
    size = int(np.prod(shape, dtype=object)) * np.dtype(dtype).itemsize
    if max(size, together) > LIMIT and size:
        room = np.frombuffer(_scratch(size), np.uint8)
        start = 0
    else:
        room = np.empty(size + _ALIGNMENT, dtype=np.uint8)
        start = -room.ctypes.data % _ALIGNMENT
    array: NDArray[Any] = room[start : start + size].view(dtype).reshape(shape)
    return array


def converted(values: NDArray[Any], dtype: Any) -> NDArray[Any]:
    """A copy of another type, made part by part along the first axis; of any number of axes."""
    result = new_array(values.shape, dtype)
    step = max(1, _PART * len(values) // max(values.nbytes, 1))
    for start in range(0, len(values), step):
        result[start : start + step] = values[start : start + step]
    return result


def picked(array: NDArray[Any], places: Sequence[int]) -> NDArray[Any]:
    """A copy of the parts at some places of the first axis."""
    result = new_array((len(places), *array.shape[1:]), array.dtype)
    for k, place in enumerate(places):
        result[k] = array[place]
    return result


def is_mapped(array: NDArray[Any]) -> bool:
    """Whether an array lies in a file, so that it takes no memory that the system cannot drop."""
    owner: Any = array
    while owner is not None:
        if isinstance(owner, mmap.mmap):
            return True
        owner = owner.obj if isinstance(owner, memoryview) else getattr(owner, "base", None)
    return False


def _scratch(size: int) -> mmap.mmap:
    """A mapped file of that many bytes, without a name."""
    folder = cache_root() / "scratch"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            if hasattr(os, "posix_fallocate"):  # a full disk is an error here, and no crash at a later write
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        reason = f"has no place for {size / 2**20:.0f} MiB of scratch data ({error.strerror})"
        raise DataError(folder, reason, "Free disk space, or set BENCH_CACHE to another folder") from error
