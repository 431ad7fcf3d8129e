"""VTK's legacy files (``.vtk``), ASCII and binary: structured points, rectilinear and unstructured grids.

This module parses them without VTK; binary values are memory-mapped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import finish
from econgs_bench.datasets.readers.axes import place
from econgs_bench.datasets.readers.fields import Choice, Field, Variable, channels_of, scalar
from econgs_bench.datasets.readers.mesh import Mesh, resampled
from econgs_bench.datasets.readers.text import numbers_until

_TYPES = {
    "unsigned_char": "u1", "char": "i1", "signed_char": "i1", "unsigned_short": "u2", "short": "i2",
    "unsigned_int": "u4", "int": "i4", "unsigned_long": "u8", "long": "i8", "vtktypeint64": "i8",
    "vtktypeuint64": "u8", "vtkidtype": "i4", "float": "f4", "double": "f8", "colors in text": "f4",
}  # fmt: skip
MASKS = ("vtkGhostType", "vtkValidPointMask")
"""Names of arrays that say which points and cells are no data."""
_KINDS = ("STRUCTURED_POINTS", "RECTILINEAR_GRID", "UNSTRUCTURED_GRID")
_REMEDY = "Copy it again, or write it again with VTK or ParaView"
_COMPONENTS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6}
_COLORS = {True: "unsigned_char", False: "colors in text"}
"""VTK's type of unsigned characters in binary files, and in text (numbers from 0 to 1)."""


@dataclass(frozen=True)
class _Array:
    """Place and type of an array in the file."""

    of_cells: bool
    start: int
    dtype: np.dtype
    components: int
    tuples: int
    colors: bool


def _channels(array: _Array) -> int:
    """Channels of colors among an array's components: the second or fourth one is alpha."""
    if array.colors and array.components > 1:
        return array.components - (array.components in (2, 4))
    return channels_of(array.components, array.dtype)


class LeftToVtk(Exception):
    """A file has what this module does not parse and VTK itself does."""


