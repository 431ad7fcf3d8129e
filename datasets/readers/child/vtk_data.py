"""Grids and meshes through VTK's readers; only the modules of one reader are imported."""

from __future__ import annotations

import math
import mmap
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import get_numpy_array_type, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkCommand, vtkObject, vtkOutputWindow
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.vtk_beside import check_ensight, check_foam, check_xdmf
from econgs_bench.datasets.readers.content import suffix_by_content, suffix_of
from econgs_bench.datasets.readers.fields import channels_of
from econgs_bench.datasets.readers.vtk_legacy import MASKS

READERS = {
    ".vti": "vtkIOXML.vtkXMLImageDataReader",
    ".vtr": "vtkIOXML.vtkXMLRectilinearGridReader",
    ".vts": "vtkIOXML.vtkXMLStructuredGridReader",
    ".vtu": "vtkIOXML.vtkXMLUnstructuredGridReader",
    ".pvti": "vtkIOXML.vtkXMLPImageDataReader",
    ".pvtr": "vtkIOXML.vtkXMLPRectilinearGridReader",
    ".pvts": "vtkIOXML.vtkXMLPStructuredGridReader",
    ".pvtu": "vtkIOXML.vtkXMLPUnstructuredGridReader",
    ".vtkhdf": "vtkIOHDF.vtkHDFReader",
    ".hdf": "vtkIOHDF.vtkHDFReader",
    ".vtk": "vtkIOLegacy.vtkDataSetReader",
    ".slc": "vtkIOImage.vtkSLCReader",
    ".case": "vtkIOEnSight.vtkGenericEnSightReader",
    ".xdmf": "vtkIOXdmf2.vtkXdmfReader",
    ".xmf": "vtkIOXdmf2.vtkXdmfReader",
    ".foam": "vtkIOGeometry.vtkOpenFOAMReader",
    ".xyz": "vtkIOParallel.vtkMultiBlockPLOT3DReader",
    ".q": "vtkIOParallel.vtkMultiBlockPLOT3DReader",
}
_IN_PIECES = (".vti", ".vtr", ".vts", ".pvti", ".pvtr", ".pvts")
_DUPLICATE_CELL, _HIDDEN_POINT, _HIDDEN_CELL = 1, 2, 32
_MOST_BLOCKS = 1 << 24
_CHECKS = {".xdmf": check_xdmf, ".xmf": check_xdmf, ".foam": check_foam}
"""Checks of the files of a time step before VTK reads them."""
_NAN_IS_MISSING = (".case",)
"""Formats with missing values, which VTK gives as NaN."""
_MOST_STEPS = 16
"""Time steps that are looked into for variables that the first one lacks."""
_AGAIN = "Copy it again, or write it again with VTK or ParaView"


def open_source(path: str) -> VtkData:
    """The data of a file."""
    return VtkData(Path(path))


