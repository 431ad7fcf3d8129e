"""Grids and meshes written by VTK itself, for the tests of the readers."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import vtk
from vtk.util.numpy_support import numpy_to_vtk


def attach(data: Any, arrays: dict[str, np.ndarray]) -> None:
    """Arrays (tuples,) or (tuples, components) as point or cell data."""
    for name, values in arrays.items():
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=1)
        array.SetName(name)
        data.AddArray(array)


def image(
    points: dict[str, np.ndarray],
    cells: dict[str, np.ndarray],
    dims: tuple[int, int, int],
    spacing=(1.0, 1.0, 1.0),
) -> vtk.vtkImageData:
    grid = vtk.vtkImageData()
    grid.SetDimensions(*dims)
    grid.SetSpacing(*spacing)
    grid.SetOrigin(3.0, -2.0, 7.0)
    attach(grid.GetPointData(), points)
    attach(grid.GetCellData(), cells)
    return grid


def rectilinear(
    points: dict[str, np.ndarray], cells: dict[str, np.ndarray], axes: list[np.ndarray]
) -> vtk.vtkRectilinearGrid:
    grid = vtk.vtkRectilinearGrid()
    grid.SetDimensions(*(len(axis) for axis in axes))
    grid.SetXCoordinates(numpy_to_vtk(axes[0], deep=1))
    grid.SetYCoordinates(numpy_to_vtk(axes[1], deep=1))
    grid.SetZCoordinates(numpy_to_vtk(axes[2], deep=1))
    attach(grid.GetPointData(), points)
    attach(grid.GetCellData(), cells)
    return grid


def mesh(
    positions: np.ndarray, cells: list[tuple[int, list[int]]], points: dict[str, np.ndarray],
    of_cells: dict[str, np.ndarray],
) -> vtk.vtkUnstructuredGrid:  # fmt: skip
    nodes = vtk.vtkPoints()
    nodes.SetData(numpy_to_vtk(np.ascontiguousarray(positions), deep=1))
    grid = vtk.vtkUnstructuredGrid()
    grid.SetPoints(nodes)
    for kind, ids in cells:
        grid.InsertNextCell(kind, len(ids), ids)
    attach(grid.GetPointData(), points)
    attach(grid.GetCellData(), of_cells)
    return grid


TETRAHEDRA = ((0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7))
"""Corners of the tetrahedra of a cube whose corner z y x has the number 4 z + 2 y + x."""


def tetrahedra(n: int = 4, seed: int = 0) -> tuple[np.ndarray, list[tuple[int, list[int]]]]:
    """A box of n^3 points, inner ones displaced, cut into tetrahedra: positions and cells."""
    axis = np.linspace(0.0, 1.0, n)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    positions = np.stack([2.0 * x, y, 0.5 * z], axis=-1).reshape(-1, 3)
    inner = ((positions > 1e-6) & (positions < np.array([2.0, 1.0, 0.5]) - 1e-6)).all(axis=1)
    positions[inner] += np.random.default_rng(seed).uniform(-0.02, 0.02, (int(inner.sum()), 3))
    steps = np.array([1, n, n * n])
    cells = []
    for corner in product(range(n - 1), repeat=3):  # z, y, x
        around = [int(steps @ np.add(corner, offset)[::-1]) for offset in product((0, 1), repeat=3)]
        cells += [(10, [around[at] for at in tetrahedron]) for tetrahedron in TETRAHEDRA]
    return positions, cells


XML_MODES = {"ascii": 0, "binary": 1, "appended": 2, "raw": 2}
COMPRESSORS = ("none", "zlib", "lz4", "lzma")


def write_xml(
    path: Path, data: Any, mode: str = "appended", compressor: str = "zlib", wide: bool = True
) -> None:
    """By VTK's XML writer for the suffix."""
    writer = {
        ".vti": vtk.vtkXMLImageDataWriter,
        ".vtr": vtk.vtkXMLRectilinearGridWriter,
        ".vtu": vtk.vtkXMLUnstructuredGridWriter,
    }[path.suffix]()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.SetDataMode(XML_MODES[mode])
    if mode != "ascii":
        writer.SetEncodeAppendedData(mode == "appended")
        writer.SetCompressorType({"none": 0, "zlib": 1, "lz4": 2, "lzma": 3}[compressor])
        writer.SetBlockSize(1 << 10)
        writer.SetHeaderType(64 if wide else 32)
    assert writer.Write() == 1


