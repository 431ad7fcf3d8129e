"""Medical images through SimpleITK: MetaImage; :mod:`.datasets.readers.child.dicom` has DICOM."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.dicom import Series
from econgs_bench.datasets.readers.content import suffix_by_content
from econgs_bench.datasets.readers.fields import channels_of
from econgs_bench.datasets.readers.finish import left_out


def open_source(path: str) -> Images | Series:
    """MetaImage, or the DICOM of a file or folder."""
    source = Path(path)
    dicom = source.is_dir() or ".dcm" in (source.suffix.lower(), suffix_by_content(source))
    return Series(source) if dicom else Images(source)


class Images:
    """The image of a MetaImage file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def contents(self) -> dict[str, Any]:
        """Dims, steps and components of its only variable."""
        reader = sitk.ImageFileReader()
        reader.SetFileName(str(self._path))
        reader.ReadImageInformation()
        sizes = list(reader.GetSize())
        dims, steps = [*sizes, 1, 1][:3], (*sizes[3:], 1)[0]
        if max(sizes[4:], default=1) > 1:
            text = " x ".join(map(str, sizes))
            raise DataError(self._path, f"is {len(sizes)}-D data ({text})", "Write one 3-D image")
        components = reader.GetNumberOfComponents()
        kind = np.uint8 if reader.GetPixelID() == sitk.sitkVectorUInt8 else np.float32
        entry = {"name": "value", "dims": dims, "components": components, "steps": steps}
        return {"variables": [{**entry, "channels": channels_of(components, np.dtype(kind))}]}

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Values (z, y, x) or (z, y, x, components), and positions along the axes."""
        del read
        left = _check_meta(self._path)
        image = sitk.ReadImage(str(self._path))
        values = sitk.GetArrayFromImage(image)
        while values.ndim - (image.GetNumberOfComponentsPerPixel() > 1) > 4:
            values = values[0]
        if values.ndim - (image.GetNumberOfComponentsPerPixel() > 1) == 4:
            values = values[step]
        head = _head(self._path)
        about = {"of_cells": False, "notice": "; ".join(filter(None, (_scale(head), left)))}
        # Distances of one may be what ITK takes without any.
        if set(image.GetSpacing()) == {1.0} and b"ElementS" not in head:
            return about, {"values": values}
        axes = zip("xyz", image.GetSpacing(), image.GetSize(), strict=False)
        positions = {name: spacing * np.arange(n, dtype=np.float64) for name, spacing, n in axes}
        return about, {"values": values, **positions}


def _head(path: Path) -> bytes:
    """The header as far as distances and the scale of the values stand in it."""
    with path.open("rb") as file:
        return file.read(4096).partition(b"ElementDataFile")[0]


def _scale(head: bytes) -> str:
    """A line where the header has a scale: ITK and VTK give values as stored."""
    pattern = rb"^ElementToIntensityFunction(Slope|Offset)[ \t]*=[ \t]*(\S+)"
    given = dict(re.findall(pattern, head, re.MULTILINE))
    if float(given.get(b"Slope", 1)) == 1.0 and float(given.get(b"Offset", 0)) == 0.0:
        return ""
    text = ", ".join(f"{name.decode()} {value.decode()}" for name, value in sorted(given.items()))
    return f"values are as stored: ElementToIntensityFunction ({text}) is not applied, as in ITK"


_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4,
    "MET_LONG": 4, "MET_ULONG": 4, "MET_LONG_LONG": 8, "MET_ULONG_LONG": 8, "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip


def _check_meta(path: Path) -> str:
    """Refuse MetaImage data of less than the header says: ITK fills what is missing with garbage.

    Returns:
        A line on bytes after the values, else "".
    """
    header: dict[str, str] = {}
    with path.open("rb") as file:
        for line in file:
            key, _, value = line.decode("latin-1").partition("=")
            header[key.strip()] = value.strip()
            if key.strip() == "ElementDataFile" or len(header) > 1000:
                break
        start = file.tell()
    data = header.get("ElementDataFile", "")
    beside = path if data.upper() == "LOCAL" else path.parent / data
    if data.upper().startswith("LIST") or "%" in data:
        raise DataError(path, "its data lie in several files", "Write one file, with SimpleITK, say")
    if not beside.is_file():
        raise DataError(path, f"its data file {data} does not exist", "Keep header and data together")
    size = beside.stat().st_size - (start if beside == path else 0)
    kind, dims = header.get("ElementType", ""), [int(n) for n in header.get("DimSize", "0").split()]
    if kind not in _BYTES:
        raise DataError(path, f"unknown type {kind!r}", f"Known types: {', '.join(_BYTES)}")
    need = math.prod(dims) * _BYTES[kind] * int(header.get("ElementNumberOfChannels", "1"))
    packed = header.get("CompressedData", "False").upper().startswith("T")
    binary = not header.get("BinaryData", "True").upper().startswith("F")
    if packed:
        need = int(header.get("CompressedDataSize", "1"))
    elif not binary:
        need = 2 * math.prod(dims) - 1
    skip = int(header.get("HeaderSize", "0"))
    if size < need + max(skip, 0):
        reason = f"is truncated: {size} bytes of data where its header needs {need}"
        raise DataError(path, reason, "Copy it again")
    return left_out(size, need + skip) if binary and not packed and skip >= 0 else ""
