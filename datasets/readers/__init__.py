"""Volume files: one reader per format, chosen by the file's suffix.

``.raw`` and ``.raw.gz`` (:mod:`~datasets.readers.raw`), ``.npy``, NRRD and NIfTI. Whatever is wrong with a
file becomes one :class:`~datasets.errors.DataError` that names file, reason and remedy.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from datasets.errors import DataError

if TYPE_CHECKING:
    from datasets.volume import Volume

_FORMATS = {
    ".raw": "raw",
    ".raw.gz": "raw",
    ".npy": "npy",
    ".nrrd": "nrrd",
    ".nhdr": "nrrd",
    ".nii": "nifti",
    ".nii.gz": "nifti",
}


def suffix_of(path: Path) -> str:
    """The suffix that names a known volume format ("" if none does)."""
    name = path.name.lower()
    return max((s for s in _FORMATS if name.endswith(s)), key=len, default="")


def read_volume(
    path: Path | str,
    variable: str | None = None,
    *,
    spacing: tuple[float, float, float] | None = None,
) -> Volume:
    """Read one scalar field on a regular grid; memory-mapped where the format allows.

    Args:
        path: the file. ``.raw`` needs dims and type in its name or in a sidecar (see ``raw``).
        variable: the name to give to the field; default "value".
        spacing: sample distances along x, y, z; default what the file says, else 1.

    Returns:
        The volume; ``value_range`` is its finite minimum and maximum.

    Raises:
        DataError: the file cannot be used: missing, unreadable, a folder, truncated, of another size
            than promised, not three-dimensional, of unknown type, not finite, or constant.
    """
    path = Path(path)
    suffix = suffix_of(path)
    _check_file(path)
    if not suffix:
        raise DataError(path, "unknown volume format", f"Known suffixes: {', '.join(_FORMATS)}")

    from datasets.readers import finish

    try:
        if _FORMATS[suffix] == "raw":
            from datasets.readers.raw import read_raw as read
        elif _FORMATS[suffix] == "npy":
            from datasets.readers.npy import read_npy as read
        elif _FORMATS[suffix] == "nrrd":
            from datasets.readers.nrrd import read_nrrd as read
        else:
            from datasets.readers.nifti import read_nifti as read
        values, stored_spacing = read(path)
        return finish.make_volume(variable or "value", values, spacing or stored_spacing, path)
    except MemoryError as error:
        raise DataError(path, "does not fit into memory", "Subsample it, or use a larger machine") from error
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})", "Check the file and its permissions") from error


def _check_file(path: Path) -> None:
    try:
        if path.is_dir():
            raise DataError(path, "is a folder, not a volume file", "Name a file in it")
        if not path.exists():
            raise DataError(path, "no such file", "Check the path (relative to the current folder)")
        if not path.is_file():
            raise DataError(path, "is not a regular file", "Copy the volume into a plain file")
        with path.open("rb") as file:
            empty = not file.read(1)
    except (OSError, ValueError) as error:
        raise DataError(path, f"cannot be read ({error})", "Check the path and its permissions") from error
    if empty:
        raise DataError(path, "is empty", "Copy or download it again")
