"""Volume files: one reader per format, chosen by the first bytes, the suffix, or what a folder holds.

``.raw`` and ``.raw.gz`` (:mod:`~.datasets.readers.raw`), ``.npy``, NRRD and NIfTI hold one field. All others
hold variables by name, some with time steps. What VTK, SimpleITK, tifffile, h5py and zarr read, and
nibabel of MINC, they read in a process of their own (:mod:`~.datasets.readers.sandbox`). Every fault of a
file becomes one :class:`~.datasets.errors.DataError` that names file, reason and remedy.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers import content

if TYPE_CHECKING:
    from econgs_bench.datasets.readers.container import Container
    from econgs_bench.datasets.readers.fields import Source, Variable
    from econgs_bench.datasets.readers.limits import Limits
    from econgs_bench.datasets.readers.single import Single
    from econgs_bench.datasets.volume import Volume

_SINGLE = {
    ".raw": "raw",
    ".raw.gz": "raw",
    ".npy": "npy",
    ".nrrd": "nrrd",
    ".nhdr": "nrrd",
    ".nii": "nifti",
    ".nii.gz": "nifti",
    ".img": "nifti",
    ".hdr": "nifti",
    ".img.gz": "nifti",
    ".hdr.gz": "nifti",
}
_CONTAINERS = {
    ".npz": "npz",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".hdf": "hdf",
    ".nc": "netcdf",
    ".nc4": "netcdf",
    ".mnc": "netcdf",
    ".zarr": "zarr",
    ".zarr.zip": "zarr",
    ".vtk": "vtk_legacy",
    ".ex2": "exodus",
    ".exo": "exodus",
    ".e": "exodus",
    ".mha": "itk",
    ".mhd": "itk",
    ".dcm": "itk",
    ".tif": "slices",
    ".tiff": "slices",
    **dict.fromkeys((".vti", ".vtr", ".vts", ".vtu"), "vtk_data"),
    **dict.fromkeys((".pvti", ".pvtr", ".pvts", ".pvtu", ".vtkhdf"), "vtk_data"),
    **dict.fromkeys((".slc", ".case", ".xdmf", ".xmf", ".foam", ".xyz", ".q"), "vtk_data"),
}
_FORMATS = _SINGLE | _CONTAINERS
_KEPT_IN = {
    **dict.fromkeys((".hdf5", ".hdf", ".nc", ".nc4", ".mnc", ".vtkhdf"), (".h5", ".nc")),
    **dict.fromkeys((".ex2", ".exo", ".e"), (".h5", ".nc")),
    **dict.fromkeys((".nhdr", ".tiff", ".mha"), (".nrrd", ".tif", ".mhd")),
    **dict.fromkeys((".img", ".hdr"), (".nii",)),
    ".nii.gz": (".nii",),
    ".nii": (".nii.gz",),
    ".xmf": (".xdmf",),
}
"""Suffix -> contents that it goes together with."""
_LOOK = 20
"""Files of a folder that are looked into for DICOM."""


def suffix_of(path: Path) -> str:
    """The suffix of a known volume format, else ""."""
    return content.suffix_of(path, set(_FORMATS))


def folder_kind(path: Path) -> str:
    """How a folder holds a volume: "zarr", "slices" (pictures), "itk" (DICOM), or "" if it does not.

    Raises:
        OSError: the folder cannot be read.
    """
    from econgs_bench.datasets.posed_images import holds_views

    names = {file.name for file in path.iterdir()}
    if holds_views(path):
        return ""
    if names & {*content.ZARR, ".zmetadata"} or suffix_of(path) == ".zarr":
        return "zarr"
    files = content.visible(path)
    pictures = [file for file in files if file.suffix.lower() in (".tif", ".tiff", ".png")]
    others = [file for file in files if file not in pictures]
    if "DICOMDIR" in names or any(map(_is_dicom, others[:_LOOK])):
        return "itk"
    return "slices" if pictures else ""


def _is_dicom(file: Path) -> bool:
    with file.open("rb") as stream:
        return file.suffix.lower() == ".dcm" or content.is_dicom(stream.read(132))


def list_variables(path: Path | str) -> tuple[Variable, ...]:
    """The variables of a file with dims and time steps; empty where there is but one unnamed scalar.

    Raises:
        DataError: the file is unusable.
    """
    from econgs_bench.datasets.readers.single import Single

    path = Path(path)
    try:
        source = _source(path, _kind(path))
        return () if isinstance(source, Single) and source.plain else source.variables
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
    limits: Limits | None = None,
) -> Volume:
    """Read one scalar field on a regular grid; memory-mapped where the format allows.

    Args:
        path: the file. ``.raw`` needs dims and type in its name or in a sidecar (see ``raw``).
        variable: name of the result; default: its name in the file, else "value".
        array: name in the file, for files of named variables; default: ``variable``. A vector gives its
            magnitude; its components are ``name.x``, ``name.y``, ``name.z``.
        step: time step, from 0; default: the first.
        resolution: samples along the longest side, for meshes only (default 128).
        spacing: sample distances along x, y, z; default: those of the file, else 1, with a line in the log.
        limits: the value range and the missing values; default: those of the file, else a range without
            outliers (:mod:`.datasets.readers.limits`).

    Returns:
        The volume; ``value_range`` is the minimum and maximum of its valid values (of a mesh, that at its
        points), or the range of ``limits``.

    Raises:
        UnknownName: the file has no such variable; the remedy lists near matches.
        DataError: the file is missing, unreadable, a folder, truncated, of another size than its header
            promises, not three-dimensional, of unknown type, not finite, or constant; or it has no such time
            step, or is a grid, which takes no resolution.
    """
    path = Path(path)

    from econgs_bench.datasets.readers.fields import choose, plain
    from econgs_bench.datasets.readers.finish import UNIT, check_spacing
    from econgs_bench.datasets.readers.notices import notice
    from econgs_bench.datasets.readers.single import Single
    from econgs_bench.datasets.volume import Volume

    try:
        source = _source(path, _kind(path))
        if isinstance(source, Single):
            limits = source.limits.with_choice(limits)
            if source.plain and array not in (None, "value"):
                raise DataError(
                    path, "its format holds one field: it has no choice of variable", "Leave it out"
                )
        else:
            array = array or variable
        choice = choose(path, source.variables, array, step, resolution, limits)
        if spacing is not None:
            check_spacing(spacing, path)
        field = source.read(choice)
        if (spacing or field.spacing) is None:
            notice(f"{path}: says no sample distances: 1:1:1 is assumed; `spacing` sets them")
        size = check_spacing(spacing or field.spacing or UNIT, path)
        return Volume(
            variable or plain(choice.name), field.values, size, field.value_range, str(path), field.mask,
            field.vertices, field.vertex_values, field.whole,
        )  # fmt: skip
    except MemoryError as error:
        raise DataError(path, "does not fit into memory", "Subsample it, or use a larger machine") from error
    except OSError as error:
        raise DataError(path, f"cannot be read ({error})", "Check the file and its permissions") from error


def _kind(path: Path) -> str:
    """The reader of a file or folder."""
    if path.is_dir():
        kind = folder_kind(path)
        if not kind:
            reason = "is a folder, and holds no volume: no slices (.tif, .png), DICOM files or Zarr store"
            raise DataError(path, reason, "Name a file in it")
        return kind
    _check_file(path)
    suffix = suffix_of(path)
    if _FORMATS.get(suffix) != "raw":  # which may begin with any bytes
        found = content.suffix_by_content(path)
        # Several formats are kept in HDF5, NetCDF or XML: there the name tells which.
        suffix = suffix if found in _KEPT_IN.get(suffix, ()) else found or suffix
    if not suffix:
        reason = f"unknown volume format {path.suffix!r}" if path.suffix else "unknown volume format"
        remedy = (
            "Convert it with ParaView (.vti) or 3D Slicer (.nrrd), or name raw values NAME_64x64x32_uint8.raw"
        )
        raise DataError(path, reason, remedy)
    return _FORMATS[suffix]


def _source(path: Path, kind: str) -> Source:
    if kind in _SINGLE.values():
        return _single(path, kind)
    if kind == "vtk_legacy":
        from econgs_bench.datasets.readers.vtk_legacy import LeftToVtk, LegacyFile

        with suppress(LeftToVtk):
            return LegacyFile(path)
        kind = "vtk_data"
    from econgs_bench.datasets.readers.sandbox import Foreign, Stored

    if kind in ("vtk_data", "itk", "slices"):
        return Foreign(path, kind)
    from econgs_bench.datasets.readers.arrays import Arrays

    if kind == "npz":
        from econgs_bench.datasets.readers.npz import Npz

        return Arrays(path, Npz(path), missing=False)
    if kind == "zarr":
        return Arrays(path, Stored(path, "zarr_store"), missing=True)
    container = _netcdf(path)
    names = set(container.arrays)
    if kind == "exodus" or {"connect1", "eb_prop1"} <= names:
        from econgs_bench.datasets.readers.exodus import Exodus

        return Exodus(path, container)
    if any(name.startswith("VTKHDF/") for name in names):
        return Foreign(path, "vtk_data")
    if {"image", "image-max"} <= names or any(name.startswith("minc-2.0/") for name in names):
        return Foreign(path, "minc")
    return Arrays(path, container, missing=True, netcdf=kind == "netcdf")


def _single(path: Path, kind: str) -> Single:
    from econgs_bench.datasets.readers.nifti import open_nifti
    from econgs_bench.datasets.readers.npy import open_npy
    from econgs_bench.datasets.readers.nrrd import open_nrrd
    from econgs_bench.datasets.readers.raw import open_raw

    return {"raw": open_raw, "npy": open_npy, "nrrd": open_nrrd, "nifti": open_nifti}[kind](path)


def _netcdf(path: Path) -> Container:
    """Classic NetCDF, or NetCDF-4, which is HDF5."""
    with path.open("rb") as file:
        classic = file.read(3) == b"CDF"
    if classic:
        from econgs_bench.datasets.readers.netcdf3 import NetCdf3

        return NetCdf3(path)
    from econgs_bench.datasets.readers.sandbox import Stored

    return Stored(path, "hdf5")


def _check_file(path: Path) -> None:
    try:
        if not path.exists():
            raise DataError(path, "no such file", "Check the path (relative to the current folder)")
        if not path.is_file():
            raise DataError(path, "is not a regular file", "Copy the volume into a plain file")
        with path.open("rb") as file:
            empty = not file.read(1)
    except (OSError, ValueError) as error:
        raise DataError(path, f"cannot be read ({error})", "Check the path and its permissions") from error
    if empty and path.suffix.lower() != ".foam":  # stands for the folder that it lies in
        raise DataError(path, "is empty", "Copy or download it again")
