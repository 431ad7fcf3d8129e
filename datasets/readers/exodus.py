"""Exodus II meshes (``.ex2``, ``.exo``, ``.e``): NetCDF files of nodes, element blocks and time steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.container import Container
from econgs_bench.datasets.readers.fields import Choice, Field, Variable
from econgs_bench.datasets.readers.mesh import Mesh, resampled

_REMEDY = "Copy it again, or write it again as an Exodus II file"
_ELEMENTS = {
    ("TET", 4): 10, ("TET", 10): 24, ("HEX", 8): 12, ("HEX", 20): 25, ("WED", 6): 13, ("WED", 15): 26,
    ("PYR", 5): 14, ("PYR", 13): 27,
}  # fmt: skip
"""Exodus's element type (three letters) and nodes -> VTK's cell type."""
_WEDGE15 = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 13, 14, 9, 10, 11])
_HEX20 = np.array([*range(12), 16, 17, 18, 19, 12, 13, 14, 15])
"""Order of nodes: VTK counts the mid-edge nodes of the top before the vertical ones, Exodus after them."""


class Exodus:
    """An open Exodus file; time steps are those of the file."""

    def __init__(self, path: Path, container: Container) -> None:
        self.path, self._file = path, container
        arrays = container.arrays
        if "coordx" not in arrays and "coord" not in arrays:
            raise DataError(path, "is a NetCDF file, but no Exodus mesh (it has no coordinates)", _REMEDY)
        steps = arrays["time_whole"].shape[0] if "time_whole" in arrays else 1
        if steps < 1:
            raise DataError(path, "has no time steps", "Write results with it, not the mesh alone")
        self._where: dict[str, tuple[bool, int]] = {}  # variable -> of cells, number from 1
        for of_cells, names in ((False, "name_nod_var"), (True, "name_elem_var")):
            for number, name in enumerate(self._names(names), start=1):
                if name:
                    label = f"{name}_cells" if name in self._where else name
                    self._where[label] = (of_cells, number)
        self.variables = tuple(Variable(name, None, steps) for name in self._where)
        if not self.variables:
            raise DataError(path, "holds no variables", "Write results with it, not the mesh alone")

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""
        of_cells, number = self._where[choice.variable.name]
        valid = None
        points = self._points()
        blocks = [self._block(name) for name in self._blocks()]
        if not blocks:
            raise DataError(self.path, "has no elements", _REMEDY)
        mesh = Mesh.joined([_one(points, blocks)], self.path)
        if not of_cells:
            values = self._nodal(number, choice.step)
        else:
            parts = [
                self._of_block(number, b, len(block[1]), choice.step)
                for b, block in zip(self._blocks(), blocks, strict=True)
            ]
            present = [part is not None for part in parts]
            valid = None if all(present) else np.repeat(present, [len(block[1]) for block in blocks])
            kind = np.result_type(*(part for part in parts if part is not None)) if any(present) else float
            values = np.concatenate(
                [
                    np.zeros(len(block[1]), kind) if part is None else part
                    for part, block in zip(parts, blocks, strict=True)
                ]
            )
        return resampled(mesh, values, of_cells, choice, self.path, valid)

    def _names(self, names: str) -> list[str]:
        if names not in self._file.arrays:
            return []
        array = self._file.arrays[names]
        if array.dtype.kind != "S" or len(array.shape) != 2:
            raise DataError(self.path, f"{names} is damaged", _REMEDY)
        letters = self._file.read(names)
        return [row.tobytes().split(b"\0")[0].decode("utf-8", "replace").strip() for row in letters]

    def _points(self) -> NDArray[Any]:
        arrays = self._file.arrays
        if "coord" in arrays:
            return np.ascontiguousarray(self._file.read("coord").T)
        if not {"coordx", "coordy", "coordz"} <= set(arrays):
            raise DataError(self.path, "is a two-dimensional mesh", "Surfaces cannot be shown as volumes")
        axes = [self._file.read(f"coord{axis}") for axis in "xyz"]
        if len({axis.shape for axis in axes}) != 1 or axes[0].ndim != 1:
            raise DataError(self.path, "its coordinates are damaged", _REMEDY)
        return np.stack([axis.astype(axis.dtype.newbyteorder("=")) for axis in axes], axis=-1)

    def _blocks(self) -> list[int]:
        names = [name[7:] for name in self._file.arrays if name.startswith("connect")]
        return sorted(int(name) for name in names if name.isascii() and name.isdigit())

    def _block(self, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
        """Connectivity, ends and types of the cells of an element block."""
        name = f"connect{number}"
        array = self._file.arrays[name]
        kind = str(array.attributes.get("elem_type", "")).strip("\0 ").upper()
        if array.dtype.kind not in "iu" or len(array.shape) != 2:
            raise DataError(self.path, f"{name} is damaged", _REMEDY)
        cells, nodes = array.shape
        kind = {"BRI": "HEX"}.get(kind[:3], kind[:3])
        flat = kind in ("SHE", "TRI", "QUA", "BAR", "BEA", "TRU", "SPH", "CIR", "EDG")
        if not flat and (kind, nodes) not in _ELEMENTS:
            remedy = f"Readable are {', '.join(f'{k} of {n} nodes' for k, n in _ELEMENTS)}"
            raise DataError(self.path, f"has elements {kind or 'without type'} of {nodes} nodes", remedy)
        points = self._file.read(name).astype(np.int64) - 1
        if (kind, nodes) == ("HEX", 20):
            points = points[:, _HEX20]
        elif (kind, nodes) == ("WED", 15):
            points = points[:, _WEDGE15]
        ends = nodes * np.arange(1, cells + 1, dtype=np.int64)
        types = np.full(cells, 2 if flat else _ELEMENTS[kind, nodes], np.uint8)
        return points.reshape(-1), ends, types

    def _nodal(self, number: int, step: int) -> NDArray[Any]:
        arrays = self._file.arrays
        name = f"vals_nod_var{number}"
        if name in arrays and len(arrays[name].shape) == 2:
            return self._file.read(name, step)
        if "vals_nod_var" in arrays and len(arrays["vals_nod_var"].shape) == 3:
            values = self._file.read("vals_nod_var", step)
            if number <= len(values):
                return np.asarray(values[number - 1])
        raise DataError(self.path, f"has no values of its variable {number}", _REMEDY)

    def _of_block(self, number: int, block: int, cells: int, step: int) -> NDArray[Any] | None:
        """Values of the cells of a block; None where the variable has none (Exodus's truth table)."""
        name = f"vals_elem_var{number}eb{block}"
        if name not in self._file.arrays:
            return None
        if len(self._file.arrays[name].shape) != 2:
            raise DataError(self.path, f"{name} is damaged", _REMEDY)
        values = self._file.read(name, step)
        if len(values) != cells:
            raise DataError(self.path, f"{name} is damaged", _REMEDY)
        return values


def _one(points: NDArray[Any], blocks: list[Any]) -> Mesh:
    """All blocks as one mesh over the same points."""
    starts = np.cumsum([0, *(len(block[0]) for block in blocks)])
    return Mesh(
        points,
        np.concatenate([block[0] for block in blocks]),
        np.concatenate([block[1] + s for block, s in zip(blocks, starts, strict=False)]),
        np.concatenate([block[2] for block in blocks]),
    )
