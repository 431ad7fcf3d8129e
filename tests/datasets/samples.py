"""A small file of every format, of one field that differs along every axis.

The field is x + 10 y + 100 z in positions, on 6 x 5 x 4 samples at distances 1, 2, 1/2. Writers are VTK,
SimpleITK, tifffile, Pillow, zarr, xarray, h5py, netCDF4, nibabel and pynrrd; SLC, PLOT3D and OpenFOAM are
written here by their specifications.
"""

from __future__ import annotations

import locale
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import nibabel
import nrrd
import numpy as np
import SimpleITK as sitk
import tifffile
import vtk
import xarray
from PIL import Image
from vtk.util.numpy_support import numpy_to_vtk

from tests.datasets.vtk_files import attach, image, rectilinear, write_exodus, write_legacy

DIMS, SPACING = (6, 5, 4), (1.0, 2.0, 0.5)
AXES = [spacing * np.arange(n) for spacing, n in zip(SPACING, DIMS, strict=True)]


def linear(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(nz, ny, nx) values at positions along the axes."""
    return x + 10.0 * y[:, None] + 100.0 * z[:, None, None]


FIELD = linear(*AXES)
_Z, _Y, _X = np.meshgrid(*AXES[::-1], indexing="ij")
POSITIONS = np.stack([_X, _Y, _Z], axis=-1)


def _image() -> vtk.vtkImageData:
    return image({"f": FIELD.reshape(-1)}, {}, DIMS, SPACING)


def _rectilinear() -> vtk.vtkRectilinearGrid:
    return rectilinear({"f": FIELD.reshape(-1)}, {}, AXES)


def _structured() -> vtk.vtkStructuredGrid:
    grid = vtk.vtkStructuredGrid()
    grid.SetDimensions(*DIMS)
    points = vtk.vtkPoints()
    points.SetData(numpy_to_vtk(POSITIONS.reshape(-1, 3), deep=1))
    grid.SetPoints(points)
    attach(grid.GetPointData(), {"f": FIELD.reshape(-1)})
    return grid


def _mesh() -> vtk.vtkUnstructuredGrid:
    cells = vtk.vtkAppendFilter()
    cells.AddInputData(_structured())
    cells.Update()
    return cells.GetOutput()


_DATA = {"i": _image, "r": _rectilinear, "s": _structured, "u": _mesh}
_NAMES = {"i": "ImageData", "r": "RectilinearGrid", "s": "StructuredGrid", "u": "UnstructuredGrid"}


def _xml(path: Path) -> None:
    """By VTK's XML writer; ``.pvt?`` in two pieces."""
    parallel, letter = path.suffix.startswith(".p"), path.suffix[-1]
    writer = getattr(vtk, f"vtkXML{'P' if parallel else ''}{_NAMES[letter]}Writer")()
    writer.SetFileName(str(path))
    writer.SetInputData(_DATA[letter]())
    if parallel:
        writer.SetNumberOfPieces(2)
        writer.SetStartPiece(0)
        writer.SetEndPiece(1)
    if "raw" in path.stem:
        writer.SetEncodeAppendedData(False)
        writer.SetCompressorTypeToNone()
    if "text" in path.stem:
        writer.SetDataModeToAscii()
    assert writer.Write() == 1


def _vtkhdf(path: Path) -> None:
    writer = vtk.vtkHDFWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(_mesh() if "mesh" in path.stem else _image())
    assert writer.Write() == 1


def _xdmf(path: Path) -> None:
    writer = vtk.vtkXdmfWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(_mesh() if "mesh" in path.stem else _image())
    writer.SetLightDataLimit(0)  # all values into the HDF5 file
    assert writer.Write() == 1


def _ensight(path: Path) -> None:
    writer = vtk.vtkEnSightWriter()
    grid = _mesh()
    attach(grid.GetCellData(), {"BlockId": np.ones(grid.GetNumberOfCells(), np.int32)})
    writer.SetInputData(grid)
    writer.SetPath(str(path.parent))
    writer.SetBaseName("v")
    writer.Write()
    writer.WriteCaseFile(1)
    (path.parent / "v.0.case").rename(path)


def _plot3d(path: Path) -> None:
    """Binary, one grid, single precision."""
    head = np.array(DIMS, "<i4").tobytes()
    path.with_suffix(".xyz").write_bytes(head + np.moveaxis(POSITIONS, -1, 0).astype("<f4").tobytes())
    rest = np.ones((3, *FIELD.shape), "<f4")
    values = np.concatenate([FIELD[None], rest, rest[:1]]).astype("<f4")
    path.with_suffix(".q").write_bytes(head + np.array([0.5, 0, 1e5, 0], "<f4").tobytes() + values.tobytes())


def _slc(path: Path) -> None:
    """8 bits, run-length encoded if so named."""
    packed = "packed" in path.stem
    head = f"11111\n6 5 4 8\n1 2 0.5\n0 0 0 {int(packed)}\n1 1 X"
    data = head.encode() + bytes(3)
    for plane in FIELD.astype(np.uint8):
        raw = plane.tobytes()
        if packed:  # literal runs of ten, runs of one repeated value, and the end
            raw = b"".join(bytes([0x80 | 10]) + raw[at : at + 10] for at in range(0, 30, 10)) + b"\0"
            raw = f"{len(raw)} X".encode() + raw
        data += raw
    path.write_bytes(data)


def _foam(path: Path) -> None:
    """A case of 5 x 4 x 3 hexahedra with the values of its cells' centres, in ASCII."""
    nx, ny, nz = (n - 1 for n in DIMS)
    point = lambda i, j, k: i + DIMS[0] * (j + DIMS[1] * k)  # noqa: E731
    cell = lambda i, j, k: i + nx * (j + ny * k)  # noqa: E731
    inner, outer = [], []
    for k, j, i in np.ndindex(nz, ny, nx):
        a, b = point(i, j, k), point(i + 1, j, k)
        c, d = point(i + 1, j + 1, k), point(i, j + 1, k)
        up = DIMS[0] * DIMS[1]
        own = cell(i, j, k)
        ahead = [(i + 1 < nx, (b, c, c + up, b + up), 1), (j + 1 < ny, (d, d + up, c + up, c), nx)]
        ahead.append((k + 1 < nz, (a + up, b + up, c + up, d + up), nx * ny))
        for inside, face, step in ahead:
            (inner if inside else outer).append((face, own, own + step))
        behind = [(i == 0, (a, a + up, d + up, d)), (j == 0, (a, b, b + up, a + up)), (k == 0, (a, d, c, b))]
        outer += [(face, own, -1) for first, face in behind if first]
    inner.sort(key=lambda face: face[1:])
    faces = inner + outer

    def write(where: str, kind: str, name: str, text: str) -> None:
        file = path.parent / where / name
        file.parent.mkdir(parents=True, exist_ok=True)
        head = f'version 2.0;format ascii;class {kind};location "{where}";object {name};'
        file.write_text(f"FoamFile\n{{{head.replace(';', ';' + chr(10))}}}\n\n{text}\n")

    def entries(items: list[str]) -> str:
        return f"{len(items)}\n(\n" + "\n".join(items) + "\n)"

    write("system", "dictionary", "controlDict", "application icoFoam;\nstartTime 0;\nendTime 1;\n")
    mesh = "constant/polyMesh"
    points = ["({} {} {})".format(*p) for p in POSITIONS.reshape(-1, 3)]
    write(mesh, "vectorField", "points", entries(points))
    write(mesh, "faceList", "faces", entries([f"4({' '.join(map(str, f))})" for f, _, _ in faces]))
    write(mesh, "labelList", "owner", entries([str(own) for _, own, _ in faces]))
    write(mesh, "labelList", "neighbour", entries([str(other) for _, _, other in inner]))
    walls = f"1\n(\nwalls\n{{\ntype wall;\nnFaces {len(outer)};\nstartFace {len(inner)};\n}}\n)"
    write(mesh, "polyBoundaryMesh", "boundary", walls)
    centres = [0.5 * (axis[1:] + axis[:-1]) for axis in AXES]
    values = [repr(float(v)) for v in linear(*centres).reshape(-1)]
    border = "boundaryField\n{\nwalls\n{\ntype zeroGradient;\n}\n}"
    field = f"internalField nonuniform List<scalar>\n{entries(values)};\n{border}"
    write("1", "volScalarField", "f", f"dimensions [0 0 0 0 0 0 0];\n{field}")
    path.touch()


def _itk(path: Path) -> None:
    picture = sitk.GetImageFromArray(FIELD.astype(np.int16))
    picture.SetSpacing(SPACING)
    picture.SetOrigin((3.0, 4.0, 5.0))
    sitk.WriteImage(picture, str(path), useCompression="packed" in path.stem)


def _dicom(path: Path) -> None:
    """A series of slices, the names in another order than the positions."""
    path.mkdir()
    before = locale.setlocale(locale.LC_CTYPE)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k, plane in enumerate(FIELD.astype(np.int16)):
        picture = sitk.GetImageFromArray(plane[None])
        picture.SetSpacing(SPACING)
        tags = {"0008|0060": "CT", "0020|000e": "1.2.3.4", "0020|000d": "1.2.3", "0020|0013": str(k)}
        tags |= {"0020|0032": f"0\\0\\{0.5 * k}", "0020|0037": "1\\0\\0\\0\\1\\0", "0018|0050": "0.5"}
        tags |= {"0008|0018": f"1.2.3.4.{k}", "0008|0016": "1.2.840.10008.5.1.4.1.1.2"}
        for key, value in tags.items():
            picture.SetMetaData(key, value)
        picture.SetOrigin((0.0, 0.0, 0.5 * k))
        writer.SetFileName(str(path / f"image{9 - k}.dcm"))
        writer.Execute(picture)
    locale.setlocale(locale.LC_CTYPE, before)  # GDCM sets that of the whole process to C


def _tiff(path: Path) -> None:
    values = FIELD.astype(np.uint16)
    if path.suffix:
        metadata: dict[str, Any] = {"spacing": 0.5, "axes": "ZYX"}
        compression = "lzw" if "packed" in path.stem else None
        tifffile.imwrite(
            path, values, imagej=True, resolution=(1.0, 0.5), metadata=metadata, compression=compression
        )
        return
    path.mkdir()
    for k, plane in enumerate(values):
        tifffile.imwrite(path / f"slice{k + 8}.tif", plane, compression="zlib" if k % 2 else None)


def _png(path: Path) -> None:
    path.mkdir()
    for k, plane in enumerate(FIELD.astype(np.uint16)):
        Image.fromarray(plane).save(path / f"slice{k + 8}.png")


def _dataset() -> xarray.Dataset:
    positions = dict(zip("xyz", AXES, strict=True))
    return xarray.Dataset({"f": (("z", "y", "x"), FIELD.astype("f4"))}, positions)


def _zarr(path: Path) -> None:
    folder = path.with_suffix("") if path.suffix == ".zip" else path
    _dataset().to_zarr(
        folder,
        zarr_format=2 if "2" in path.stem else 3,
        consolidated=False,
        encoding={"f": {"chunks": (2, 3, 3)}},
    )
    if path.suffix == ".zip":
        shutil.make_archive(str(folder), "zip", folder)
        shutil.rmtree(folder)


MINC = {"zspace": 0.5, "yspace": 2.0, "xspace": 1.0}
MINC_MAXIMUM = np.array([250.0, 500.0, 1000.0, 250.0])
"""What the largest valid number, 1000, stands for in each slice of a MINC file."""


def _minc(path: Path) -> None:
    raw = (FIELD * 1000.0 / MINC_MAXIMUM[:, None, None]).astype("i2")
    ranges = {"image-max": MINC_MAXIMUM, "image-min": np.zeros(len(raw))}
    if "1" in path.stem:
        with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
            for (name, step), n in zip(MINC.items(), raw.shape, strict=True):
                file.createDimension(name, n)
                file.createVariable(name, "i4").setncatts({"spacing": "regular__", "step": step})
            picture = file.createVariable("image", "i2", tuple(MINC))
            picture.setncatts({"signtype": "signed__", "valid_range": [0.0, 1000.0]})
            picture[:] = raw
            for name, values in ranges.items():
                file.createVariable(name, "f8", ("zspace",))[:] = values
        return
    with h5py.File(path, "w") as file:
        for name, step in MINC.items():
            axis = file.create_dataset(f"minc-2.0/dimensions/{name}", data=0)
            axis.attrs.update({"spacing": np.bytes_("regular__"), "step": step})
        group = file.create_group("minc-2.0/image/0")
        group.create_dataset("image", data=raw, chunks=(2, 5, 6), compression="gzip")
        about = {"dimorder": np.bytes_(",".join(MINC)), "valid_range": [0.0, 1000.0]}
        group["image"].attrs.update(about)
        for name, values in ranges.items():
            group[name] = values
            group[name].attrs["dimorder"] = np.bytes_("zspace")


def _netcdf(path: Path) -> None:
    engine, kind = ("h5netcdf", "NETCDF4") if "4" in path.stem else ("scipy", "NETCDF3_64BIT")
    _dataset().to_netcdf(path, engine=engine, format=kind)


def _hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("f", data=FIELD, chunks=(2, 3, 3), compression="gzip")
        for name, axis in zip("xyz", AXES, strict=True):
            file[name] = axis


def _exodus(path: Path) -> None:
    hexes = vtk_cells()
    write_exodus(path, POSITIONS.reshape(-1, 3), [("HEX8", hexes)], {"f": FIELD.reshape(1, -1)}, {})


def vtk_cells() -> np.ndarray:
    """(60, 8) points of the hexahedra."""
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(_mesh().GetCells().GetConnectivityArray()).reshape(-1, 8)


def _nifti(path: Path) -> None:
    values = FIELD.astype(np.float32).transpose(2, 1, 0)
    nibabel.save(nibabel.Nifti1Image(values, np.diag([*SPACING, 1.0])), path)


def _nrrd(path: Path) -> None:
    header = {"spacings": SPACING, "encoding": "raw" if "raw" in path.stem else "gzip"}
    nrrd.write(str(path), FIELD.astype(np.float32).transpose(2, 1, 0), header)


FORMATS: dict[str, Callable[[Path], None]] = {
    "v.vti": _xml, "raw.vti": _xml, "text.vti": _xml, "v.vtr": _xml, "v.vts": _xml, "v.vtu": _xml,
    "v.pvti": _xml, "v.pvtr": _xml, "v.pvts": _xml, "v.pvtu": _xml,
    "v.vtkhdf": _vtkhdf, "mesh.vtkhdf": _vtkhdf, "v.hdf": _vtkhdf,
    "v.xdmf": _xdmf, "mesh.xmf": _xdmf,
    "v.case": _ensight, "v.xyz": _plot3d, "v.q": _plot3d, "v.slc": _slc, "packed.slc": _slc,
    "case/v.foam": _foam,
    "v.mha": _itk, "packed.mha": _itk, "v.mhd": _itk, "dicom": _dicom,
    "v.tif": _tiff, "packed.tiff": _tiff, "tiff": _tiff, "png": _png,
    "v2.zarr": _zarr, "v3.zarr": _zarr, "v2.zarr.zip": _zarr, "v3.zarr.zip": _zarr,
    "v1.mnc": _minc, "v2.mnc": _minc, "v4.nc": _netcdf, "v3.nc": _netcdf, "v.h5": _hdf5,
    "v.vtk": lambda path: write_legacy(path, _image(), binary=True), "v.ex2": _exodus,
    "v.nii": _nifti, "v.nii.gz": _nifti, "raw.nrrd": _nrrd, "v.nrrd": _nrrd,
}  # fmt: skip
"""File or folder -> its writer."""

CELLS = frozenset({"case/v.foam"})
"""Formats whose values belong to cells: averaged to the points, which bends the field at the border."""
UNIT = frozenset({"tiff", "png"})
"""Formats without distances."""
BYTES = frozenset({"v.slc", "packed.slc"})
"""Formats of eight bits: the field modulo 256."""


def write(folder: Path, name: str) -> Path:
    """Write the sample of a format."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    FORMATS[name](path)
    return path


if __name__ == "__main__":
    if len(sys.argv) == 3:
        write(Path(sys.argv[2]), sys.argv[1])
    else:
        print(*FORMATS)
