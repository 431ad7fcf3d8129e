"""What a file is by its first bytes; its name only hints, and decides where they say nothing."""

from __future__ import annotations

import re
import zipfile
import zlib
from pathlib import Path

_VTK = {"ImageData": "vti", "RectilinearGrid": "vtr", "StructuredGrid": "vts", "UnstructuredGrid": "vtu"}
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
ZARR = frozenset({".zgroup", ".zarray", "zarr.json"})
"""Files that make a folder a group or an array of Zarr."""
_BARE_DICOM = tuple(bytes([group, 0, element, 0]) for group in (2, 8) for element in (0, 1, 5, 8, 0x10, 0x16))
"""First tags of DICOM files that have no preamble."""
_TYPES = (b"UL", b"OB", b"UI", b"CS", b"SH")
"""Types of their elements."""
_SHORT = 120
"""Most bytes of a first element, so that the next tag is among the bytes that tell a DICOM file."""


def suffix_of(path: Path, known: set[str]) -> str:
    """The longest known suffix of a name; "" for none. PLOT3D files may end with ``xyz.bin``, ``q.bin``."""
    name = path.name.lower()
    found = max((s for s in known if name.endswith(s)), key=len, default="")
    if not found and (match := re.search(r"(xyz|q)\.bin$", name)):
        return f".{match[1]}"
    return found


def visible(folder: Path) -> list[Path]:
    """The files of a folder by name, without those that systems add beside them.

    macOS puts ``._a.png`` beside ``a.png`` where a disk or an archive has no place for its attributes.
    """
    files = (file for file in folder.iterdir() if file.is_file())
    added = ("thumbs.db", "desktop.ini")
    return sorted(f for f in files if not f.name.startswith(".") and f.name.lower() not in added)


def suffix_by_content(path: Path) -> str:
    """The suffix that a file of this content should have; "" if its first bytes do not tell.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    if head.startswith(b"\x1f\x8b"):
        inner = zlib.decompressobj(31)
        try:
            return ".nii.gz" if _is_nifti(inner.decompress(head, 1024)) else ""
        except zlib.error:
            return ""
    for start, suffix in ((b"\x93NUMPY", ".npy"), (b"\x89HDF\r\n\x1a\n", ".h5"), (b"NRRD", ".nrrd"),
                          (b"CDF\1", ".nc"), (b"CDF\2", ".nc"), (b"CDF\5", ".nc"),
                          (b"# vtk DataFile", ".vtk")):  # fmt: skip
        if head.startswith(start):
            return suffix
    if head.startswith(_TIFF):
        return ".tif"
    if is_dicom(head):
        return ".dcm"
    if _is_nifti(head):
        return ".nii"
    if head.startswith(b"PK\3\4"):
        return _of_zip(path)
    text = head.lstrip(b"\xef\xbb\xbf \r\n\t")
    if text.startswith(b"<") and (match := re.search(rb"<VTKFile\b[^>]*\btype\s*=\s*[\"'](P?)(\w+)", text)):
        kind = _VTK.get(match[2].decode(), "")
        return f".{match[1].decode().lower()}{kind}" if kind else ""
    if text.startswith(b"<") and b"<Xdmf" in text:
        return ".xdmf"
    if re.match(rb"(ObjectType|NDims|Comment|ObjectSubType)\s*=", text) and b"DimSize" in text:
        return ".mhd"
    return ""


def is_dicom(head: bytes) -> bool:
    """Whether bytes are the beginning of a DICOM file, with or without preamble."""
    return head[128:132] == b"DICM" or (head.startswith(_BARE_DICOM) and _has_element(head))


def _has_element(head: bytes) -> bool:
    """Whether bytes begin with an element: it has a type, or an even length up to another one of group 8.

    Four bytes alone may be numbers, as in PLOT3D files and pictures of labels.
    """
    if head[4:6] in _TYPES:
        return True
    length = int.from_bytes(head[4:8], "little")
    group, element = head[8 + length : 10 + length], head[10 + length : 12 + length]
    ascends = int.from_bytes(element, "little") > int.from_bytes(head[2:4], "little")
    return length <= _SHORT and length % 2 == 0 and group == head[:2] == b"\x08\0" and ascends


def _is_nifti(head: bytes) -> bool:
    return head[344:348] in (b"n+1\0", b"ni1\0") or head[4:8] in (b"n+2\0", b"ni2\0")


def _of_zip(path: Path) -> str:
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name.rpartition("/")[2] for name in archive.namelist()]
    except (zipfile.BadZipFile, ValueError, NotImplementedError):
        return ""
    if ZARR & set(names):
        return ".zarr.zip"
    return ".npz" if any(name.endswith(".npy") for name in names) else ""