class VtkData:
    """What a reader makes of a file, step by step."""

    def __init__(self, path: Path) -> None:
        self._path = path
        found = suffix_by_content(path) if path.is_file() and path.stat().st_size else ""
        suffix = {".h5": ".vtkhdf"}.get(found, found) or suffix_of(path, set(READERS))
        self._suffix = suffix
        if suffix[1:].lstrip("p")[:2] == "vt" and suffix not in (".vtk", ".vtkhdf"):
            _check_xml(path, suffix in _IN_PIECES)
        if suffix == ".case":
            check_ensight(path)
        self._reader = _reader(path, suffix)
        self._reader.UpdateInformation()
        self._check_code()
        information = self._reader.GetOutputInformation(0)
        key = Pipeline.TIME_STEPS()
        self._times = [information.Get(key, i) for i in range(information.Length(key))]
        self._step = -1
        self._update(0)

    def contents(self) -> dict[str, Any]:
        """Name, dims (None for meshes), steps and components of each variable of any step."""
        variables = self._variables()
        unseen = _announced(self._reader) - self._names
        if unseen and len(self._times) > 1:
            unseen = self._add_later(variables, unseen)
        notice = {"notice": f"no values of {_listed(unseen)} were found"} if unseen else {}
        return {"variables": list(variables.values())} | notice

    def _variables(self) -> dict[str, dict[str, Any]]:
        """Entries by name, of the present step."""
        steps = max(1, len(self._times))
        variables = {}
        for name, (of_cells, array) in self._arrays().items():
            dims = None if self._mesh else _dims(self._data, of_cells)
            entry = {
                "name": name,
                "dims": dims,
                "components": array.GetNumberOfComponents(),
            }
            kind = np.dtype(get_numpy_array_type(array.GetDataType()))
            channels = channels_of(entry["components"], kind)
            variables[name] = {**entry, "steps": steps, "channels": channels}
        return variables

    def _add_later(self, variables: dict[str, dict[str, Any]], unseen: set[str]) -> set[str]:
        """Add variables of other steps, the last one first; the names that none of these has.

        A step that is damaged says so when it is read.
        """
        last = len(self._times) - 1
        with _silence():
            ahead = VtkData(self._path)  # of its own: what fails must not stay
            for step in dict.fromkeys(int(s) for s in (last, *np.linspace(1, last, _MOST_STEPS))):
                with suppress(DataError):
                    ahead._update(step)
                    variables.update({k: v for k, v in ahead._variables().items() if k not in variables})
                    unseen = unseen - ahead._names
                if not unseen:
                    break
        return unseen

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """A variable at a step, with the positions of its samples or the mesh that it belongs to."""
        self._update(step)
        arrays = self._arrays()
        if read not in arrays:
            raise DataError(self._path, f"has no {read!r} at time step {step}", "Choose another step")
        of_cells, array = arrays[read]
        values = vtk_to_numpy(array).reshape(self._count(of_cells), -1)
        valid = None
        if self._suffix in _NAN_IS_MISSING and values.dtype.kind == "f":
            valid = ~np.isnan(values).any(axis=1)
        values = values[:, 0] if values.shape[1] == 1 else values
        take = _mesh if self._mesh else _grid
        return {"of_cells": of_cells}, take(self._data, of_cells, values, valid)

    def _update(self, step: int) -> None:
        if step == self._step:
            return
        time = self._times[step] if self._times else None
        if self._suffix in _CHECKS:
            _CHECKS[self._suffix](self._path, time)
        if _update(self._reader, time):
            self._blame(time)
        self._check_code()
        self._step = step
        leaves = list(_leaves(self._reader.GetOutputDataObject(0)))
        if not leaves:
            raise DataError(self._path, "holds no grid and no mesh", "Check that all its files are there")
        self._mesh = len(leaves) > 1 or not _is_grid(leaves[0])
        self._names = {name for leaf in leaves for name in _names(leaf)}
        self._data = _joined(leaves) if self._mesh else leaves[0]

    def _blame(self, time: float | None) -> None:
        """Name the variables that VTK cannot read, unless it cannot read the file without any.

        Raises:
            DataError: there are such variables; VTK's message, on stderr, comes with it.
        """
        reader = _reader(self._path, self._suffix)
        reader.UpdateInformation()
        names = _announced(reader)
        bad = {one for one in ("", *sorted(names)) if _update(reader, time, only=one)}
        if bad and "" not in bad:
            raise DataError(self._path, f"its {_listed(bad)} cannot be read", _AGAIN)

    def _check_code(self) -> None:
        code = self._reader.GetErrorCode()
        if code:
            from vtkmodules.vtkCommonMisc import vtkErrorCode

            reason = f"is damaged or unreadable: {vtkErrorCode.GetStringFromErrorCode(code)}"
            raise DataError(self._path, reason, _AGAIN)

    def _count(self, of_cells: bool) -> int:
        return int(self._data.GetNumberOfCells() if of_cells else self._data.GetNumberOfPoints())

    def _arrays(self) -> dict[str, tuple[bool, Any]]:
        """Name -> whether it belongs to cells, and the array."""
        arrays: dict[str, tuple[bool, Any]] = {}
        for of_cells, data in ((False, self._data.GetPointData()), (True, self._data.GetCellData())):
            for number in range(data.GetNumberOfArrays()):
                array = data.GetArray(number)  # None for texts
                name = data.GetArrayName(number)
                if array is None or not name or name in MASKS or not _numeric(array):
                    continue
                if array.GetNumberOfValues() and array.GetNumberOfValues() % self._count(of_cells) == 0:
                    arrays[f"{name}_cells" if name in arrays else name] = of_cells, array
        return arrays