def write_legacy(path: Path, data: Any, binary: bool, version: int = 51) -> None:
    writer = vtk.vtkDataSetWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    writer.SetFileVersion(version)
    if binary:
        writer.SetFileTypeToBinary()
    assert writer.Write() == 1


def write_exodus(
    path: Path, positions: np.ndarray, blocks: list[tuple[str, np.ndarray]], nodal: dict[str, np.ndarray],
    of_cells: dict[str, list[np.ndarray]], file_format: str = "NETCDF3_64BIT_OFFSET",
) -> None:  # fmt: skip
    """Exodus II by its specification, through netCDF4.

    Args:
        blocks: element type and connectivity (cells, nodes) from 0.
        nodal: name -> (steps, points).
        of_cells: name -> for each block (steps, cells).
    """
    import netCDF4

    steps = len(next(iter(nodal.values())))
    with netCDF4.Dataset(path, "w", format=file_format) as file:
        file.api_version = file.version = np.float32(4.98)
        file.floating_point_word_size, file.title = np.int32(8), "test"
        sizes = {"len_string": 33, "len_name": 33, "four": 4, "time_step": None, "num_dim": 3}
        sizes |= {"num_nodes": len(positions), "num_elem": sum(len(c) for _, c in blocks)}
        sizes |= {"num_el_blk": len(blocks), "num_nod_var": len(nodal)}
        sizes |= {"num_elem_var": len(of_cells)} if of_cells else {}
        for b, (_, connectivity) in enumerate(blocks, start=1):
            sizes |= {f"num_el_in_blk{b}": len(connectivity), f"num_nod_per_el{b}": connectivity.shape[1]}
        for name, size in sizes.items():
            file.createDimension(name, size)
        times = file.createVariable("time_whole", "f8", ("time_step",))
        file.createVariable("eb_status", "i4", ("num_el_blk",))[:] = 1
        file.createVariable("eb_prop1", "i4", ("num_el_blk",))[:] = np.arange(1, len(blocks) + 1)
        file.variables["eb_prop1"].setncattr("name", "ID")
        for axis, name in enumerate("xyz"):
            file.createVariable(f"coord{name}", "f8", ("num_nodes",))[:] = positions[:, axis]
        for b, (kind, connectivity) in enumerate(blocks, start=1):
            stored = file.createVariable(f"connect{b}", "i4", (f"num_el_in_blk{b}", f"num_nod_per_el{b}"))
            stored[:] = connectivity + 1
            stored.elem_type = kind
        names = file.createVariable("name_nod_var", "S1", ("num_nod_var", "len_name"))
        for number, (name, values) in enumerate(nodal.items(), start=1):
            names[number - 1] = np.frombuffer(name.encode().ljust(33, b"\0"), "S1")
            file.createVariable(f"vals_nod_var{number}", "f8", ("time_step", "num_nodes"))[:] = values
        if of_cells:
            names = file.createVariable("name_elem_var", "S1", ("num_elem_var", "len_name"))
        for number, (name, parts) in enumerate(of_cells.items(), start=1):
            names[number - 1] = np.frombuffer(name.encode().ljust(33, b"\0"), "S1")
            for b, values in enumerate(parts, start=1):
                dims = ("time_step", f"num_el_in_blk{b}")
                file.createVariable(f"vals_elem_var{number}eb{b}", "f8", dims)[:] = values
        times[:] = np.arange(steps)
