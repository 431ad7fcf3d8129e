"""Zarr stores (folders, also zipped), version 2 and 3, through zarr."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from datasets.readers.child.parts import Slabs

_MOST = 10_000


def open_source(path: str) -> Store:
    """An open store."""
    _make_blosc_check_its_sizes()
    return Store(path)


def _make_blosc_check_its_sizes() -> None:
    """Let Blosc refuse a cut chunk: it would hand over new memory as it is."""
    from numcodecs.blosc import Blosc

    decode = Blosc.decode

    def checked(codec: Any, buffer: Any, out: Any = None) -> Any:
        data = memoryview(buffer).cast("B")
        promise = int.from_bytes(data[12:16], "little")  # bytes with the header
        if promise != len(data):
            raise ValueError(f"a chunk has {len(data)} bytes where its header says {promise}")
        return decode(codec, buffer, out)

    Blosc.decode = checked


class Store:
    """The arrays of a store by name, with their groups."""

    def __init__(self, path: str) -> None:
        self._path = path
        root = zarr.open(path, mode="r")
        self._arrays: dict[str, zarr.Array] = {}
        if isinstance(root, zarr.Array):
            self._arrays["value"] = root
        else:
            for name, member in root.members(max_depth=None):
                if isinstance(member, zarr.Array) and len(self._arrays) < _MOST:
                    self._arrays[name] = member

    def contents(self) -> dict[str, Any]:
        """Name, shape, type, dimensions and attributes of each array."""
        entries = []
        for name, array in self._arrays.items():
            if array.dtype.kind in "iufb":
                entry = {"name": name, "shape": array.shape, "dtype": array.dtype.str}
                entries.append({**entry, "dims": _dims(name, array), "attributes": _attributes(array)})
        return {"entries": entries}

    def read(self, read: str, first: int | None) -> tuple[dict[str, Any], dict[str, Slabs]]:
        """An array, or its part at one index of the first axis."""
        array = self._arrays[read]
        absent = array.nchunks - array.nchunks_initialized
        text = f"{absent} of {array.nchunks} chunks of {read!r} are absent: they have its fill value"
        notice = {"notice": f"{text} {array.fill_value}"} if absent else {}
        shape = array.shape if first is None else array.shape[1:]
        return notice, {"values": Slabs(shape, array.dtype, _pieces(array, first, shape))}


def _pieces(array: Any, first: int | None, shape: tuple[int, ...]) -> Iterator[NDArray[Any]]:
    if not shape:
        yield np.asarray(array[() if first is None else first])
        return
    along = array.chunks[0 if first is None else 1]
    for start in range(0, shape[0], along):
        part = slice(start, start + along)
        yield np.asarray(array[part] if first is None else array[first, part])


def _dims(name: str, array: Any) -> list[str]:
    """Names of the dimensions in the array's group: version 3's, or xarray's attribute of version 2."""
    names = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
    if not names or len(names) != array.ndim:
        return [""] * array.ndim
    group = name.rpartition("/")[0]
    return [f"{group}/{dim}".lstrip("/") if dim else "" for dim in names]


def _attributes(array: Any) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for name, value in array.attrs.items():
        numbers = value if isinstance(value, list) else [value]
        if isinstance(value, str):
            entries[name] = value
        elif len(numbers) <= 100 and all(isinstance(n, int | float) for n in numbers):
            entries[name] = numbers
    return entries