def _reader(path: Path, suffix: str) -> Any:
    module, name = READERS[suffix].split(".")
    reader = getattr(import_module(f"vtkmodules.{module}"), name)()
    if suffix in (".xyz", ".q"):
        reader.SetXYZFileName(str(_beside(path, "xyz")))
        reader.SetQFileName(str(_beside(path, "q")))
        reader.AutoDetectFormatOn()
    elif suffix == ".vtk":
        reader.SetFileName(str(path))
        for what in ("Scalars", "Vectors", "Normals", "Tensors", "TCoords", "ColorScalars", "Fields"):
            getattr(reader, f"ReadAll{what}On")()
    elif suffix == ".case":
        reader.SetCaseFileName(str(path))
        reader.ReadAllVariablesOn()
    else:
        reader.SetFileName(str(path))
    if suffix == ".foam":
        reader.CreateCellToPointOff()
    return reader


def _announced(reader: Any) -> set[str]:
    """Names of the arrays that a reader can read, of all time steps, if it says them."""
    names: set[str] = set()
    for kind in ("Point", "Cell"):
        if hasattr(reader, f"GetNumberOf{kind}Arrays"):
            number = getattr(reader, f"GetNumberOf{kind}Arrays")()
            names |= {getattr(reader, f"Get{kind}ArrayName")(i) for i in range(number)}
    return names


def _names(data: Any) -> set[str]:
    sections = (data.GetPointData(), data.GetCellData())
    return {section.GetArrayName(i) for section in sections for i in range(section.GetNumberOfArrays())}


def _listed(names: set[str]) -> str:
    return ", ".join(map(repr, sorted(names)))


def _update(reader: Any, time: float | None, only: str | None = None) -> bool:
    """Read a time step, or one variable of it ("": none); whether VTK complained of an error."""
    if only is not None:
        for kind in ("Point", "Cell"):
            for name in _announced(reader) if hasattr(reader, f"Set{kind}ArrayStatus") else ():
                getattr(reader, f"Set{kind}ArrayStatus")(name, int(name == only))
    errors: list[str] = []
    window = vtkOutputWindow.GetInstance()
    observer = window.AddObserver(vtkCommand.ErrorEvent, lambda _, event: errors.append(event))
    if time is None:
        reader.Update()
    else:
        reader.UpdateTimeStep(time)
    window.RemoveObserver(observer)
    return bool(errors)


@contextmanager
def _silence() -> Iterator[None]:
    """Without VTK's messages."""
    vtkObject.GlobalWarningDisplayOff()
    try:
        yield
    finally:
        vtkObject.GlobalWarningDisplayOn()


def _check_xml(path: Path, in_pieces: bool) -> None:
    """Refuse a cut file, and pieces that lack values or do not fill a grid: VTK leaves them as memory was."""
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if b"<VTKFile" in data[:4096] and b"</VTKFile>" not in data[-1024:]:
            raise DataError(path, "is truncated: its end, </VTKFile>, is not there", "Copy it again")
        end = data.find(b"<AppendedData")
        _check_arrays(path, data, len(data) if end < 0 else end)
        if not in_pieces:
            return
        extents = [
            (match[1], [int(n) for n in match[2].split()][:6])
            for match in re.finditer(rb"\b(WholeExtent|Extent)\s*=\s*[\"']([-+0-9 ]+)[\"']", data)
            if end < 0 or match.start() < end
        ]
    extents = [(kind, extent) for kind, extent in extents if len(extent) == 6]
    whole = next((extent for kind, extent in extents if kind == b"WholeExtent"), None)
    pieces = [extent for kind, extent in extents if kind == b"Extent"]
    if whole is not None and not _is_covered(path, whole, pieces):
        raise DataError(path, "its pieces do not fill its extent", "Write it again with VTK or ParaView")


