"""Zarr stores (folders, also zipped), version 2 and 3, through zarr."""

from __future__ import annotations

import base64
import struct
import zipfile
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.parts import Slabs
from econgs_bench.datasets.readers.container import LISTED, MOST_ARRAYS, of_dimension
from econgs_bench.datasets.readers.content import ZARR
from econgs_bench.datasets.readers.lengths import in_one_unit

_AXES = {"time": "t", "channel": "c"}
"""Names of OME-Zarr's axes by their types."""


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
        root = _zipped(path) if Path(path).is_file() else zarr.open(path, mode="r")
        self._arrays: dict[str, zarr.Array] = {}
        self._images: dict[str, tuple[list[str], list[float] | None]] = {}  # OME-Zarr: axes, spacing
        self._levels: list[str] = []
        if isinstance(root, zarr.Array):
            self._arrays["value"] = root
        else:
            for name, member in root.members(max_depth=None):
                if isinstance(member, zarr.Array) and len(self._arrays) < MOST_ARRAYS:
                    self._arrays[name] = member
                elif isinstance(member, zarr.Group):
                    self._add_images(f"{name}/", member)
            self._add_images("", root)

    def _add_images(self, prefix: str, group: zarr.Group) -> None:
        """Note the images of an OME-Zarr group: of each its finest level, with its axes and distances."""
        attributes = group.attrs.asdict()
        ome = attributes.get("ome")
        images = (ome if isinstance(ome, dict) else attributes).get("multiscales")
        for image in images if isinstance(images, list) else []:
            try:
                levels = [f"{prefix}{level['path']}" for level in image["datasets"]]
                scale = np.ones(len(image["axes"])) if image.get("axes") else None
                for steps in (image["datasets"][0], image):
                    for step in steps.get("coordinateTransformations", []):
                        if scale is not None and step.get("type") == "scale":
                            scale = scale * np.asarray(step["scale"], dtype=np.float64)
                axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes", [])]
                names = [_AXES.get(str(axis.get("type")), str(axis["name"])) for axis in axes]
                units = [str(axis.get("unit", "")) for axis in axes[-3:]]
                said = any("coordinateTransformations" in part for part in (image["datasets"][0], image))
                spacing = None if scale is None or not said else in_one_unit(scale[-3:].tolist(), units)
            except (KeyError, TypeError, ValueError, AttributeError):
                continue  # not as the specification says: plain arrays
            self._images[levels[0]] = names, spacing[::-1] if spacing is not None else None
            self._levels += levels[1:]

    def contents(self) -> dict[str, Any]:
        """Name, shape, type, dimensions and attributes of each array."""
        entries = []
        for name, array in self._arrays.items():
            if array.dtype.kind in LISTED and name not in self._levels:
                entry = {"name": name, "shape": array.shape, "dtype": array.dtype.str}
                axes, spacing = self._images.get(name, ([], None))
                dims = axes if len(axes) == array.ndim else self._dims(name, array)
                entries.append({**entry, "dims": dims, "attributes": _attributes(array), "spacing": spacing})
        levels = [name for name in self._levels if name in self._arrays]
        left_out = f"smaller copies of its images are left out: {', '.join(levels[:8])}"
        return {"entries": entries} | ({"notice": left_out} if levels else {})

    def _dims(self, name: str, array: Any) -> list[str]:
        """Arrays of the dimensions' names: version 3's, or those of xarray's attribute of version 2."""
        names = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
        if not names or len(names) != array.ndim:
            return [""] * array.ndim
        return [of_dimension(str(dim or ""), name, self._arrays) for dim in names]

    def read(self, read: str, first: int | None) -> tuple[dict[str, Any], dict[str, Slabs]]:
        """An array, or its part at one index of the first axis."""
        array = self._arrays[read]
        absent = array.nchunks - array.nchunks_initialized
        text = f"{absent} of {array.nchunks} chunks of {read!r} are absent: they have its fill value"
        notice = {"notice": f"{text} {array.fill_value}"} if absent else {}
        shape = array.shape if first is None else array.shape[1:]
        return notice, {"values": Slabs(shape, array.dtype, _pieces(array, first, shape))}


class _Archive(zarr.storage.ZipStore):
    """An archive whose lists keep to a folder: zarr (3.1) counts ``zarr.json`` to the array ``z``."""

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Keys below a folder, "" for all."""
        folder = f"{prefix.rstrip('/')}/" if prefix else ""
        async for key in super().list_prefix(folder):
            yield key


def _zipped(path: str) -> zarr.Array | zarr.Group:
    """The store in an archive, which may hold the store's folder."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    roots = [folder for folder, _, file in (name.rpartition("/") for name in names) if file in ZARR]
    if not roots:
        raise DataError(path, "holds no array or group of Zarr", "Zip a Zarr folder")
    store = _Archive(path, mode="r")
    return zarr.open(store, path=min(roots, key=len), mode="r")


def _pieces(array: Any, first: int | None, shape: tuple[int, ...]) -> Iterator[NDArray[Any]]:
    if not shape:
        yield np.asarray(array[() if first is None else first])
        return
    along = array.chunks[0 if first is None else 1]
    for start in range(0, shape[0], along):
        part = slice(start, start + along)
        yield np.asarray(array[part] if first is None else array[first, part])


def _attributes(array: Any) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for name, value in array.attrs.items():
        numbers = value if isinstance(value, list) else [value]
        if isinstance(value, str):
            entries[name] = value
        elif len(numbers) <= 100 and all(isinstance(n, int | float) for n in numbers):
            entries[name] = numbers
    filled = array.fill_value is not None and array.dtype.kind in "iufb"
    if "_ARRAY_DIMENSIONS" in array.attrs and "_FillValue" not in entries and filled:
        entries["_FillValue"] = [array.fill_value.item()]  # xarray keeps it there in version 2
    fill = entries.get("_FillValue")
    if isinstance(fill, str) and array.dtype.kind == "f":
        with suppress(ValueError, struct.error):  # xarray's form in version 3: a double in base 64
            entries["_FillValue"] = list(struct.unpack("<d", base64.b64decode(fill, validate=True)))
    return entries
