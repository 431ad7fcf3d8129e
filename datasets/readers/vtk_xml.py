"""VTK's XML files of grids and meshes: ``.vti``, ``.vtr``, ``.vtu``.

This module parses them without VTK: it checks sizes against the file before any allocation, a damaged file
cannot crash the process, and uncompressed appended data are memory-mapped. Cell data of grids become samples
at the cells' centres; those of meshes are averaged to the points.
"""

from __future__ import annotations

import binascii
import lzma
import math
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.readers import finish
from datasets.readers.axes import place
from datasets.readers.fields import Choice, Field, Variable, need, scalar
from datasets.readers.mesh import Mesh, resampled
from datasets.readers.text import numbers_until

_TYPES = {f"{sign}Int{8 * n}": f"{sign.lower() or 'i'}{n}" for sign in ("", "U") for n in (1, 2, 4, 8)}
_TYPES |= {"Float32": "f4", "Float64": "f8"}
_COMPRESSORS = {
    "": 1,
    "vtkZLibDataCompressor": 1032,
    "vtkLZMADataCompressor": 8192,
    "vtkLZ4DataCompressor": 256,
}
"""Maximum expansion of each compressor."""
_REMEDY = "Copy it again, or write it again with VTK or ParaView"
_CHUNK = 1 << 20  # a multiple of 4: whole groups of base64
_MASKS = ("vtkGhostType", "vtkValidPointMask")


