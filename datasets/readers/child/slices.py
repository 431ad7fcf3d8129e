"""Pictures: TIFF files of one or many pages through tifffile, and folders of TIFF or PNG slices."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.readers.child.parts import Slabs

PICTURES = (".tif", ".tiff", ".png")


def open_source(path: str) -> Stack | Folder:
    """A file, or the slices of a folder."""
    return Folder(Path(path)) if Path(path).is_dir() else Stack(Path(path))


class Stack:
    """A TIFF file: its first series of pages."""

    def __init__(self, path: Path) -> None:
        import tifffile

        self._path = path
        self._file = tifffile.TiffFile(path)
        series = self._file.series[0]
        axes = [(letter, n) for letter, n in zip(series.axes, series.shape, strict=True) if n > 1]
        self._letters = "".join(letter for letter, _ in axes)
        self._shape = tuple(n for _, n in axes)
        _check_pages(path, self._file)
        # Three axes are z, y, x whatever their letters; of more, T is time and S or C are components.
        self._order = _order(self._letters, self._shape, path)

    def contents(self) -> dict[str, Any]:
        """Dims, steps and components of its only variable."""
        steps, *dims, components = self._sizes()
        variable = {"name": "value", "dims": dims[::-1], "steps": steps, "components": components}
        return {"variables": [variable]}

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Values (z, y, x) or (z, y, x, components), and positions where the file has distances."""
        del read
        values = self._file.series[0].asarray().reshape(self._shape)
        values = values.transpose([at for at in self._order if at >= 0]).reshape(self._sizes())[step]
        if values.shape[-1] == 1:
            values = values[..., 0]
        return {"of_cells": False}, {"values": values, **self._positions(values.shape)}

    def _sizes(self) -> list[int]:
        return [self._shape[at] if at >= 0 else 1 for at in self._order]

    def _positions(self, shape: tuple[int, ...]) -> dict[str, NDArray[Any]]:
        """ImageJ's and OME's distances."""
        x = y = z = None
        if self._file.is_imagej and self._file.imagej_metadata:
            z = self._file.imagej_metadata.get("spacing")
            tags = self._file.pages.first.tags
            x, y = (_distance(tags.get(f"{axis}Resolution")) for axis in "XY")
        elif self._file.is_ome and self._file.ome_metadata:
            found = dict(re.findall(r'PhysicalSize([XYZ])="([^"]+)"', self._file.ome_metadata))
            x, y, z = (float(found[axis]) if axis in found else None for axis in "XYZ")
        if not (x and y and z):
            return {}
        distances = zip("zyx", (z, y, x), shape, strict=False)
        return {name: distance * np.arange(n, dtype=np.float64) for name, distance, n in distances}


def _check_pages(path: Path, file: Any) -> None:
    """Refuse pages whose data lie beyond the end of the file."""
    size = path.stat().st_size
    for number, page in enumerate(file.pages):
        ends = [a + n for a, n in zip(page.dataoffsets, page.databytecounts, strict=True)]
        if max(ends, default=0) > size:
            raise DataError(path, f"is truncated: page {number} ends beyond its end", "Copy it again")


def _distance(tag: Any) -> float | None:
    """Sample distance of a resolution in samples per unit."""
    if tag is None or not isinstance(tag.value, tuple) or not tag.value[0]:
        return None
    return float(tag.value[1]) / float(tag.value[0])


def _order(letters: str, shape: tuple[int, ...], path: Path) -> list[int]:
    """Places of time, z, y, x and components among the axes; -1 for one that is absent."""
    axes = list(range(len(letters)))
    components = [at for at in axes if letters[at] in "SC" and len(axes) > 3]
    time = [at for at in axes if letters[at] == "T" and len(axes) > 3]
    rest = [at for at in axes if at not in components + time]
    if len(components) > 1 or len(time) > 1 or len(rest) != 3:
        sizes = " x ".join(f"{n} ({letter})" for letter, n in zip(letters, shape, strict=True))
        raise DataError(path, f"has the axes {sizes}", "Write one stack of pages: z, y, x")
    return [*(time or [-1]), *rest, *(components or [-1])]


class Folder:
    """The pictures of a folder as slices, in the order of the numbers in their names."""

    def __init__(self, path: Path) -> None:
        self._path = path
        pictures = [f for f in sorted(path.iterdir()) if f.suffix.lower() in PICTURES]
        kinds = {f.suffix.lower()[:4] for f in pictures}
        if len(kinds) != 1:
            raise DataError(
                path, f"mixes {' and '.join(sorted(kinds))}", "Keep the slices in their own folder"
            )
        numbers = {}
        for file in pictures:
            digits = re.findall(r"[0-9]+", file.stem)
            if not digits:
                raise DataError(
                    file, "its name has no number", "Number the slices: slice000.tif, slice001.tif"
                )
            numbers[file] = int(digits[-1])
        self._files = sorted(pictures, key=lambda file: numbers[file])
        _check_numbers(path, [numbers[file] for file in self._files])
        first = _picture(self._files[0])
        self._shape, self._dtype = (len(self._files), *first.shape), first.dtype

    def contents(self) -> dict[str, Any]:
        """Dims and components of its only variable."""
        z, y, x, *components = self._shape
        variable = {"name": "value", "dims": [x, y, z], "steps": 1, "components": (*components, 1)[0]}
        return {"variables": [variable]}

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, Slabs]]:
        """Values (z, y, x) or (z, y, x, components), slice by slice."""
        del read, step
        return {"of_cells": False}, {"values": Slabs(self._shape, self._dtype, self._slices())}

    def _slices(self) -> Any:
        for file in self._files:
            values = _picture(file)
            if values.shape != self._shape[1:] or values.dtype != self._dtype:
                raise DataError(file, "differs in size or type from the first slice", "Copy it again")
            yield values


def _check_numbers(path: Path, numbers: list[int]) -> None:
    steps = set(np.diff(numbers).tolist())
    if 0 in steps:
        raise DataError(path, "two slices have the same number", "Keep one stack in each folder")
    if len(steps) > 1:
        step = min(steps)
        after = next(a for a, b in pairwise(numbers) if b - a != step)
        raise DataError(path, f"a slice is missing after number {after}", "Copy all slices, or renumber them")


def _picture(file: Path) -> NDArray[Any]:
    """(y, x), or (y, x, components)."""
    if file.suffix.lower() == ".png":
        from PIL import Image

        with Image.open(file, formats=["PNG"]) as image:
            if image.mode == "P":
                raise DataError(file, "has a palette", "Write it in gray, 8 or 16 bits")
            values = np.asarray(image.convert("RGB") if image.mode == "RGBA" else image)
            return values.astype(np.uint16) if image.mode.startswith("I") else values
    import tifffile

    with tifffile.TiffFile(file) as tiff:
        _check_pages(file, tiff)
        return np.asarray(tiff.series[0].asarray().squeeze())