def _check_arrays(path: Path, data: mmap.mmap, end: int) -> None:
    """Refuse a piece without an array of the first one; pieces may be empty."""
    pieces: list[set[tuple[bytes, bytes]]] = []
    section, tag = b"", rb"<(/?)(Piece|PointData|CellData|DataArray)\b([^<>]*)>"
    for match in re.compile(tag).finditer(data, 0, end):
        closes, kind, attributes = match.groups()
        if kind == b"Piece" and not closes:
            empty = re.search(rb"NumberOfPoints\s*=\s*[\"']0[\"']", attributes) or b"0 -1" in attributes
            pieces += [] if empty else [set()]
            section = b""
        elif kind == b"DataArray":
            name = re.search(rb"\bName\s*=\s*[\"']([^\"']*)", attributes)
            if section and name and pieces:
                pieces[-1].add((section, name[1]))
        elif kind != b"Piece":
            section = b"" if closes or attributes.endswith(b"/") else kind
    for piece in pieces[1:]:
        if lacking := pieces[0] - piece:
            array = min(lacking)[1].decode("utf-8", "replace")
            raise DataError(path, f"a piece of it lacks {array!r}", "Write it again with VTK or ParaView")


def _is_covered(path: Path, whole: list[int], pieces: list[list[int]]) -> bool:
    """Whether every cell of an extent lies in a piece: cells between the same borders of pieces are one."""
    borders: list[dict[int, int]] = []
    boxes = [[low, max(high, low + 1)] for low, high in zip(whole[::2], whole[1::2], strict=True)]
    flat = [high == low for low, high in zip(whole[::2], whole[1::2], strict=True)]
    for axis, (low, high) in enumerate(boxes):
        ends = {end for piece in pieces for end in piece[2 * axis : 2 * axis + 2] if low < end < high}
        borders.append({end: at for at, end in enumerate(sorted({low, high, *ends}))})
    sizes = [len(ends) - 1 for ends in borders]
    if math.prod(sizes) > _MOST_BLOCKS:
        raise DataError(path, "has too many pieces to check", "Write it again with VTK or ParaView")
    covered = np.zeros(sizes, np.bool_)
    for piece in pieces:
        block = []
        for axis, (low, high) in enumerate(boxes):
            first, last = piece[2 * axis : 2 * axis + 2]
            last = max(last, first + 1) if flat[axis] else last
            first, last = min(max(first, low), high), min(max(last, low), high)
            block.append(slice(borders[axis][first], borders[axis][last]))
        covered[tuple(block)] = True
    return bool(covered.all())


def _beside(path: Path, part: str) -> Path:
    """PLOT3D's grid ("xyz") or solution ("q") of either: ``a.xyz``, ``a.q`` or ``axyz.bin``, ``aq.bin``."""
    match = re.fullmatch(r"(.*?)(xyz|q)(\.bin)?", path.name, re.IGNORECASE)
    assert match is not None
    name = f"{match[1]}{part}{match[3] or ''}"
    for other in path.parent.iterdir():
        if other.name.lower() == name.lower():
            return other
    raise DataError(path, f"PLOT3D needs {name} beside it", "Keep both files together, with one name")


def _leaves(data: Any) -> Iterator[Any]:
    """The grids and meshes of a dataset, those of a collection one by one."""
    if data is None:
        return
    if data.IsA("vtkCompositeDataSet"):
        iterator = data.NewIterator()
        iterator.InitTraversal()
        while not iterator.IsDoneWithTraversal():
            yield from _leaves(iterator.GetCurrentDataObject())
            iterator.GoToNextItem()
    elif data.IsA("vtkDataSet") and data.GetNumberOfCells():
        yield data


def _is_grid(data: Any) -> bool:
    return bool(data.IsA("vtkImageData") or data.IsA("vtkRectilinearGrid"))


def _joined(leaves: list[Any]) -> Any:
    """All as one unstructured mesh, with the arrays that all have."""
    if len(leaves) == 1 and leaves[0].IsA("vtkUnstructuredGrid"):
        return leaves[0]
    from vtkmodules.vtkFiltersCore import vtkAppendFilter

    together = vtkAppendFilter()
    for leaf in leaves:
        together.AddInputData(leaf)
    together.Update()
    return together.GetOutput()


def _dims(data: Any, of_cells: bool) -> list[int]:
    return [max(n - of_cells, 1) for n in data.GetDimensions()]


def _numeric(array: Any) -> bool:
    try:
        return np.dtype(get_numpy_array_type(array.GetDataType())).kind in "iuf"
    except (KeyError, TypeError):
        return False


