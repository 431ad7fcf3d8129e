"""NumPy ``.npz`` archives: uncompressed arrays are memory-mapped."""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.bounded import header_of, opened
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.container import Array
from econgs_bench.datasets.readers.finish import Spacing, check_expansion
from econgs_bench.datasets.readers.notices import notice

_REMEDY = "Write it with numpy.savez or numpy.savez_compressed, arrays of shape (z, y, x)"
_CHUNK = 1 << 24
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError, RuntimeError, struct.error,
    KeyError, IndexError, OverflowError,
)  # fmt: skip
"""Exceptions of zipfile and of :func:`~.datasets.bounded.header_of` for damaged files."""


class Npz:
    """An open archive: its arrays by name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays: dict[str, Array] = {}
        self._fortran: set[str] = set()
        self._header: dict[str, int] = {}
        try:
            self._archive = zipfile.ZipFile(path)
            for info in self._archive.infolist():
                if info.filename.endswith(".npy"):
                    with opened(self._archive, info.filename) as file:
                        self._add(info.filename[:-4], file)
        except _DAMAGE as error:
            raise DataError(path, f"is not a readable .npz file ({error})", _REMEDY) from error
        spacing = self._spacing()
        for name, array in self.arrays.items():
            self.arrays[name] = replace(array, spacing=spacing)

    def _spacing(self) -> Spacing | None:
        """An array of three distances, ``spacing``; two equal ones are those within a slice."""
        array = self.arrays.get("spacing")
        if array is None or array.shape != (3,) or array.dtype.kind not in "iuf":
            return None
        x, y, z = (float(n) for n in self.read("spacing"))
        if y == z != x:  # in the order of the axes of the arrays
            x, z = z, x
        notice(f"{self.path}: its spacing is taken as {x:g}, {y:g}, {z:g} along x, y, z")
        return x, y, z

    def _add(self, name: str, file: Any) -> None:
        shape, fortran, dtype = header_of(file)
        if dtype.hasobject or min(shape, default=1) < 0:
            return
        self._header[name] = file.tell()
        if fortran:
            self._fortran.add(name)
        self.arrays[name] = Array(name, shape, dtype, ("",) * len(shape))

    def read(self, name: str, first: int | None = None) -> NDArray[Any]:
        """An array, or its part at one index of its first dimension."""
        array, info = self.arrays[name], self._archive.getinfo(f"{name}.npy")
        nbytes = math.prod(array.shape) * array.dtype.itemsize
        if info.file_size != self._header[name] + nbytes:
            reason = f"{name!r} has {info.file_size} bytes where {self._header[name] + nbytes} are needed"
            raise DataError(self.path, reason, _REMEDY)
        if info.compress_type == zipfile.ZIP_STORED:
            values = self._mapped(info, self._header[name], nbytes, array.dtype)
        else:
            check_expansion(self.path, info.compress_size, nbytes, array.shape, array.dtype.name)
            values = self._inflated(info, self._header[name], nbytes, array.dtype)
        fortran = name in self._fortran
        values = values.reshape(array.shape[::-1]).T if fortran else values.reshape(array.shape)
        return values if first is None else values[first]

    def _mapped(self, info: zipfile.ZipInfo, header: int, nbytes: int, dtype: np.dtype) -> NDArray[Any]:
        with self.path.open("rb") as file:
            file.seek(info.header_offset)
            local = file.read(30)
        if len(local) < 30 or not local.startswith(b"PK\3\4") or info.flag_bits & 1:
            raise DataError(self.path, "its archive is damaged", _REMEDY)
        name, extra = struct.unpack("<HH", local[26:30])
        start = info.header_offset + 30 + name + extra + header
        if start + nbytes > self.path.stat().st_size:
            raise DataError(
                self.path, f"is truncated: an array needs {start + nbytes} bytes", "Copy it again"
            )
        return np.memmap(self.path, np.uint8, mode="r")[start : start + nbytes].view(dtype)

    def _inflated(self, info: zipfile.ZipInfo, header: int, nbytes: int, dtype: np.dtype) -> NDArray[Any]:
        out = np.empty(nbytes, np.uint8)
        try:
            with self._archive.open(info) as file:
                file.read(header)
                fill = _read_into(file, out)
        except _DAMAGE as error:
            raise DataError(self.path, f"its archive is damaged ({error})", _REMEDY) from error
        if fill != nbytes:
            raise DataError(self.path, f"is truncated: {fill} bytes of {nbytes}", "Copy it again")
        return out.view(dtype)


def _read_into(file: BinaryIO | Any, out: NDArray[np.uint8]) -> int:
    fill = 0
    while fill < len(out):
        chunk = file.read(min(_CHUNK, len(out) - fill))
        if not chunk:
            break
        out[fill : fill + len(chunk)] = np.frombuffer(chunk, np.uint8)
        fill += len(chunk)
    file.read(1)  # the checksum is compared at the end
    return fill