class XmlFile:
    """An open ``.vti``, ``.vtr`` or ``.vtu``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.bytes = np.memmap(path, np.uint8, mode="r")
        root, self._appended, self._base64 = self._parse()
        order = root.get("byte_order", "LittleEndian")
        self._order = ">" if order == "BigEndian" else "<"
        header = root.get("header_type", "UInt32")
        self._compressor = root.get("compressor", "")
        if root.tag != "VTKFile" or order not in ("LittleEndian", "BigEndian"):
            raise DataError(path, "is not a VTK XML file", _REMEDY)
        if header not in ("UInt32", "UInt64") or self._compressor not in _COMPRESSORS:
            raise DataError(path, f"header {header} or compressor {self._compressor!r} is unknown", _REMEDY)
        self._header = np.dtype(self._order + _TYPES[header])
        kind = root.get("type", "")
        grid = root.find(kind) if kind in ("ImageData", "RectilinearGrid", "UnstructuredGrid") else None
        if grid is None:
            remedy = (
                "Readable are ImageData, RectilinearGrid and UnstructuredGrid; resample others in ParaView"
            )
            raise DataError(path, f"holds {kind or 'no type'!r}", remedy)
        self._grid, self._kind = grid, kind
        self._pieces = grid.findall("Piece")
        if not self._pieces:
            raise DataError(path, "has no Piece", _REMEDY)
        self._whole = () if kind == "UnstructuredGrid" else self._extent(grid, "WholeExtent")
        self._arrays: dict[str, tuple[str, str]] = {}  # variable -> section and name
        self._masks: dict[str, list[str]] = {"PointData": [], "CellData": []}
        self.variables = tuple(self._variables())
        if not self.variables:
            raise DataError(path, "holds no numeric data arrays", "Write point or cell data with it")

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""
        section, name = self._arrays[choice.variable.name]
        if self._kind == "UnstructuredGrid":
            return self._read_mesh(section, name, choice)
        values, mask = self._assembled(section, name), self._mask(section)
        axes: list[NDArray[np.generic] | None] = self._axes(section)
        values = scalar(values, choice)
        return place(values[..., 0] if values.ndim == 4 else values, axes, self.path, mask)

    def _parse(self) -> tuple[ElementTree.Element, int, bool]:
        """The XML without the appended data, their start, and whether they are base64."""
        head = bytes(self.bytes[:64]).lstrip()
        if not head.startswith(b"<"):
            raise DataError(self.path, "is not a VTK XML file", _REMEDY)
        start = self._find(b"<AppendedData")
        text = self.bytes[:start].tobytes() if start >= 0 else self.bytes.tobytes()
        first, base64 = len(self.bytes), False
        if start >= 0:
            opening = self.bytes[start : start + 4096].tobytes()
            mark = opening.find(b"_")
            if mark < 0 or b">" not in opening[:mark]:
                raise DataError(self.path, "its appended data are cut off", _REMEDY)
            base64 = b'encoding="base64"' in opening[:mark]
            first = start + mark + 1
            text += b"</VTKFile>"
        if b"<!DOCTYPE" in text[:4096] or b"<!ENTITY" in text:
            raise DataError(self.path, "declares XML entities", _REMEDY)
        try:
            return ElementTree.fromstring(text), first, base64
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            raise DataError(self.path, f"is damaged ({error})", _REMEDY) from error

    def _find(self, pattern: bytes) -> int:
        for start in range(0, len(self.bytes), _CHUNK):
            at = self.bytes[start : start + _CHUNK + len(pattern)].tobytes().find(pattern)
            if at >= 0:
                return start + at
        return -1

    def _extent(self, element: ElementTree.Element, key: str) -> tuple[int, ...]:
        try:
            extent = tuple(int(word) for word in element.get(key, "").split())
        except ValueError:
            extent = ()
        if len(extent) != 6 or max(map(abs, extent), default=0) > 1 << 31:
            raise DataError(self.path, f"{key} {element.get(key)!r} is not six integers", _REMEDY)
        return extent

    def _dims(self, extent: tuple[int, ...], section: str) -> tuple[int, int, int]:
        """Points or cells along x, y, z."""
        points = [extent[2 * a + 1] - extent[2 * a] + 1 for a in range(3)]
        finish.positive_dims(tuple(points), self.path)
        x, y, z = (max(n - 1, 1) if section == "CellData" else n for n in points)
        return x, y, z

    def _variables(self) -> list[Variable]:
        variables = []
        for section in self._masks:
            dims = None if not self._whole else self._dims(self._whole, section)
            for element in self._elements(self._pieces[0], section):
                name, kind = element.get("Name", ""), element.get("type", "")
                if name in _MASKS:
                    self._masks[section].append(name)
                elif name and kind in _TYPES and (section, name) not in self._arrays.values():
                    label = f"{name}_cells" if name in self._arrays else name
                    self._arrays[label] = (section, name)
                    variables.append(Variable(label, dims, 1, self._components(element)))
        return variables

    def _elements(self, piece: ElementTree.Element, section: str) -> list[ElementTree.Element]:
        inside = piece.find(section)
        return [] if inside is None else inside.findall("DataArray")

    def _components(self, element: ElementTree.Element) -> int:
        text = element.get("NumberOfComponents", "1")
        if not (text.isascii() and text.isdigit() and 1 <= int(text[:6]) <= 1024 and len(text) < 6):
            raise DataError(self.path, f"an array has {text!r} components", _REMEDY)
        return int(text)

    def _assembled(self, section: str, name: str) -> NDArray[np.generic]:
        """An array over the whole extent, (nz, ny, nx) or (nz, ny, nx, components)."""
        nx, ny, nz = self._dims(self._whole, section)
        whole: NDArray[np.generic] | None = None
        for piece in self._pieces:
            extent = self._extent(piece, "Extent")
            inside = all(
                self._whole[2 * a] <= extent[2 * a] <= extent[2 * a + 1] <= self._whole[2 * a + 1]
                for a in range(3)
            )
            if not inside:
                raise DataError(self.path, f"a piece {extent} lies outside {self._whole}", _REMEDY)
            dims = self._dims(extent, section)
            element = self._element(piece, section, name)
            part = self.array(element, math.prod(dims))
            tail = () if part.ndim == 1 else part.shape[1:]
            part = part.reshape(*reversed(dims), *tail)
            if extent == self._whole:
                return part
            if whole is None:
                size = sum(math.prod(self._dims(self._extent(p, "Extent"), section)) for p in self._pieces)
                if size < nx * ny * nz:  # also refuses a damaged extent before allocation
                    raise DataError(self.path, "its pieces do not fill its extent", _REMEDY)
                whole = np.empty((nz, ny, nx, *tail), part.dtype)
            x, y, z = (extent[2 * a] - self._whole[2 * a] for a in range(3))
            if whole.shape[3:] != tail:
                raise DataError(self.path, f"{name!r} differs between its pieces", _REMEDY)
            whole[z : z + dims[2], y : y + dims[1], x : x + dims[0]] = part
        assert whole is not None  # there is a piece
        return whole

    def _element(self, piece: ElementTree.Element, section: str, name: str) -> ElementTree.Element:
        for element in self._elements(piece, section):
            if element.get("Name") == name:
                return element
        raise DataError(self.path, f"a piece has no {name!r}", _REMEDY)

    def _mask(self, section: str) -> NDArray[np.bool_] | None:
        """Mask from VTK's blanking or resampling: False for missing data."""
        mask: NDArray[np.bool_] | None = None
        for name in self._masks[section]:
            flags = self._assembled(section, name)
            hidden = 32 if section == "CellData" else 2
            valid = flags != 0 if name == "vtkValidPointMask" else (flags.astype(np.uint8) & hidden) == 0
            mask = valid if mask is None else mask & valid
        return mask

    def _axes(self, section: str) -> list[NDArray[np.generic] | None]:
        """Positions of points or cell centres along x, y, z."""
        axes: list[NDArray[np.generic]] = []
        if self._kind == "ImageData":
            try:
                spacing = [float(word) for word in self._grid.get("Spacing", "1 1 1").split()]
            except ValueError:
                spacing = []
            if len(spacing) != 3 or not all(math.isfinite(s) and s > 0.0 for s in spacing):
                raise DataError(self.path, f"spacing {self._grid.get('Spacing')!r} is not positive", _REMEDY)
            counts = self._dims(self._whole, "PointData")
            axes = [
                s * np.arange(min(n, 1 << 24), dtype=np.float64) for s, n in zip(spacing, counts, strict=True)
            ]
        else:
            for a in range(3):
                axes.append(self._coordinates(a))
        return [0.5 * (p[1:] + p[:-1]) if section == "CellData" else p for p in axes]  # type: ignore[operator]

    def _coordinates(self, axis: int) -> NDArray[np.generic]:
        first, last = self._whole[2 * axis : 2 * axis + 2]
        positions = None
        for piece in self._pieces:
            extent = self._extent(piece, "Extent")[2 * axis : 2 * axis + 2]
            inside = piece.find("Coordinates")
            elements = [] if inside is None else inside.findall("DataArray")
            if len(elements) != 3:
                raise DataError(self.path, "a piece has no x, y, z coordinates", _REMEDY)
            part = self.array(elements[axis], extent[1] - extent[0] + 1).reshape(-1)
            if positions is None:
                positions = np.zeros(last - first + 1, part.dtype.newbyteorder("="))
            positions[extent[0] - first : extent[1] - first + 1] = part
        assert positions is not None
        return positions

    def _read_mesh(self, section: str, name: str, choice: Choice) -> Field:
        need("vtk", self.path)
        pieces, values = [], []
        for piece in self._pieces:
            counts = [piece.get(f"NumberOf{what}", "") for what in ("Points", "Cells")]
            if not all(text.isascii() and text.isdigit() and len(text) < 12 for text in counts):
                raise DataError(self.path, f"a piece has {counts} points and cells", _REMEDY)
            points, cells = int(counts[0]), int(counts[1])
            if not points or not cells:
                continue
            inside, topology = piece.find("Points"), piece.find("Cells")
            element = None if inside is None else inside.find("DataArray")
            if element is None or topology is None:
                raise DataError(self.path, "a piece has no points or cells", _REMEDY)
            arrays = {e.get("Name"): e for e in topology.findall("DataArray")}
            if not {"connectivity", "offsets", "types"} <= set(arrays):
                raise DataError(self.path, "a piece has no connectivity, offsets or types", _REMEDY)
            ends = self.array(arrays["offsets"], cells).astype(np.int64)
            mesh = Mesh(
                self.array(element, points),
                self.array(arrays["connectivity"], int(ends[-1])).astype(np.int64),
                ends,
                self.array(arrays["types"], cells).astype(np.uint8),
            )
            pieces.append(mesh)
            values.append(
                self.array(self._element(piece, section, name), points if section == "PointData" else cells)
            )
        if not pieces:
            raise DataError(self.path, "has no cells", _REMEDY)
        if len({(v.shape[1:], v.dtype) for v in values}) > 1:
            raise DataError(self.path, f"{name!r} differs between its pieces", _REMEDY)
        together = scalar(np.concatenate(values), choice)
        return resampled(
            Mesh.joined(pieces, self.path), together, section == "CellData", choice.resolution, self.path
        )

    def array(self, element: ElementTree.Element, tuples: int) -> NDArray[np.generic]:
        """The values of a DataArray: (tuples,), or (tuples, components) of vectors.

        Raises:
            DataError: it holds another number.
        """
        kind, components = element.get("type", ""), self._components(element)
        if kind not in _TYPES or tuples < 0:
            raise DataError(self.path, f"an array of type {kind!r} is no field", _REMEDY)
        dtype = np.dtype(self._order + _TYPES[kind])
        need = _Extent(dtype, tuples * components)
        text = element.get("format", "ascii")
        if text == "appended":
            offset = element.get("offset", "")
            if not (offset.isascii() and offset.isdigit() and len(offset) < 20):
                raise DataError(self.path, f"an array has offset {offset!r}", _REMEDY)
            values = self._decode(self.bytes[self._appended :], int(offset), self._base64, need)
        elif text == "binary":
            inline = np.frombuffer((element.text or "").strip().encode("ascii", "replace"), np.uint8)
            values = self._decode(inline, 0, True, need)
        elif text == "ascii":
            written = (element.text or "").encode("ascii", "replace")
            values, _ = numbers_until(written, dtype.newbyteorder("="), need.count, self.path)
        else:
            raise DataError(self.path, f"an array has format {text!r}", _REMEDY)
        return values if components == 1 else values.reshape(tuples, components)

    def _decode(
        self, data: NDArray[np.uint8], start: int, base64: bool, need: _Extent
    ) -> NDArray[np.generic]:
        size = self._header.itemsize
        if not self._compressor:
            if not base64:
                declared = int(self._headers(data, start, 1, False)[0][0])
                self._check(declared, need, len(data) - start - size)
                return data[start + size : start + size + need.nbytes].view(need.dtype)
            (declared,), at = self._headers(data, start, 1, True)
            self._check(int(declared), need, (len(data) - start) * 3 // 4)
            if bytes(data[at - 1 : at]) == b"=":  # encoded apart from its values
                return self._plain(data[at:], 0, need)
            return self._plain(data[start:], size, need)
        (blocks, block, last), at = self._headers(data, start, 3, base64)
        if blocks * size > len(data) or block < 0 or last > block:
            raise DataError(self.path, "its compressed data are damaged", _REMEDY)
        (_, _, _, *sizes), at = self._headers(data, start, 3 + blocks, base64)
        declared = block * (blocks - (last > 0)) + last
        compressed = sum(sizes)
        self._check(declared, need, compressed * _COMPRESSORS[self._compressor] + 64)
        packed = data[at : at + (-(-compressed // 3) * 4 if base64 else compressed)]
        if base64:
            packed = np.frombuffer(self._unbase64(packed), np.uint8)
        if len(packed) < compressed:
            raise DataError(self.path, "its compressed data are cut off", _REMEDY)
        out = np.empty(need.nbytes, np.uint8)
        begin = fill = 0
        for number, length in enumerate(sizes):
            expected = last if last and number == blocks - 1 else block
            out[fill : fill + expected] = self._expanded(packed[begin : begin + length], expected)
            begin, fill = begin + length, fill + expected
        return out.view(need.dtype)

    def _headers(
        self, data: NDArray[np.uint8], start: int, count: int, base64: bool
    ) -> tuple[list[int], int]:
        """``count`` header integers from a position on, and the position after them."""
        size = count * self._header.itemsize
        length = -(-size // 3) * 4 if base64 else size
        raw = data[start : start + length].tobytes()
        if base64:
            raw = self._unbase64(np.frombuffer(raw, np.uint8))[:size]
        if len(raw) < size:
            raise DataError(self.path, "an array lies beyond the end of the file", _REMEDY)
        return [int(n) for n in np.frombuffer(raw, self._header)], start + length

    def _plain(self, data: NDArray[np.uint8], skip: int, need: _Extent) -> NDArray[np.generic]:
        """Uncompressed values from base64, chunk by chunk."""
        out = np.empty(skip + need.nbytes, np.uint8)
        fill, total = 0, -(-len(out) // 3) * 4
        for at in range(0, total, _CHUNK):
            part = self._unbase64(data[at : min(at + _CHUNK, total)])[: len(out) - fill]
            out[fill : fill + len(part)] = np.frombuffer(part, np.uint8)
            fill += len(part)
        if fill != len(out):
            raise DataError(self.path, "an array is cut off", _REMEDY)
        return out[skip:].view(need.dtype)

    def _unbase64(self, data: NDArray[np.uint8]) -> bytes:
        try:
            return binascii.a2b_base64(data.tobytes())
        except binascii.Error as error:
            raise DataError(self.path, f"its base64 data are damaged ({error})", _REMEDY) from error

    def _check(self, declared: int, need: _Extent, available: int) -> None:
        if declared != need.nbytes:
            raise DataError(self.path, f"an array holds {declared} bytes where {need} are needed", _REMEDY)
        if declared > available:
            raise DataError(
                self.path, f"is truncated: an array of {declared} bytes has {max(available, 0)}", _REMEDY
            )

    def _expanded(self, packed: NDArray[np.uint8], expected: int) -> Any:
        data = packed.tobytes()
        try:
            if self._compressor == "vtkZLibDataCompressor":
                raw = zlib.decompressobj().decompress(data, expected + 1)
            elif self._compressor == "vtkLZMADataCompressor":
                raw = lzma.LZMADecompressor(memlimit=1 << 28).decompress(data, expected + 1)
            else:
                raw = self._lz4(data, expected)
        except (zlib.error, lzma.LZMAError, ValueError) as error:
            raise DataError(self.path, f"its compressed data are damaged ({error})", _REMEDY) from error
        if len(raw) != expected:
            raise DataError(self.path, "a compressed block has another size than promised", _REMEDY)
        return np.frombuffer(raw, np.uint8)

    def _lz4(self, data: bytes, expected: int) -> bytes:
        need("vtk", self.path)
        from vtkmodules.vtkIOCore import vtkLZ4DataCompressor

        compressor: Any = vtkLZ4DataCompressor()
        warnings = compressor.GetGlobalWarningDisplay()
        out = np.empty(expected, np.uint8)
        try:
            compressor.GlobalWarningDisplayOff()
            size = compressor.Uncompress(np.frombuffer(data, np.uint8), len(data), out, expected)
        finally:
            compressor.SetGlobalWarningDisplay(warnings)
        return out[:size].tobytes()


@dataclass(frozen=True)
class _Extent:
    """Required type and number of an array's values."""

    dtype: np.dtype
    count: int

    @property
    def nbytes(self) -> int:
        return self.count * self.dtype.itemsize

    def __str__(self) -> str:
        return f"{self.nbytes} ({self.count} values of {self.dtype.name})"
