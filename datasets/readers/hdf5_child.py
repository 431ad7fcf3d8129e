"""The process that reads an HDF5 file for :mod:`datasets.readers.hdf5`, run as a script.

HDF5's library can crash, hang or allocate without bound on a damaged file: this must not affect the user's
process. Requests come as lines of JSON on stdin; each answer is a line of JSON on stdout, followed by the raw
values where it announces ``bytes``.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any, BinaryIO

import h5py
import numpy as np

_MEMORY = 4 << 30
_SLAB = 1 << 24
_MOST = 10_000
UNREADABLE = 3
_NO_POSITIONS = "This is a netCDF dimension but not a netCDF variable"


def main() -> None:
    """Serve the file named on the command line until stdin ends."""
    _limit_memory()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries must not mix with the answers
    try:
        with h5py.File(sys.argv[1], "r", locking=False) as file:
            for line in sys.stdin:
                request = json.loads(line)
                if "list" in request:
                    _answer(answers, {"arrays": _arrays(file)})
                else:
                    _send(answers, file[request["read"]], request["first"])
    except Exception as error:
        _answer(answers, {"error": f"{type(error).__name__}: {error}"})


def _limit_memory() -> None:
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            used = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, used + _MEMORY))
    except (ImportError, OSError, ValueError):
        pass  # not Linux


def _answer(answers: BinaryIO, answer: dict[str, Any]) -> None:
    answers.write(json.dumps(answer).encode() + b"\n")
    answers.flush()


def _arrays(file: h5py.File) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = []

    def visit(name: str, item: Any) -> bool | None:
        if isinstance(item, h5py.Dataset) and item.shape is not None and item.dtype.kind in "iufbS":
            about = {"name": name, "shape": item.shape, "dtype": item.dtype.str}
            entries.append({**about, "dims": _dims(item), "attributes": _attributes(item)})
        return True if len(entries) >= _MOST else None

    file.visititems(visit)
    return entries


def _dims(item: h5py.Dataset) -> list[str]:
    """Names of the dimension scales; a scale is its own dimension."""
    names = [""] * item.ndim
    if item.is_scale and item.ndim == 1:
        return [str(item.name).lstrip("/")]
    if "DIMENSION_LIST" in item.attrs:
        for axis in range(item.ndim):
            if len(item.dims[axis]):
                names[axis] = str(item.dims[axis][0].name).lstrip("/")
    return names


def _attributes(item: h5py.Dataset) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for name in item.attrs:
        if name in ("DIMENSION_LIST", "REFERENCE_LIST"):
            continue
        try:
            value = item.attrs[name]
        except (OSError, TypeError, ValueError):
            continue
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "iufb" and value.size <= 100:
            entries[name] = np.ravel(value).tolist()
        elif isinstance(value, str):
            entries[name] = value
    if str(entries.get("NAME", "")).startswith(_NO_POSITIONS):
        entries["no positions"] = "true"
    return entries


def _send(answers: BinaryIO, item: h5py.Dataset, first: int | None) -> None:
    """An array, or its part at one index of the first axis."""
    shape = item.shape if first is None else item.shape[1:]
    count = int(np.prod(shape, dtype=object)) if shape else 1
    size = count * item.dtype.itemsize
    offset = item.id.get_offset()
    if offset is not None and item.chunks is None and not item.external and not item.compression:
        # Contiguous: the other side maps it into memory.
        start = offset + (0 if first is None else first * size)
        _answer(answers, {"offset": start, "shape": shape, "dtype": item.dtype.str})
        return
    stored = item.id.get_storage_size()
    whole = item.size * item.dtype.itemsize
    if stored * 1032 + 4096 < whole:
        _answer(answers, {"error": f"{stored} stored bytes cannot hold its {whole}"})
        return
    _answer(answers, {"bytes": size, "shape": shape, "dtype": item.dtype.str})
    try:
        _send_values(answers, item, first, shape, size)
    except Exception:
        os._exit(UNREADABLE)  # without an error message among the values


def _send_values(
    answers: BinaryIO, item: h5py.Dataset, first: int | None, shape: tuple[int, ...], size: int
) -> None:
    if size == 0 or not shape:
        answers.write(np.asarray(item[()] if first is None else item[first]).tobytes())
        answers.flush()
        return
    rows = max(1, _SLAB * shape[0] // size)
    if item.chunks is not None:  # whole chunks: each is decompressed once
        along = item.chunks[0 if first is None else 1]
        rows = -(-rows // along) * along
    for start in range(0, shape[0], rows):
        part = slice(start, start + rows)
        answers.write(np.ascontiguousarray(item[part] if first is None else item[first, part]).data)
    answers.flush()


if __name__ == "__main__":
    main()
