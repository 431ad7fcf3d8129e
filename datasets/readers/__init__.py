"""Volume files: one reader per format, chosen by the file's suffix.

``.raw`` and ``.raw.gz`` (:mod:`~datasets.readers.raw`), ``.npy``, NRRD and NIfTI hold one field. ``.npz``,
HDF5, NetCDF, VTK's files and Exodus meshes hold variables by name, some with time steps. Every fault of a
file becomes one :class:`~datasets.errors.DataError` that names file, reason and remedy.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from datasets.errors import DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from datasets.readers.container import Container
    from datasets.readers.fields import Source, Variable
    from datasets.volume import Volume

_SINGLE = {
    ".raw": "raw",
    ".raw.gz": "raw",
    ".npy": "npy",
    ".nrrd": "nrrd",
    ".nhdr": "nrrd",
    ".nii": "nifti",
    ".nii.gz": "nifti",
}
_CONTAINERS = {
    ".npz": "npz",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".nc": "netcdf",
    ".vti": "vtk_xml",
    ".vtr": "vtk_xml",
    ".vtu": "vtk_xml",
    ".vtk": "vtk_legacy",
    ".ex2": "exodus",
    ".exo": "exodus",
    ".e": "exodus",
}
_FORMATS = _SINGLE | _CONTAINERS


def suffix_of(path: Path) -> str:
    """The suffix of a known volume format, else ""."""
    name = path.name.lower()
    return max((s for s in _FORMATS if name.endswith(s)), key=len, default="")


def list_variables(path: Path | str) -> tuple[Variable, ...]:
    """The variables of a file with dims and time steps; empty for formats of one unnamed field.

    Raises:
        DataError: the file is unusable.
    """
    path = Path(path)
    if _suffix(path) in _SINGLE:
        return ()
    try:
        return _source(path).variables
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})", "Check the file and its permissions") from error


def read_volume(
    path: Path | str,
    variable: str | None = None,
    *,
    array: str | None = None,
    step: int | None = None,
    resolution: int | None = None,
    spacing: tuple[float, float, float] | None = None,
) -> Volume:
    """Read one scalar field on a regular grid; memory-mapped where the format allows.

    Args:
        path: the file. ``.raw`` needs dims and type in its name or in a sidecar (see ``raw``).
        variable: name of the result; default: its name in the file, else "value".
        array: name in the file, for files of named variables; default: ``variable``. A vector gives its
            magnitude; its components are ``name.x``, ``name.y``, ``name.z``.
        step: time step, from 0; default: the first.
        resolution: samples along the longest side, for meshes only (default 128).
        spacing: sample distances along x, y, z; default: those of the file, else 1.

    Returns:
        The volume; ``value_range`` is its finite minimum and maximum (of a mesh, that at its points).

    Raises:
        UnknownName: the file has no such variable; the remedy lists near matches.
        DataError: the file is missing, unreadable, a folder, truncated, of another size than its header
            promises, not three-dimensional, of unknown type, not finite, or constant; or it has no such time
            step, or is a grid, which takes no resolution.
    """
    path = Path(path)
    suffix = _suffix(path)

    from datasets.readers import finish
    from datasets.readers.fields import Field, choose, plain
    from datasets.volume import Volume

    try:
        if suffix in _SINGLE:
            _refuse_choice(path, array, step, resolution)
            field, in_file = Field(*_read_single(path, _SINGLE[suffix])), "value"
        else:
            source = _source(path)
            choice = choose(path, source.variables, array or variable, step, resolution)
            field, in_file = source.read(choice), plain(choice.name)
        spacing = spacing or field.spacing
        values = finish.checked_grid(field.values, spacing, path)
        size = (float(spacing[0]), float(spacing[1]), float(spacing[2]))
        bounds = field.value_range or finish.value_range(values, path)
        points = field.vertices, field.vertex_values
        return Volume(variable or in_file, values, size, bounds, str(path), field.mask, *points)
    except MemoryError as error:
        raise DataError(path, "does not fit into memory", "Subsample it, or use a larger machine") from error
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})", "Check the file and its permissions") from error


def _suffix(path: Path) -> str:
    suffix = suffix_of(path)
    _check_file(path)
    if not suffix:
        raise DataError(path, "unknown volume format", f"Known suffixes: {', '.join(_FORMATS)}")
    return suffix


def _refuse_choice(path: Path, array: str | None, step: int | None, resolution: int | None) -> None:
    if array is not None or step or resolution is not None:
        key = "variable" if array is not None else "step" if step else "resolution"
        raise DataError(path, f"its format holds one field: it has no choice of {key}", "Leave it out")


def _read_single(path: Path, kind: str) -> tuple[NDArray[np.generic], tuple[float, float, float]]:
    from datasets.readers.nifti import read_nifti
    from datasets.readers.npy import read_npy
    from datasets.readers.nrrd import read_nrrd
    from datasets.readers.raw import read_raw

    readers = {"raw": read_raw, "npy": read_npy, "nrrd": read_nrrd, "nifti": read_nifti}
    return readers[kind](path)


def _source(path: Path) -> Source:
    kind = _CONTAINERS[suffix_of(path)]
    if kind == "vtk_xml":
        from datasets.readers.vtk_xml import XmlFile

        return XmlFile(path)
    if kind == "vtk_legacy":
        from datasets.readers.vtk_legacy import LegacyFile

        return LegacyFile(path)
    if kind == "exodus":
        from datasets.readers.exodus import Exodus

        return Exodus(path, _netcdf(path))
    from datasets.readers.arrays import Arrays

    if kind == "npz":
        from datasets.readers.npz import Npz

        return Arrays(path, Npz(path), missing=False)
    if kind == "netcdf":
        return Arrays(path, _netcdf(path), missing=True)
    from datasets.readers.hdf5 import Hdf5

    return Arrays(path, Hdf5(path), missing=True)


def _netcdf(path: Path) -> Container:
    """Classic NetCDF, or NetCDF-4, which is HDF5."""
    with path.open("rb") as file:
        classic = file.read(3) == b"CDF"
    if classic:
        from datasets.readers.netcdf3 import NetCdf3

        return NetCdf3(path)
    from datasets.readers.hdf5 import Hdf5

    return Hdf5(path)


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
