"""Pictures: TIFF files of one or many pages through tifffile, and folders of TIFF or PNG slices."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child.parts import Slabs
from econgs_bench.datasets.readers.content import visible
from econgs_bench.datasets.readers.fields import channels_of
from econgs_bench.datasets.readers.finish import check_expansion, unpacked, unpacked_type
from econgs_bench.datasets.readers.lengths import in_one_unit

_COLORS = (2, 5, 6, 8)
"""TIFF's photometric interpretations with colors: RGB, CMYK, YCbCr, Lab."""

_UNCALIBRATED = 20
"""ImageJ's number for no function of calibration."""

PICTURES = (".tif", ".tiff", ".png")


def open_source(path: str) -> Stack | Folder:
    """A file, or the slices of a folder."""
    return Folder(Path(path)) if Path(path).is_dir() else Stack(Path(path))


class Stack:
    """A TIFF file: its pages as one stack, or the first of OME's images."""

    def __init__(self, path: Path) -> None:
        import tifffile

        self._path = path
        self._file = tifffile.TiffFile(path)
        self._series, self._line = _series(path, self._file)
        series = self._series
        axes = [(letter, n) for letter, n in zip(series.axes, series.shape, strict=True) if n > 1]
        self._letters = "".join(letter for letter, _ in axes)
        self._shape = tuple(n for _, n in axes)
        _check_pages(path, self._file)
        # Three axes are z, y, x whatever their letters; of more, T is time and S or C are components.
        self._order = _order(self._letters, self._shape, path)
        self._channels = _channels(series.keyframe, self._sizes()[-1], "C" in self._letters)

    def contents(self) -> dict[str, Any]:
        """Dims, steps, components and channels of its only variable."""
        steps, *dims, components = self._sizes()
        about = {"name": "value", "dims": dims[::-1], "steps": steps, "components": components}
        return {"variables": [{**about, "channels": self._channels}]}

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Values (z, y, x) or (z, y, x, components), and positions where the file has distances."""
        del read
        values = self._series.asarray().reshape(self._shape)
        values = values.transpose([at for at in self._order if at >= 0]).reshape(self._sizes())[step]
        if values.shape[-1] == 1:
            values = values[..., 0]
        scale, offset, line = _calibration(self._file, self._series.keyframe)
        parts = {"values": values, **self._positions(values.shape)}
        if (scale, offset) != (1.0, 0.0):
            kind = np.dtype(unpacked_type(values.dtype, scale, offset))
            parts["values"] = Slabs(values.shape, kind, (unpacked(part, scale, offset) for part in values))
        return {"of_cells": False, "notice": "; ".join(filter(None, (line, self._line)))}, parts

    def _sizes(self) -> list[int]:
        return [self._shape[at] if at >= 0 else 1 for at in self._order]

    def _positions(self, shape: tuple[int, ...]) -> dict[str, NDArray[Any]]:
        """ImageJ's and OME's distances along the axes, of which the file has them."""
        distances: list[float | None] | None = None
        if self._file.is_ome and self._file.ome_metadata:
            distances = _of_ome(self._file.ome_metadata)
        elif self._file.is_imagej and self._file.imagej_metadata:
            tags = self._file.pages.first.tags
            x, y = (_distance(tags.get(f"{axis}Resolution")) for axis in "XY")
            z = self._file.imagej_metadata.get("spacing")
            first = str(self._file.imagej_metadata.get("unit", ""))
            units = [first, *(str(self._file.imagej_metadata.get(f"{axis}unit", first)) for axis in "yz")]
            distances = _in_one_unit([x, y, None if z is None else abs(float(z))], units)
        if distances is None:
            return {}
        along = zip("xyz", distances, shape[2::-1], strict=True)
        return {name: d * np.arange(n, dtype=np.float64) for name, d, n in along if d is not None}


def _series(path: Path, file: Any) -> tuple[Any, str]:
    """All pages of a file as one series, and a line on images that are left out.

    tifffile begins a series where pages differ in compression or strips, and one for each page that a loop
    writes. Pages of reduced resolution are none of the stack.
    """
    import tifffile

    first, *others = file.series
    if not others:
        return first, ""
    if file.is_ome or file.is_imagej or file.is_lsm:
        return first, f"images after the first are left out: {len(others)}"
    pages = [page for page in file.pages if not page.is_reduced]
    kinds = [(page.shape, page.axes, page.dtype, page.photometric, page.extrasamples) for page in pages]
    if (number := next((i for i, kind in enumerate(kinds) if kind != kinds[0]), 0)) > 0:
        reason = f"page {number + 1} differs in size, type or colors from the first"
        raise DataError(path, reason, "Write pages of one kind, without thumbnails, as one file")
    shape, axes, dtype, *_ = kinds[0]
    series = tifffile.TiffPageSeries(pages, shape=(len(pages), *shape), dtype=dtype, axes=f"I{axes}")
    return series, ""


def _of_ome(text: str) -> list[float | None] | None:
    """Distances x, y, z of the first image, in one unit; None for an axis without."""
    from xml.etree import ElementTree

    try:
        pixels = next(e for e in ElementTree.fromstring(text).iter() if e.tag.rpartition("}")[2] == "Pixels")
        sizes = [pixels.get(f"PhysicalSize{axis}") for axis in "XYZ"]
        lengths = [None if size is None else float(size) for size in sizes]
    except (ElementTree.ParseError, StopIteration, ValueError):
        return None
    return _in_one_unit(lengths, [pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "XYZ"])


def _in_one_unit(distances: list[float | None], units: list[str]) -> list[float | None] | None:
    """Distances in the unit of the first of them; None for those that are not known."""
    known = [i for i, d in enumerate(distances) if d is not None and np.isfinite(d) and d > 0.0]
    scaled = in_one_unit([distances[i] or 0.0 for i in known], [units[i] for i in known])
    if not known or scaled is None:
        return None
    result: list[float | None] = [None] * 3
    for i, length in zip(known, scaled, strict=True):
        result[i] = length
    return result


def _channels(page: Any, components: int, of_stack: bool) -> int:
    """How many of the components are channels of a picture, before those that are alpha."""
    if components == 1:
        return 0
    if of_stack:
        return components
    alpha = sum(extra in (1, 2) for extra in page.extrasamples)
    colors = int(page.photometric) in _COLORS or components - alpha == 1
    return components - len(page.extrasamples) if colors else channels_of(components, page.dtype)


def _calibration(file: Any, page: Any) -> tuple[float, float, str]:
    """Scale and offset of ImageJ's calibration of gray values, and a line on one that is not applied."""
    about = (file.imagej_metadata or {}) if file.is_imagej else {}
    function = about.get("cf", _UNCALIBRATED)
    if function == _UNCALIBRATED or page.dtype.kind not in "iu" or page.dtype.itemsize > 2:
        return 1.0, 0.0, ""
    try:
        offset, scale = float(about["c0"]), float(about["c1"])
    except (KeyError, TypeError, ValueError):
        offset, scale = 0.0, 0.0
    if function != 0 or not np.isfinite(offset * scale) or scale == 0.0 or page.samplesperpixel > 1:
        return 1.0, 0.0, f"values are as stored: ImageJ's calibration function {function} is not applied"
    return scale, offset, ""


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
    if len(components) > 1 or len(time) > 1 or len(rest) != 3 or (len(axes) == 3 and "S" in letters):
        sizes = " x ".join(f"{n} ({letter})" for letter, n in zip(letters, shape, strict=True))
        raise DataError(path, f"has the axes {sizes}", "Write one stack of pages: z, y, x")
    return [*(time or [-1]), *rest, *(components or [-1])]


