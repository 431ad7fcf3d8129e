"""Medical images through SimpleITK: MetaImage, and folders or files of DICOM."""

from __future__ import annotations

import math
import mmap
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.content import is_dicom, suffix_by_content
from econgs_bench.datasets.readers.fields import channels_of


def open_source(path: str) -> Images:
    """The images of a file or folder."""
    return Images(Path(path))


class Images:
    """One image of a file, or one per series of a folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._files, self._notice = _series(path) if path.is_dir() else ({"value": [str(path)]}, "")
        self._dicom = path.is_dir() or suffix_by_content(path) == ".dcm"
        if path.is_file() and (self._dicom or path.suffix.lower() == ".dcm"):
            _check_dicom(path)
        if not self._files:
            raise DataError(path, "holds no DICOM series", "Check that its slices are there")

    def contents(self) -> dict[str, Any]:
        """Name, dims and components of each image."""
        variables = []
        for name, files in self._files.items():
            reader = _information(files[0])
            sizes = list(reader.GetSize())
            if len(files) > 1:
                sizes[2:] = [len(files)]
            dims, steps = [*sizes, 1, 1][:3], (*sizes[3:], 1)[0]
            if max(sizes[4:], default=1) > 1:
                text = " x ".join(map(str, sizes))
                raise DataError(self._path, f"is {len(sizes)}-D data ({text})", "Write one 3-D image")
            components = reader.GetNumberOfComponents()
            kind = np.uint8 if reader.GetPixelID() == sitk.sitkVectorUInt8 or self._dicom else np.float32
            entry = {"name": name, "dims": dims, "components": components, "steps": steps}
            variables.append({**entry, "channels": channels_of(components, np.dtype(kind))})
        return {"variables": variables} | ({"notice": self._notice} if self._notice else {})

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Values (z, y, x) or (z, y, x, components), and positions along the axes."""
        files = self._files[read]
        if not self._dicom and self._path.suffix.lower() != ".dcm":
            _check_meta(self._path)
        if len(files) > 1:
            reader = sitk.ImageSeriesReader()
            reader.SetFileNames(files)
            image = reader.Execute()
        else:
            image = sitk.ReadImage(files[0])
        values = sitk.GetArrayFromImage(image)
        while values.ndim - (image.GetNumberOfComponentsPerPixel() > 1) > 4:
            values = values[0]
        if values.ndim - (image.GetNumberOfComponentsPerPixel() > 1) == 4:
            values = values[step]
        if not self._says_spacing(image):
            return {"of_cells": False}, {"values": values}
        axes = zip("xyz", image.GetSpacing(), image.GetSize(), strict=False)
        positions = {name: spacing * np.arange(n, dtype=np.float64) for name, spacing, n in axes}
        return {"of_cells": False}, {"values": values, **positions}

    def _says_spacing(self, image: Any) -> bool:
        """Whether distances of one are the file's, and not what ITK takes without any."""
        if set(image.GetSpacing()) != {1.0}:
            return True
        if self._dicom:
            reader = _information(next(iter(self._files.values()))[0])
            return any(reader.HasMetaDataKey(key) for key in ("0028|0030", "0018|1164", "5200|9229"))
        return b"ElementS" in _head(self._path)  # ElementSpacing or ElementSize


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4096).partition(b"ElementDataFile")[0]


def _information(file: str) -> Any:
    reader = sitk.ImageFileReader()
    reader.SetFileName(file)
    reader.ReadImageInformation()
    return reader


def _series(folder: Path) -> tuple[dict[str, list[str]], str]:
    """Variable -> the files of its series, in the order of their positions; and what is no slice."""
    strange = []
    for file in sorted(folder.iterdir()):
        if file.is_file() and file.name != "DICOMDIR":
            with file.open("rb") as stream:
                dicom = is_dicom(stream.read(132))
            if dicom or (file.suffix.lower() == ".dcm" and file.stat().st_size):
                _check_dicom(file)
            else:
                strange.append(file.name)
    more = f" and {len(strange) - 5} more" if len(strange) > 5 else ""
    notice = f"no DICOM files, and left out: {', '.join(strange[:5])}{more}" if strange else ""
    names = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    files = {}
    for number, series in enumerate(names):
        name = "value" if len(names) == 1 else f"series{number}"
        files[name] = list(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series))
    return files, notice


def _check_dicom(file: Path) -> None:
    """Refuse a DICOM file without whole pixel data: ITK fills what is missing with zeros."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at, whole = data.find(_PIXELS), False
        while at >= 0 and not whole:
            explicit = data[at + 4 : at + 6] in (b"OB", b"OW")
            place = at + (8 if explicit else 4)
            length = int.from_bytes(data[place : place + 4], "little")
            compressed = length == 0xFFFFFFFF  # a sequence with an end of its own
            whole = data.rfind(_END) > place if compressed else 0 < length <= len(data) - place - 4
            at = data.find(_PIXELS, at + 1)
    if not whole:
        reason = f"its file {file.name} has no pixels, or is truncated"
        raise DataError(file.parent, reason, "Copy it again, or move what is no picture out of the folder")


_PIXELS, _END = b"\xe0\x7f\x10\x00", b"\xfe\xff\xdd\xe0"
"""DICOM's tags of pixel data and of the end of a sequence."""

_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4,
    "MET_LONG": 4, "MET_ULONG": 4, "MET_LONG_LONG": 8, "MET_ULONG_LONG": 8, "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip


def _check_meta(path: Path) -> None:
    """Refuse MetaImage data of another size than the header says: ITK fills what is missing with garbage."""
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
    if header.get("CompressedData", "False").upper().startswith("T"):
        need = int(header.get("CompressedDataSize", "1"))
    elif header.get("BinaryData", "True").upper().startswith("F"):
        need = 2 * math.prod(dims) - 1
    skip = int(header.get("HeaderSize", "0"))
    if size < need + max(skip, 0):
        reason = f"is truncated: {size} bytes of data where its header needs {need}"
        raise DataError(path, reason, "Copy it again")
