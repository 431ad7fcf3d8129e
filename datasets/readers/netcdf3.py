"""NetCDF classic files (CDF-1, CDF-2, CDF-5): parsed here and memory-mapped."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.container import Array

_TYPES = {1: "i1", 2: "S1", 3: "i2", 4: "i4", 5: "f4", 6: "f8", 7: "u1", 8: "u2", 9: "u4", 10: "i8", 11: "u8"}
_DIMENSIONS, _VARIABLES, _ATTRIBUTES = 10, 11, 12
_REMEDY = "Copy it again, or write it again as NetCDF"


class NetCdf3:
    """An open classic file: its arrays by name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._bytes = np.memmap(path, np.uint8, mode="r")
        self._at = 4
        version = int(self._bytes[3]) if len(self._bytes) > 8 else 0
        if bytes(self._bytes[:3]) != b"CDF" or version not in (1, 2, 5):
            raise DataError(path, "is not a NetCDF file", _REMEDY)
        self._count = ">i8" if version == 5 else ">i4"
        self._offset = ">i4" if version == 1 else ">i8"
        self.arrays: dict[str, Array] = {}
        self._begin: dict[str, int] = {}
        self._records: set[str] = set()
        self._record_bytes = 0
        try:
            self._parse()
        except (ValueError, OverflowError, UnicodeDecodeError) as error:
            raise DataError(path, f"its NetCDF header is damaged ({error})", _REMEDY) from error

    def read(self, name: str, first: int | None = None) -> NDArray[Any]:
        """An array, or its part at one index of its first dimension; memory-mapped."""
        array, begin = self.arrays[name], self._begin[name]
        shape, dtype = array.shape, array.dtype
        inner = math.prod(shape[1:]) * dtype.itemsize
        stride = self._record_bytes if name in self._records else inner
        if first is not None:
            begin, shape, stride = begin + first * stride, shape[1:], 0
        total = math.prod(shape)
        last = begin + (
            stride * (shape[0] - 1) + inner if first is None and shape else total * dtype.itemsize
        )
        if total and (begin < 0 or last > len(self._bytes)):
            reason = f"is truncated: {name!r} needs {last} bytes, the file has {len(self._bytes)}"
            raise DataError(self.path, reason, "Copy it again")
        if first is not None or stride == inner:
            return self._bytes[begin:last].view(dtype).reshape(shape)
        strides = np.empty(shape[1:], dtype).strides
        return np.ndarray(shape, dtype, self._bytes, begin, (stride, *strides))

    def _parse(self) -> None:
        records = self._integer(self._count)
        lengths: list[int] = []
        names: list[str] = []
        for _ in range(self._list(_DIMENSIONS)):
            names.append(self._name())
            lengths.append(self._integer(self._count))
        self.attributes = self._attributes()
        if records < 0 or min(lengths, default=0) < 0:
            raise ValueError("a dimension is negative")
        sizes: list[int] = []
        for _ in range(self._list(_VARIABLES)):
            name = self._name()
            rank = self._integer(self._count)
            if not 0 <= rank <= 64:
                raise ValueError(f"{name!r} has {rank} dimensions")
            ids = [self._integer(self._count) for _ in range(rank)]
            if not all(0 <= i < len(names) for i in ids):
                raise ValueError(f"{name!r} has unknown dimensions")
            attributes = self._attributes()
            kind = self._integer(">i4")
            if kind not in _TYPES:
                raise ValueError(f"{name!r} has unknown type {kind}")
            self._integer(self._count)  # size: redundant, and wrong for large variables
            dtype = np.dtype(_TYPES[kind]).newbyteorder(">")
            is_record = bool(ids) and lengths[ids[0]] == 0
            shape = tuple(records if i == 0 and is_record else lengths[d] for i, d in enumerate(ids))
            self.arrays[name] = Array(name, shape, dtype, tuple(names[i] for i in ids), attributes)
            self._begin[name] = self._integer(self._offset)
            if is_record:
                self._records.add(name)
                sizes.append(math.prod(shape[1:]) * dtype.itemsize)
        # A single record variable is not padded to four bytes.
        self._record_bytes = sizes[0] if len(sizes) == 1 else sum(-(-n // 4) * 4 for n in sizes)

    def _take(self, size: int) -> bytes:
        if size < 0 or self._at + size > len(self._bytes):
            raise ValueError("it ends early")
        self._at += size
        return self._bytes[self._at - size : self._at].tobytes()

    def _integer(self, kind: str) -> int:
        return int(np.frombuffer(self._take(int(kind[2])), kind)[0])

    def _list(self, tag: int) -> int:
        """Number of elements of a list that must have this tag, or be absent."""
        actual, count = self._integer(">i4"), self._integer(self._count)
        if actual not in (0, tag) or count < 0 or (actual == 0 and count) or count > len(self._bytes):
            raise ValueError("a list has the wrong tag")
        return count

    def _name(self) -> str:
        return self._padded(self._integer(self._count)).decode("utf-8")

    def _padded(self, size: int) -> bytes:
        return self._take(-(-size // 4) * 4)[:size]

    def _attributes(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for _ in range(self._list(_ATTRIBUTES)):
            name = self._name()
            kind, count = self._integer(">i4"), self._integer(self._count)
            if kind not in _TYPES or count < 0:
                raise ValueError(f"attribute {name!r} has unknown type {kind}")
            dtype = np.dtype(_TYPES[kind]).newbyteorder(">")
            raw = self._padded(count * dtype.itemsize)
            found[name] = raw.decode("utf-8", "replace") if kind == 2 else np.frombuffer(raw, dtype).tolist()
        return found
