"""HDF5 (NetCDF-4 too) through h5py."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.parts import Slabs
from econgs_bench.datasets.readers.container import LISTED, MOST_ARRAYS, of_dimension
from econgs_bench.datasets.readers.finish import DEFLATE_LIMIT

_SLAB = 1 << 24
_SPARSE, _ROOM = 1 << 16, 1 << 30
"""A dataset with absent chunks is at most so many times larger than what is stored, and so many bytes."""
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
            if isinstance(item, h5py.Dataset) and item.shape is not None and item.dtype.kind in LISTED:
                about = {"name": name, "shape": item.shape, "dtype": item.dtype.str}
                attributes = _attributes(item)
                about["spacing"] = _spacing(attributes)
                if not str(attributes.get("NAME", "")).startswith(_NO_POSITIONS):
                    entries.append({**about, "dims": _dims(item), "attributes": attributes})
            return True if len(entries) >= MOST_ARRAYS else None

        self._file.visititems(visit)
        return {"entries": entries}

    def read(self, read: str, first: int | None) -> tuple[dict[str, Any], dict[str, Slabs]]:
        """An array, or its part at one index of the first axis."""
        item = self._file[read]
        shape = item.shape if first is None else item.shape[1:]
        count = int(np.prod(shape, dtype=object)) if shape else 1
        size = count * item.dtype.itemsize
        offset = item.id.get_offset()
        plain = item.chunks is None and not item.external and not item.compression
        if offset is not None and plain and _is_as_in_memory(item):
            # Contiguous: the other side maps it into memory.
            start = offset + (0 if first is None else first * size)
            return {}, {"values": Slabs(shape, item.dtype, offset=start)}
        path = Path(self._path)
        _check_filters(path, item)
        left_out = _check_sources(path, item) if item.is_virtual else _check_stored(path, item)
        notice = {"notice": f"{left_out}: they have its fill value {item.fillvalue}"} if left_out else {}
        return notice, {"values": Slabs(shape, item.dtype, _pieces(item, first, shape, size))}


def _check_filters(path: Path, item: h5py.Dataset) -> None:
    """Refuse values that are packed in a way for which the HDF5 library here has no filter."""
    created = item.id.get_create_plist()
    for code, _, _, name in map(created.get_filter, range(created.get_nfilters())):
        if not h5py.h5z.filter_avail(code):
            known = name.decode("utf-8", "replace") or "unnamed"
            reason = f"{item.name.lstrip('/')!r} is packed by filter {code} ({known}), which HDF5 lacks here"
            raise DataError(path, reason, "Repack it where that is known: h5repack -f GZIP=4 OLD NEW")


def _is_as_in_memory(item: h5py.Dataset) -> bool:
    """Whether numbers lie in the file as in memory: no bit offset, no other precision."""
    kind = item.id.get_type()
    same = h5py.h5t.py_create(np.dtype(item.dtype.str))
    return kind == same or (isinstance(kind, h5py.h5t.TypeEnumID) and kind.get_super() == same)


def _check_stored(path: Path, item: h5py.Dataset) -> str:
    """Refuse more than the file can hold; which chunks are absent, or ""."""
    stored, whole = item.id.get_storage_size(), item.size * item.dtype.itemsize
    held, text = whole, ""
    for name, start, size in item.external or ():  # HDF5 gives zeros for what a shorter file lacks
        if Path(name).is_file() and Path(name).stat().st_size < start + min(size, whole):
            raise DataError(path, f"its data file {name} is truncated", "Copy all its files together")
    if item.chunks is not None:
        count = math.prod(-(-n // along) for n, along in zip(item.shape, item.chunks, strict=True))
        present = item.id.get_num_chunks()
        if present < count:
            held = min(whole, present * math.prod(item.chunks) * item.dtype.itemsize)
            text = f"{count - present} of {count} chunks of {item.name.lstrip('/')!r} are absent"
    if stored * DEFLATE_LIMIT + 4096 < held or stored * _SPARSE + _ROOM < whole:
        name = item.name.lstrip("/")
        reason = f"is damaged, or {name!r} was not written: {stored} stored bytes cannot hold its {whole}"
        raise DataError(path, reason, "Copy it again")
    return text


def _check_sources(path: Path, item: h5py.Dataset, seen: frozenset[tuple[Path, str]] = frozenset()) -> str:
    """Refuse a virtual dataset without one of its sources; how many values have none, or ""."""
    mapped = stored = 0
    checked: set[tuple[Path, str]] = set(seen)
    for source in item.virtual_sources():
        mapped += source.vspace.get_select_npoints()
        if "%" in source.file_name:  # numbered files: as many as there are
            stored = item.size
            continue
        at = path if source.file_name == "." else _beside(path, source.file_name)
        if (at, source.dset_name) in checked:
            continue
        checked.add((at, source.dset_name))
        stored += at.stat().st_size
        with h5py.File(at, "r", locking=False) as file:
            found = file.get(source.dset_name)
            if not isinstance(found, h5py.Dataset) or not _holds(found, source):
                reason = f"takes values from {source.dset_name!r} of {at}, which lacks them"
                raise DataError(path, reason, "Copy all its files together")
            _check_filters(at, found)
            if found.is_virtual:
                _check_sources(at, found, frozenset(checked))
    if stored * _SPARSE + _ROOM < item.size * item.dtype.itemsize:
        raise DataError(path, f"is damaged: its sources cannot hold its {item.size} values", "Copy it again")
    absent = max(item.size - mapped, 0)
    return f"{absent} of {item.size} values of {item.name.lstrip('/')!r} have no source" if absent else ""


def _holds(found: h5py.Dataset, source: Any) -> bool:
    """Whether a dataset has all the values that a virtual one takes from it."""
    space = source.src_space
    if space.get_select_type() != h5py.h5s.SEL_HYPERSLABS:
        return bool(found.size >= source.vspace.get_select_npoints())
    if None in found.maxshape or space.get_select_npoints() >= 1 << 62:  # as far as it goes
        return True
    last = space.get_select_bounds()[1]
    return len(last) == found.ndim and all(map(int.__lt__, last, found.shape))


def _beside(path: Path, name: str) -> Path:
    """A source file, where HDF5 looks for it."""
    for at in (path.parent / name, Path(name)):
        if at.is_file():
            return at
    raise DataError(path, f"takes values from {name}, which is not there", "Copy all its files together")


def _dims(item: h5py.Dataset) -> list[str]:
    """Names of the dimension scales, else of the axes; a scale is its own dimension."""
    names = [""] * item.ndim
    if item.is_scale and item.ndim == 1:
        return [str(item.name).lstrip("/")]
    for axis in range(item.ndim) if {"DIMENSION_LIST", "DIMENSION_LABELS"} & set(item.attrs) else ():
        if len(item.dims[axis]):
            names[axis] = str(item.dims[axis][0].name).lstrip("/")
        elif label := str(item.dims[axis].label):
            names[axis] = of_dimension(label, str(item.name).lstrip("/"), item.file)
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
