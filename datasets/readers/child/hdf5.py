"""HDF5 (NetCDF-4 too) through h5py."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.parts import Slabs

_SLAB = 1 << 24
_MOST = 10_000
_NO_POSITIONS = "This is a netCDF dimension but not a netCDF variable"


def open_source(path: str) -> Hdf5:
    """An open file."""
    return Hdf5(path)


class Hdf5:
    """The arrays of a file by name, with their groups."""

    def __init__(self, path: str) -> None:
        self._path, self._file = path, h5py.File(path, "r", locking=False)

    def contents(self) -> dict[str, Any]:
        """Name, shape, type, dimensions and attributes of each array."""
        entries: list[dict[str, Any]] = []

        def visit(name: str, item: Any) -> bool | None:
            if isinstance(item, h5py.Dataset) and item.shape is not None and item.dtype.kind in "iufbS":
                about = {"name": name, "shape": item.shape, "dtype": item.dtype.str}
                attributes = _attributes(item)
                about["spacing"] = _spacing(attributes)
                if not str(attributes.get("NAME", "")).startswith(_NO_POSITIONS):
                    entries.append({**about, "dims": _dims(item), "attributes": attributes})
            return True if len(entries) >= _MOST else None

        self._file.visititems(visit)
        return {"entries": entries}

    def read(self, read: str, first: int | None) -> tuple[dict[str, Any], dict[str, Slabs]]:
        """An array, or its part at one index of the first axis."""
        item = self._file[read]
        shape = item.shape if first is None else item.shape[1:]
        count = int(np.prod(shape, dtype=object)) if shape else 1
        size = count * item.dtype.itemsize
        offset = item.id.get_offset()
        if offset is not None and item.chunks is None and not item.external and not item.compression:
            # Contiguous: the other side maps it into memory.
            start = offset + (0 if first is None else first * size)
            return {}, {"values": Slabs(shape, item.dtype, offset=start)}
        stored = item.id.get_storage_size()
        whole = item.size * item.dtype.itemsize
        if stored * 1032 + 4096 < whole:
            reason = f"is damaged: {stored} stored bytes cannot hold its {whole}"
            raise DataError(self._path, reason, "Copy it again")
        return {}, {"values": Slabs(shape, item.dtype, _pieces(item, first, shape, size))}


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
    if "_FillValue" not in entries and item.dtype.kind in "iuf" and item.dtype.itemsize > 1:
        plist = item.id.get_create_plist()
        if plist.fill_value_defined() == h5py.h5d.FILL_VALUE_USER_DEFINED and item.fillvalue != 0:
            entries["_FillValue"] = [item.fillvalue.item()]
    return entries


def _spacing(attributes: dict[str, Any]) -> list[float] | None:
    """Sample distances along x, y, z, which pictures of microscopes have as an attribute (z, y, x)."""
    sizes = attributes.get("element_size_um")
    if not isinstance(sizes, list) or len(sizes) < 3 or min(sizes[-3:]) <= 0:
        return None
    return [float(n) for n in sizes[:-4:-1]]


def _pieces(
    item: h5py.Dataset, first: int | None, shape: tuple[int, ...], size: int
) -> Iterator[NDArray[Any]]:
    if size == 0 or not shape:
        yield np.asarray(item[()] if first is None else item[first])
        return
    rows = max(1, _SLAB * shape[0] // size)
    if item.chunks is not None:  # whole chunks: each is decompressed once
        along = item.chunks[0 if first is None else 1]
        rows = -(-rows // along) * along
    for start in range(0, shape[0], rows):
        part = slice(start, start + rows)
        yield item[part] if first is None else item[first, part]
