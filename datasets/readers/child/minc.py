"""MINC 1 (classic NetCDF) and MINC 2 (HDF5) through nibabel, which scales each slice by its own range."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.parts import Slabs
from econgs_bench.datasets.readers.content import suffix_by_content

_SLAB = 1 << 21
"""Values that are read at a time."""


def open_source(path: str) -> Minc:
    """An open file."""
    return Minc(Path(path))


class Minc:
    """The image of a file, its axes in the order of the file."""

    def __init__(self, path: Path) -> None:
        kind = nibabel.Minc2Image if suffix_by_content(path) == ".h5" else nibabel.Minc1Image
        self._image: Any = kind.from_file_map({"image": nibabel.FileHolder(str(path))})
        self._shape = tuple(int(n) for n in self._image.shape)
        if len(self._shape) != 3:
            text = " x ".join(map(str, self._shape[::-1]))
            raise DataError(path, f"is {len(self._shape)}-D MINC data ({text})", "Convert it with mnc2nii")

    def contents(self) -> dict[str, Any]:
        """Dims of its only variable."""
        return {"variables": [{"name": "value", "dims": self._shape[::-1], "steps": 1, "components": 1}]}

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Values (z, y, x), slices of the first axis at a time, and positions along the axes."""
        del read, step
        stored = self._image.get_data_dtype()
        dtype = stored.newbyteorder("=") if stored.kind == "f" else np.dtype(np.float64)
        distances = zip("zyx", self._image.header.get_zooms(), self._shape, strict=True)
        axes = {name: float(d) * np.arange(n, dtype=np.float64) for name, d, n in distances}
        return {"of_cells": False}, {"values": Slabs(self._shape, dtype, self._slices(dtype)), **axes}

    def _slices(self, dtype: np.dtype) -> Iterator[NDArray[Any]]:
        rows = max(1, _SLAB // max(self._shape[1] * self._shape[2], 1))
        for start in range(0, self._shape[0], rows):
            yield np.asarray(self._image.dataobj[start : start + rows]).astype(dtype, copy=False)