def _grid(
    data: Any, of_cells: bool, values: NDArray[Any], given: NDArray[np.bool_] | None
) -> dict[str, NDArray[Any]]:
    """Values (z, y, x) or (z, y, x, components), positions along the axes, and the mask of missing ones."""
    shape = tuple(reversed(_dims(data, of_cells)))
    parts = {"values": values.reshape(*shape, *values.shape[1:])}
    for axis, name in enumerate("xyz"):
        if data.IsA("vtkImageData"):
            positions = data.GetSpacing()[axis] * np.arange(data.GetDimensions()[axis], dtype=np.float64)
        else:
            positions = vtk_to_numpy(getattr(data, f"Get{name.upper()}Coordinates")())
        parts[name] = 0.5 * (positions[1:] + positions[:-1]) if of_cells else positions
    masks = [] if given is None else [given.reshape(shape)]
    for section, hidden in ((data.GetPointData(), _HIDDEN_POINT), (data.GetCellData(), _HIDDEN_CELL)):
        flags = _valid(section, hidden)
        if flags is not None:
            cells = hidden == _HIDDEN_CELL
            flags = flags.reshape(tuple(reversed(_dims(data, cells))))
            masks.append(flags if cells == of_cells else _carried(flags, data.GetDimensions(), of_cells))
    return parts | {"mask": np.logical_and.reduce(masks).view(np.uint8)} if masks else parts


def _carried(flags: NDArray[np.bool_], dims: tuple[int, int, int], to_cells: bool) -> NDArray[np.bool_]:
    """Flags (z, y, x) of a grid's points as those of its cells, all of whose points have it, or the reverse.

    A point has the flag that any of its cells has.
    """
    for axis, n in enumerate(reversed(dims)):
        if n < 2:
            continue
        if not to_cells:
            flags = np.pad(flags, [(int(a == axis), int(a == axis)) for a in range(3)])
        first, second = (np.take(flags, np.arange(flags.shape[axis] - 1) + k, axis) for k in (0, 1))
        flags = first & second if to_cells else first | second
    return flags


def _valid(section: Any, hidden: int) -> NDArray[np.bool_] | None:
    """False where VTK blanked a point or cell, or its resampling found nothing; None: all are valid."""
    valid: NDArray[np.bool_] | None = None
    for name in MASKS:
        array = section.GetArray(name)
        if array is not None:
            flags = vtk_to_numpy(array).reshape(array.GetNumberOfTuples(), -1)[:, 0]
            one = flags != 0 if name == "vtkValidPointMask" else (flags.astype(np.uint8) & hidden) == 0
            valid = one if valid is None else valid & one
    return valid


def _mesh(
    data: Any, of_cells: bool, values: NDArray[Any], given: NDArray[np.bool_] | None
) -> dict[str, NDArray[Any]]:
    """Points, cells and values, without blanked cells and the copies of neighbouring pieces.

    ``mask`` is False for values that are missing (``given``); without any, it is not there.
    """
    cells = data.GetCells()
    ends = _numbers(cells.GetOffsetsArray())[1:]
    connectivity, types = _numbers(cells.GetConnectivityArray()), _numbers(data.GetCellTypes())
    counts = np.diff(ends, prepend=0)

    def all_of(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Per cell, whether all its points have a flag."""
        unset = np.bincount(np.repeat(np.arange(len(ends)), counts), ~flags[connectivity], len(ends))
        return np.asarray(unset == 0)

    keep = _valid(data.GetCellData(), _HIDDEN_CELL | _DUPLICATE_CELL)
    shown = _valid(data.GetPointData(), _HIDDEN_POINT)
    if shown is not None and not shown.all():
        keep = all_of(shown) if keep is None else keep & all_of(shown)
    if keep is not None and not keep.all():
        connectivity = connectivity[np.repeat(keep, counts)]
        ends, types = np.cumsum(counts[keep]), types[keep]
        values = values[keep] if of_cells else values
        given = given[keep] if of_cells and given is not None else given
    return {
        "points": vtk_to_numpy(data.GetPoints().GetData()),
        "connectivity": connectivity,
        "ends": ends,
        "types": types.astype(np.uint8),
        "values": values,
        **({} if given is None else {"mask": given.view(np.uint8)}),
    }


def _numbers(array: Any) -> NDArray[np.int64]:
    """Whole numbers of any VTK array, also one that computes them instead of holding them."""
    from vtkmodules.vtkCommonCore import vtkTypeInt64Array

    plain = vtkTypeInt64Array()
    plain.DeepCopy(array)
    return np.asarray(vtk_to_numpy(plain))