class Folder:
    """The pictures of a folder as slices, in the order of the numbers in their names."""

    def __init__(self, path: Path) -> None:
        self._path = path
        pictures = [file for file in visible(path) if file.suffix.lower() in PICTURES]
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
        first, self._channels, self._line = _picture(self._files[0])
        self._shape, self._dtype = (len(self._files), *first.shape), first.dtype

    def contents(self) -> dict[str, Any]:
        """Dims, components and channels of its only variable."""
        z, y, x, *components = self._shape
        about = {"name": "value", "dims": [x, y, z], "steps": 1, "components": (*components, 1)[0]}
        return {"variables": [{**about, "channels": self._channels}]}

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, Slabs]]:
        """Values (z, y, x) or (z, y, x, components), slice by slice."""
        del read, step
        parts = {"values": Slabs(self._shape, self._dtype, self._slices())}
        return {"of_cells": False, "notice": self._line}, parts

    def _slices(self) -> Any:
        for file in self._files:
            values, channels, _ = _picture(file)
            if (values.shape, values.dtype, channels) != (self._shape[1:], self._dtype, self._channels):
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


def _picture(file: Path) -> tuple[NDArray[Any], int, str]:
    """(y, x), or (y, x, components), the number of channels among the components, and a line on them."""
    if file.suffix.lower() == ".png":
        return *_png(file), ""
    import tifffile

    with tifffile.TiffFile(file) as tiff:
        _check_pages(file, tiff)
        series, left = _series(file, tiff)
        axes = [(letter, n) for letter, n in zip(series.axes, series.shape, strict=True) if n > 1]
        letters = "".join(letter for letter, _ in axes)
        planes = len(letters) == 3 and letters[0] in "SC"
        if len(letters) != 2 and not planes and not (len(letters) == 3 and letters[2] in "SC"):
            sizes = " x ".join(f"{n} ({letter})" for letter, n in axes)
            remedy = "Name that file alone, or write one slice in each file"
            raise DataError(file, f"{file.name} is no slice: it has the axes {sizes}", remedy)
        values = np.asarray(series.asarray().squeeze())
        values = np.moveaxis(values, 0, -1) if planes else values
        scale, offset, line = _calibration(tiff, series.keyframe)
        channels = _channels(series.keyframe, (*values.shape, 1)[2], "C" in letters)
        return unpacked(values, scale, offset), channels, "; ".join(filter(None, (line, left)))


def _png(file: Path) -> tuple[NDArray[Any], int]:
    """Values of a PNG file and the channels among them."""
    from PIL import Image

    with Image.open(file, formats=["PNG"]) as image:  # it bounds width and height
        with file.open("rb") as stream:
            depth, colors = stream.read(26)[24:]
        if depth == 16 and colors:  # Pillow would cut colors and gray beside alpha to 8 bits
            import imagecodecs

            samples = {2: 3, 4: 2, 6: 4}.get(colors, 1)
            size = file.stat().st_size
            check_expansion(file, size, 2 * samples * image.width * image.height, image.size, "uint16")
            deep: NDArray[Any] = np.asarray(imagecodecs.png_decode(file.read_bytes()))
            return deep, {2: 1, 3: 3, 4: 3}[(*deep.shape, 1)[2]]
        if image.mode == "P":
            raise DataError(file, "has a palette", "Write it in gray, 8 or 16 bits")
        values = np.asarray(image)
        values = values.astype(np.uint16) if image.mode.startswith("I") else values
        return values, {"LA": 1, "RGB": 3, "RGBA": 3}.get(image.mode, 0)