class LegacyFile:
    """An open ``.vtk``.

    Raises:
        LeftToVtk: it holds another kind of data, an array of texts or bits, or one of :data:`MASKS`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._bytes = np.memmap(path, np.uint8, mode="r")
        self._text = self._bytes.data
        self._at = 0
        first, _ = self._raw_line(), self._raw_line()
        encoding = " ".join(self._line() or []).upper()
        if not first.startswith("# vtk DataFile") or encoding not in ("ASCII", "BINARY"):
            raise DataError(path, "is not a legacy VTK file", _REMEDY)
        self._binary = encoding == "BINARY"
        self._arrays: dict[str, _Array] = {}
        self._axes: dict[str, NDArray[np.generic]] = {}
        self._dims: tuple[int, ...] = ()
        self._spacing = [1.0, 1.0, 1.0]
        self._cells: dict[str, NDArray[np.generic]] = {}
        self._points: NDArray[np.generic] | None = None
        self._kind = ""
        self._of_cells, self._tuples = False, -1
        try:
            self._parse()
        except (ValueError, IndexError, OverflowError) as error:
            raise DataError(path, f"is damaged near byte {self._at} ({error})", _REMEDY) from error
        dims = self._sample_dims
        self.variables = tuple(
            Variable(
                name,
                dims(array.of_cells) if self._kind != "UNSTRUCTURED_GRID" else None,
                1,
                array.components,
                _channels(array),
            )
            for name, array in self._arrays.items()
        )
        if not self.variables:
            raise DataError(path, "holds no numeric data arrays", "Write point or cell data with it")

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""
        array = self._arrays[choice.variable.name]
        of_cells, components, tuples = array.of_cells, array.components, array.tuples
        values, _ = self._numbers(array.start, array.dtype, tuples * components)
        if array.colors:
            values = np.rint(values.astype(np.float64) * 255.0).astype(np.uint8)
        if components > 1:
            values = values.reshape(tuples, components)
        if self._kind == "UNSTRUCTURED_GRID":
            return resampled(self._mesh(), scalar(values, choice, self.path), of_cells, choice, self.path)
        shape = tuple(reversed(self._sample_dims(of_cells)))
        values = values.reshape(*shape, *values.shape[1:])
        values = scalar(values, choice, self.path)
        axes: list[NDArray[np.generic] | None] = []
        for i, name in enumerate("xyz"):
            positions = self._axes.get(name)
            if positions is None:
                positions = self._spacing[i] * np.arange(self._dims[i], dtype=np.float64)
            wide = positions.astype(np.float64)
            axes.append(0.5 * (wide[1:] + wide[:-1]) if of_cells else positions)
        return place(values, axes, self.path, choice.limits)

    def _sample_dims(self, of_cells: bool) -> tuple[int, int, int]:
        x, y, z = (max(n - of_cells, 1) for n in self._dims or (1, 1, 1))
        return x, y, z

    def _parse(self) -> None:
        while (words := self._line()) is not None:
            keyword = words[0].upper()
            match keyword:
                case "DATASET":
                    self._kind = words[1].upper()
                    if self._kind == "STRUCTURED_GRID":
                        raise LeftToVtk(self._kind)
                    if self._kind not in _KINDS:
                        remedy = (
                            f"Readable are {', '.join(_KINDS)}, STRUCTURED_GRID; resample others in ParaView"
                        )
                        raise DataError(self.path, f"holds {self._kind}", remedy)
                case "DIMENSIONS":
                    self._dims = tuple(int(word) for word in words[1:4])
                    finish.positive_dims(self._dims, self.path)
                    if max(self._dims) > 1 << 24:
                        raise ValueError("dimensions")
                case "SPACING" | "ASPECT_RATIO":
                    self._spacing = [float(word) for word in words[1:4]]
                    if len(self._spacing) != 3 or not all(math.isfinite(s) and s > 0 for s in self._spacing):
                        raise DataError(self.path, f"spacing {self._spacing} is not positive", _REMEDY)
                case "ORIGIN":
                    pass
                case "X_COORDINATES" | "Y_COORDINATES" | "Z_COORDINATES":
                    count, axis = self._count(words[1]), "XYZ".index(keyword[0])
                    if not self._dims or count != self._dims[axis]:
                        raise ValueError(f"{keyword} has another number than its dimension")
                    self._axes["xyz"[axis]] = self._take(words[2], count)
                case "POINTS":
                    count = self._count(words[1])
                    self._points = self._take(words[2], 3 * count).reshape(count, 3)
                case "CELLS":
                    self._take_cells(self._count(words[1]), self._count(words[2]))
                case "CELL_TYPES":
                    self._cells["types"] = self._take("int", self._count(words[1]))
                case "POINT_DATA" | "CELL_DATA":
                    self._of_cells, self._tuples = keyword == "CELL_DATA", self._count(words[1])
                    self._check_tuples()
                case "METADATA":
                    self._skip_metadata()
                case "FIELD":
                    self._fields(self._count(words[2]))
                case "SCALARS":
                    components = self._count(words[3]) if len(words) > 3 else 1
                    self._line_of("LOOKUP_TABLE")
                    self._skip(words[1], words[2], components)
                case "VECTORS" | "NORMALS" | "TENSORS" | "TENSORS6":
                    self._skip(words[1], words[2], _COMPONENTS[keyword])
                case "TEXTURE_COORDINATES":
                    self._skip(words[1], words[3], self._count(words[2]))
                case "GLOBAL_IDS" | "PEDIGREE_IDS":
                    self._skip("", words[2], 1)
                case "COLOR_SCALARS":
                    self._skip(words[1], _COLORS[self._binary], self._count(words[2]))
                case "LOOKUP_TABLE":
                    self._skip("", _COLORS[self._binary], 4, self._count(words[2]))
                case _:
                    raise ValueError(f"unknown keyword {words[0][:40]!r}")
        if not self._kind:
            raise ValueError("no DATASET")
        if self._kind == "STRUCTURED_POINTS" and not self._dims:
            raise ValueError("no DIMENSIONS")
        if self._kind == "RECTILINEAR_GRID" and set(self._axes) != set("xyz"):
            raise ValueError("no coordinates along x, y or z")

    def _check_tuples(self) -> None:
        if self._kind == "UNSTRUCTURED_GRID":
            types = self._cells.get("types")
            items = types if self._of_cells else self._points
            expected = 0 if items is None else len(items)
        else:
            expected = math.prod(self._sample_dims(self._of_cells)) if self._dims else 0
        if self._tuples != expected:
            raise ValueError(f"{self._tuples} values for {expected} points or cells")

    def _take_cells(self, first: int, second: int) -> None:
        """The older layout (count, then points, cell by cell) or the newer (offsets, connectivity)."""
        if (words := self._line_of("OFFSETS")) is not None:
            ends = self._take(words[1], first).astype(np.int64)
            words = self._line_of("CONNECTIVITY")
            if words is None or not len(ends) or ends[0] != 0:
                raise ValueError("CONNECTIVITY")
            self._cells["ends"], self._cells["connectivity"] = ends[1:], self._take(words[1], second)
            return
        mixed = np.array(self._take("int", second))
        counts = np.empty(first, np.int64)
        at = 0
        for cell in range(first):
            if at >= second:
                raise ValueError("cells end early")
            counts[cell] = n = int(mixed[at])
            if n < 0:
                raise ValueError("a cell has a negative number of points")
            at += n + 1
        if at != second:
            raise ValueError("cells end elsewhere than promised")
        starts = np.cumsum(counts + 1) - counts - 1
        keep = np.ones(second, dtype=bool)
        keep[starts] = False
        self._cells["ends"], self._cells["connectivity"] = np.cumsum(counts), mixed[keep]

    def _fields(self, count: int) -> None:
        for _ in range(count):
            words = self._line()
            if words is None or len(words) < 4:
                raise ValueError("a field array's header")
            if words[0].upper() == "METADATA":
                raise ValueError("METADATA within a field")
            name, kind = words[-4], words[-1]
            components, tuples = self._count(words[-3]), self._count(words[-2])
            fits = tuples == self._tuples
            self._skip(name if fits else "", kind, components, tuples)
            if self._line_of("METADATA") is not None:
                self._skip_metadata()

    def _skip(self, name: str, kind: str, components: int, tuples: int | None = None) -> None:
        """Record an array's place and skip it."""
        tuples = self._tuples if tuples is None else tuples
        if kind.lower() in ("bit", "string", "utf8_string", "vtkvariant", "variant"):
            raise LeftToVtk(f"an array of type {kind}")
        name = unquote(name)
        if name in MASKS:
            raise LeftToVtk(name)
        if tuples < 0 or components < 1:
            raise ValueError(f"an array of type {kind}")
        dtype = self._dtype(kind)
        start = self._at
        if self._binary:
            self._at = self._end(start, dtype, tuples * components)
        else:
            _, self._at = self._numbers(start, dtype, tuples * components)
        if name and self._tuples >= 0:
            label = f"{name}_cells" if name in self._arrays else name
            colors = kind == _COLORS[False]
            self._arrays[label] = _Array(self._of_cells, start, dtype, components, tuples, colors)

    def _take(self, kind: str, count: int) -> NDArray[np.generic]:
        values, self._at = self._numbers(self._at, self._dtype(kind), count)
        return values

    def _dtype(self, kind: str) -> np.dtype:
        if kind.lower() not in _TYPES:
            raise ValueError(f"unknown type {kind[:40]!r}")
        return np.dtype(_TYPES[kind.lower()]).newbyteorder(">")

    def _end(self, start: int, dtype: np.dtype, count: int) -> int:
        end = start + count * dtype.itemsize
        if end > len(self._bytes):
            reason = f"is truncated: {count} values of {dtype.name} end at byte {end} of {len(self._bytes)}"
            raise DataError(self.path, reason, "Copy it again")
        return end

    def _numbers(self, start: int, dtype: np.dtype, count: int) -> tuple[NDArray[np.generic], int]:
        if self._binary:
            end = self._end(start, dtype, count)
            return self._bytes[start:end].view(dtype), end
        return numbers_until(self._text, dtype.newbyteorder("="), count, self.path, start)

    def _count(self, word: str) -> int:
        if not (word.isascii() and word.isdigit() and len(word) < 14):
            raise ValueError(f"{word[:40]!r} is no count")
        return int(word)

    def _line(self) -> list[str] | None:
        """Words of the next non-empty line; None at the end."""
        while self._at < len(self._bytes):
            words = self._raw_line().split()
            if words:
                return words
        return None

    def _line_of(self, keyword: str) -> list[str] | None:
        """Words of the next line if it begins with a keyword; otherwise None, and the line is still next."""
        before = self._at
        words = self._line()
        if words is not None and words[0].upper() == keyword:
            return words
        self._at = before
        return None

    def _skip_metadata(self) -> None:
        while self._raw_line().strip():
            pass

    def _raw_line(self) -> str:
        line = bytes(self._text[self._at : self._at + 4096])
        end = line.find(b"\n")
        if end < 0 and len(line) == 4096:
            raise DataError(self.path, "is not a legacy VTK file, or damaged", _REMEDY)
        self._at += len(line) if end < 0 else end + 1
        return line[: len(line) if end < 0 else end].decode("ascii", "replace")

    def _mesh(self) -> Mesh:
        if self._points is None or {"ends", "connectivity", "types"} - set(self._cells):
            raise DataError(self.path, "has no points or cells", _REMEDY)
        connectivity, ends, types = (self._cells[key] for key in ("connectivity", "ends", "types"))
        if len(types) and not (types.min() >= 0 and types.max() < 256):  # type: ignore[attr-defined]
            raise DataError(self.path, "its cell types are damaged", _REMEDY)
        mesh = Mesh(
            self._points, connectivity.astype(np.int64), ends.astype(np.int64), types.astype(np.uint8)
        )
        return Mesh.joined([mesh], self.path)
