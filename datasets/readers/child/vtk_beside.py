"""The files beside the one that VTK is given: what lacks or is cut is named before VTK reads them.

VTK's own messages do not name them, and its OpenFOAM reader passes over a field whose header it cannot read.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from econgs_bench.datasets.errors import DataError

_REMEDY = "Copy all its files together"
_HEAD = 1 << 16
"""Bytes of a field of OpenFOAM that hold its header for certain."""
_NO_FIELDS = ("~", ".bak", ".BAK", ".old", ".save", "_0")
"""Ends of the names of files that VTK takes for no fields of OpenFOAM: copies and restarts."""
_XDMF_BYTES = {"CHAR": 1, "UCHAR": 1, "SHORT": 2, "USHORT": 2}


def check_ensight(path: Path) -> None:
    """Refuse an EnSight case without the file of its geometry.

    Raises:
        DataError: that file, or each one of a numbered series, is not there.
    """
    section = ""
    for line in path.read_text("utf-8", "replace").splitlines():
        words = line.split("#")[0].split()
        if len(words) == 1 and words[0].isupper():
            section = words[0]
        elif section == "GEOMETRY" and words[:1] == ["model:"]:
            while len(words) > 2 and words[1].isdigit():  # numbers of its time set and file set
                del words[1]
            names = [" ".join(words[1:]).strip("\"'"), *words[1:2]]
            if not any(_is_there(path.parent, name) for name in names):
                raise DataError(path, f"its geometry file {names[-1]} does not exist", _REMEDY)


def _is_there(folder: Path, name: str) -> bool:
    """Whether a file is there, or one of a series, in whose name ``*`` stands for digits."""
    at = folder / name
    pattern = re.compile(re.sub(r"(\\\*)+", r"\\d+", re.escape(at.name)))
    return at.is_file() or (
        "*" in name and at.parent.is_dir() and any(pattern.fullmatch(p.name) for p in at.parent.iterdir())
    )


def check_xdmf(path: Path, time: float | None) -> None:
    """Refuse an XDMF file without the values of a time step in the files that it names.

    Raises:
        DataError: a file or a dataset is not there, or is smaller than its dimensions say.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:  # VTK says why
        return
    for item in _items(root, time):
        kind, text = item.get("Format", "XML").upper(), (item.text or "").strip()
        count = math.prod(int(n) for n in item.get("Dimensions", "").split() if n.isdigit())
        if not text or item.get("Reference") or kind not in ("HDF", "BINARY"):
            continue
        if kind == "HDF":
            _check_dataset(path, text, count)
            continue
        at = path.parent / text
        if not at.is_file():
            raise DataError(path, f"its data file {text} does not exist", _REMEDY)
        size = _XDMF_BYTES.get(item.get("NumberType", "").upper()) or int(item.get("Precision", "4"))
        need = int(item.get("Seek", "0")) + count * size
        if not item.get("Compression") and at.stat().st_size < need:
            reason = f"its data file {text} is truncated: {at.stat().st_size} bytes of {need}"
            raise DataError(path, reason, _REMEDY)


def _items(within: ElementTree.Element, time: float | None) -> Iterator[ElementTree.Element]:
    """The data items of an element, without the grids of other times."""
    for child in within:
        of_grid = child.find("Time") if child.tag == "Grid" else None
        own = None if of_grid is None else _number(of_grid.get("Value", ""))
        if own is not None and time is not None and own != time:
            continue
        if child.tag == "DataItem":
            yield child
        yield from _items(child, time)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _check_dataset(path: Path, text: str, count: int) -> None:
    """Check a dataset ``FILE:NAME`` of HDF5."""
    import h5py

    file, _, name = text.rpartition(":")
    found = next((f for f in (file, file.rpartition(":")[2]) if (path.parent / f).is_file()), None)
    if not file or found is None:
        raise DataError(path, f"its data file {file or text} does not exist", _REMEDY)
    try:
        with h5py.File(path.parent / found, "r", locking=False) as data:
            stored = data.get(name)
            size = stored.size if isinstance(stored, h5py.Dataset) else None
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise DataError(path, f"its data file {found} is damaged ({error})", _REMEDY) from error
    if size is None:
        raise DataError(path, f"its data file {found} has no {name!r}", _REMEDY)
    if size < count:
        raise DataError(path, f"its data file {found} has {size} values of {count} in {name!r}", _REMEDY)


def check_foam(path: Path, time: float | None) -> None:
    """Refuse a time step of OpenFOAM with a file whose header is cut.

    Raises:
        DataError: such a file.
    """
    constant = path.parent / "constant"
    for folder in path.parent.iterdir():
        if time is None or _number(folder.name) != time or not folder.is_dir():
            continue
        regions = [at for at in folder.iterdir() if (constant / at.name / "polyMesh").is_dir()]
        for file in sorted(file for at in (folder, *regions) for file in at.iterdir() if file.is_file()):
            name = file.name.removesuffix(".gz")
            if not name.startswith(".") and not name.endswith(_NO_FIELDS) and _is_cut(file):
                reason = f"its file {file.relative_to(path.parent)} is truncated"
                raise DataError(path, reason, _REMEDY)


def _is_cut(file: Path) -> bool:
    """Whether a file of a case ends in its header, or within a compressed stream."""
    with file.open("rb") as stream:
        head = stream.read(_HEAD)
    if head.startswith(b"\x1f\x8b"):
        whole = len(head) < _HEAD
        inner = zlib.decompressobj(31)
        try:
            head = inner.decompress(head)
        except zlib.error:
            return True
        if whole and not inner.eof:
            return True
    text = re.sub(rb"/\*.*?(\*/|$)|//[^\n]*", b"", head, flags=re.DOTALL).lstrip()
    return not text or (b"FoamFile".startswith(text[:8]) and b"}" not in text)
