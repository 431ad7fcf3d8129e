"""DICOM: the series of a folder, or the frames of a file.

SimpleITK (GDCM) decodes pixels and applies the rescale of a whole file. This module does what it leaves out:
rescale of each frame and of doses, places of frames, MONOCHROME1 as stored (PS3.3 C.7.6.3.1.2).
"""

from __future__ import annotations

import math
import mmap
import shutil
import struct
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.child import elements
from econgs_bench.datasets.readers.child.elements import Values
from econgs_bench.datasets.readers.child.parts import Slabs
from econgs_bench.datasets.readers.content import is_dicom, visible
from econgs_bench.datasets.readers.fields import channels_of

_OFFSETS, _DOSE = 0x3004000C, 0x3004000E
_IMAGER, _SCANNED = 0x00181164, 0x00182010
_BITS, _SIGNED = 0x00280101, 0x00280103
_PADDING, _PADDING_LIMIT = 0x00280120, 0x00280121
_TAGS = (
    elements.POSITION, elements.ORIENTATION, elements.SPACING, elements.BETWEEN, elements.THICKNESS,
    elements.SLOPE, elements.INTERCEPT, _OFFSETS, _DOSE, _IMAGER, _SCANNED, _BITS, _SIGNED,
    _PADDING, _PADDING_LIMIT,
)  # fmt: skip
_NO_SLICES = {
    0x00181063: "time", 0x00181065: "time", 0x00540010: "energy window", 0x00540020: "detector",
    0x00540050: "rotation", 0x00540060: "heartbeat", 0x00540070: "time", 0x00540090: "angle",
    0x00540100: "time",
}  # fmt: skip
"""What the frames of a file may be counted by that is no place (PS3.3 C.7.6.5, C.8.4.8)."""
_PIXELS, _END = 0x7FE00010, b"\xfe\xff\xdd\xe0"
"""Tag of pixel data, and that of the end of a sequence, in files that compress them (little-endian)."""
_UNEVEN = 0.01
"""Deviation of a gap between slices, in gaps, beyond which a slice counts as missing."""
_EXACT = 1 << 24
"""Whole numbers that float32 distinguishes."""


@dataclass(frozen=True)
class _File:
    """A file, before any pixel is read.

    Attributes:
        size: samples along x, y, and frames.
        spacing: along x, y, z as ITK has it: 1 where it knows none.
        frames: values by tag of each frame.
        patches: first byte and new bytes of what GDCM must not apply.
        rescale: slope and intercept of each frame that GDCM does not apply; None where it does.
        padding: lowest and highest stored value that stands for no pixel (PS3.3 C.7.5.1.1.2); None for none.
        dtype: of its values.
    """

    path: str
    size: tuple[int, int, int]
    components: int
    spacing: tuple[float, float, float]
    frames: list[Values]
    patches: list[tuple[int, bytes]]
    rescale: list[tuple[float, float]] | None
    padding: tuple[float, float] | None
    dtype: np.dtype


class Series:
    """One variable per series of single frames, and per file of several frames."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._notices: list[str] = []
        if path.is_dir():
            names = self._series()
        else:
            _check_whole(path)
            names = [[str(path)]]
        stacks: list[list[_File]] = []
        for files in names:
            opened = [_opened(file) for file in files]
            single = [file for file in opened if file.size[2] == 1]
            stacks += [single] if single else []
            stacks += [[file] for file in opened if file.size[2] > 1]
        if not stacks:
            raise DataError(path, "holds no DICOM series", "Check that its slices are there")
        one = len(stacks) == 1
        self._stacks = {"value" if one else f"series{i}": stack for i, stack in enumerate(stacks)}

    def contents(self) -> dict[str, Any]:
        """Name, dims, steps and components of each image."""
        variables = []
        for name, files in self._stacks.items():
            frames, components = [frame for file in files for frame in file.frames], files[0].components
            steps = len({frame.get(elements.TIME) for frame in frames}) if len(files) == 1 else 1
            if len(frames) % steps:
                raise self._error("has other numbers of frames at other times")
            dims = [*files[0].size[:2], len(frames) // steps]
            entry = {"name": name, "dims": dims, "components": components, "steps": steps}
            variables.append({**entry, "channels": channels_of(components, np.dtype(np.uint8))})
        return {"variables": variables} | self._notice()

    def read(self, read: str, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Values (z, y, x) or (z, y, x, components), frame by frame, positions along the axes, and a mask."""
        files, self._notices = self._stacks[read], []
        if len({(file.size[:2], file.components) for file in files}) > 1:
            raise self._error("has slices of different sizes")
        frames = [frame for file in files for frame in file.frames]
        axes: dict[str, NDArray[np.floating]] = {}
        order = self._step(frames, step) if len(files) == 1 else list(range(len(frames)))
        spacing = self._spacing(files)
        if spacing is not None:
            axes = {n: d * np.arange(k) for n, d, k in zip("xy", spacing, files[0].size[:2], strict=True)}
        order, heights = self._heights(files, [frames[at] for at in order], order, spacing)
        if heights is not None:
            axes["z"] = heights
        dtype = np.result_type(*{file.dtype for file in files})
        shape: tuple[int, ...] = (len(order), files[0].size[1], files[0].size[0])
        if files[0].components > 1:
            shape += (files[0].components,)
        padded = files[0].components == 1 and any(file.padding for file in files)
        mask = np.ones(shape[:3], bool) if padded else None
        values = Slabs(shape, dtype, _pieces(files, order, dtype, mask))
        # The mask comes last: it is filled while the values are sent.
        parts = {"values": values, **axes} | ({} if mask is None else {"mask": mask})
        return {"of_cells": False} | self._notice(), parts

    def _notice(self) -> dict[str, str]:
        return {"notice": "; ".join(self._notices)} if self._notices else {}

    def _error(self, reason: str, remedy: str = "Write the volume again with 3D Slicer (.nrrd)") -> DataError:
        return DataError(self._path, reason, remedy)

    def _series(self) -> list[list[str]]:
        """Files of each series, in the order of their positions; a notice names what is no slice."""
        strange = []
        for file in visible(self._path):
            if file.name != "DICOMDIR":
                with file.open("rb") as stream:
                    dicom = is_dicom(stream.read(132))
                if dicom or (file.suffix.lower() == ".dcm" and file.stat().st_size):
                    _check_whole(file)
                else:
                    strange.append(file.name)
        if strange:
            more = f" and {len(strange) - 5} more" if len(strange) > 5 else ""
            self._notices.append(f"no DICOM files, and left out: {', '.join(strange[:5])}{more}")
        folder, reader = str(self._path), sitk.ImageSeriesReader
        return [list(reader.GetGDCMSeriesFileNames(folder, one)) for one in reader.GetGDCMSeriesIDs(folder)]

    def _step(self, frames: list[Values], step: int) -> list[int]:
        """Places of the frames of one time."""
        times = [frame.get(elements.TIME, (0.0,)) for frame in frames]
        time = sorted(set(times))[step]
        places = [at for at, one in enumerate(times) if one == time]
        if len(places) * len(set(times)) != len(frames):
            raise self._error("has other numbers of frames at other times")
        return places

    def _spacing(self, files: list[_File]) -> tuple[float, float] | None:
        """Distances along x and y."""
        found = {_pixel(file.spacing, frame) for file in files for frame in file.frames}
        first = next(iter(found))
        if first is None or None in found:
            return None
        if any(not np.allclose(first, one, rtol=1e-3, atol=0) for one in found if one):
            raise self._error("has frames of different sample distances")
        return first

    def _heights(
        self, files: list[_File], frames: list[Values], order: list[int], spacing: tuple[float, float] | None
    ) -> tuple[list[int], NDArray[np.floating] | None]:
        """The order of the frames along their normal, and their places there; None where they say none.

        Raises:
            DataError: the frames do not stand upright above each other at even distances.
        """
        n = len(frames)
        if n < 2:
            return order, None
        if len({frame.get(elements.SEGMENT) for frame in frames}) > 1:
            raise self._error("holds several segments", "Export one segment, with 3D Slicer, say")
        if offsets := frames[0].get(_OFFSETS):
            if len(offsets) != n or len(files) > 1:
                raise self._error(f"has {len(offsets)} frame offsets for {n} frames")
            return order, np.array(offsets)
        places = [frame.get(elements.POSITION, ()) for frame in frames]
        if all(len(place) == 3 for place in places):
            return self._placed(np.array(places), frames, order, spacing)
        for tag, name in ((elements.BETWEEN, "SpacingBetweenSlices"), (elements.THICKNESS, "SliceThickness")):
            found = [abs(frame.get(tag, (0.0,))[0]) for frame in frames]
            if min(found) > 0.0 and max(found) < 1.001 * min(found):
                if len(files) > 1 or tag == elements.THICKNESS:
                    text = "its slices have no positions: taken in the order of their numbers"
                    self._notices.append(f"{text}, {found[0]:g} apart ({name})")
                return order, found[0] * np.arange(n)
        distance = files[0].spacing[2]
        return order, distance * np.arange(n) if len(files) == 1 and distance != 1.0 else None

    def _placed(
        self,
        places: NDArray[np.floating],
        frames: list[Values],
        order: list[int],
        spacing: tuple[float, float] | None,
    ) -> tuple[list[int], NDArray[np.floating]]:
        upright = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
        turns = np.array([_six(frame.get(elements.ORIENTATION, upright)) for frame in frames])
        normal = np.cross(turns[0, :3], turns[0, 3:])
        if not np.isfinite(places).all() or not abs(np.linalg.norm(normal) - 1.0) < 0.01:
            raise self._error("has malformed positions or orientations")
        if np.abs(turns - turns[0]).max() > 1e-3:
            raise self._error("has slices of different orientations", "Keep one stack in each folder")
        normal /= np.linalg.norm(normal)
        heights = (places - places[0]) @ normal
        rank = np.argsort(heights, kind="stable")
        heights, places = heights[rank] - heights[rank[0]], places[rank] - places[rank[0]]
        steps, step = np.diff(heights), heights[-1] / (len(heights) - 1)
        if not steps.min() > 1e-3 * step:
            reason = "has several slices at one position (times, echoes or segments)"
            raise self._error(reason, "Keep one stack in each folder or file")
        off = float(np.abs(steps - step).max())
        if off > _UNEVEN * step:
            reason = f"uneven distances, or missing slices detected: {steps.min():g} to {steps.max():g}"
            raise self._error(reason, "Copy all its slices, or resample it to even distances (3D Slicer)")
        aside = np.linalg.norm(places - np.outer(heights, normal), axis=1)
        if aside.max() > 0.5 * min(spacing or (step, step)):
            angle = math.degrees(math.atan2(aside[-1], heights[-1]))
            reason = f"its slices are no upright stack: a gantry tilt of {angle:.1f} degrees"
            raise self._error(reason, "Resample it upright, with 3D Slicer or dcm2niix, say")
        return [order[at] for at in rank], heights


def _six(values: tuple[float, ...]) -> tuple[float, ...]:
    return values if len(values) == 6 else (math.nan,) * 6


def _pixel(otherwise: tuple[float, ...], frame: Values) -> tuple[float, float] | None:
    """Distances along x and y of a frame: of the patient, else at the detector or scanner."""
    for tag in (elements.SPACING, _IMAGER, _SCANNED):
        found = frame.get(tag, ())
        if len(found) == 2 and min(found) > 0.0:
            return found[1], found[0]  # DICOM has that between rows first
    return None if otherwise[:2] == (1.0, 1.0) else (otherwise[0], otherwise[1])


def _opened(path: str) -> _File:
    """What a file says of its frames.

    Raises:
        DataError: it cannot be understood.
    """
    reader = sitk.ImageFileReader()
    reader.SetFileName(path)
    reader.ReadImageInformation()
    keys = {tag: f"{tag >> 16:04x}|{tag & 0xFFFF:04x}" for tag in _TAGS}
    top = {
        t: elements.numbers(reader.GetMetaData(key)) for t, key in keys.items() if reader.HasMetaDataKey(key)
    }
    top = {tag: values for tag, values in top.items() if values}
    x, y, n = [*reader.GetSize(), 1, 1][:3]
    key = "0028|0004"
    inverse = reader.HasMetaDataKey(key) and reader.GetMetaData(key).strip(" \0") == "MONOCHROME1"
    nested, patches = elements.Elements(), []
    try:
        with Path(path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            number = "0028|0008"  # of frames
            if inverse or reader.HasMetaDataKey(number) or elements.names_table(data):
                nested = elements.read(data)
                patches = _patches(data, nested, inverse)
        if nested.table:
            reason = f"its file {Path(path).name} holds indices into a table (Modality LUT)"
            raise DataError(
                path, reason, "Write what the table gives (pydicom's apply_modality_lut) as .nrrd"
            )
        if n > 1:
            top.pop(elements.POSITION, None)  # of the first frame
        if n > (length := Path(path).stat().st_size) and not nested.deflated:
            raise elements.Malformed(f"it says {n} frames in {length} bytes")
        frames = [top | frame for frame in nested.frames] or [top | nested.shared] * n
        counted = [_NO_SLICES[tag] for tag in nested.counted if tag in _NO_SLICES]
        if n > 1 and counted and not all(elements.POSITION in frame for frame in frames):
            reason = f"the frames of {Path(path).name} are no slices: they differ in {counted[0]}"
            raise DataError(path, reason, "Write those that are a volume as .nrrd (3D Slicer)")
        if len(frames) != n:
            raise elements.Malformed(f"it says of {len(frames)} frames where it has {n}")
        rescale = _rescale(frames, top, bool(nested.frames or nested.shared))
        if rescale is None:
            patches = patches[:inverse]
        if patches and nested.deflated:
            raise elements.Malformed("a deflated file has MONOCHROME1 or a rescale of its frames")
    except elements.Malformed as error:
        reason = f"its file {Path(path).name} cannot be understood ({error})"
        raise DataError(path, reason, "Write it again with 3D Slicer (.nrrd)") from error
    size = reader.GetSpacing()
    dtype = _type(frames, rescale, np.dtype(_NUMPY.get(reader.GetPixelID(), "f8")))
    return _File(
        path, (x, y, n), reader.GetNumberOfComponents(), (size[0], size[1], (*size, 1.0)[2]), frames, patches,
        rescale, _padding(top), dtype,
    )  # fmt: skip


_NUMPY = {
    sitk.sitkUInt8: "u1", sitk.sitkInt8: "i1", sitk.sitkUInt16: "u2", sitk.sitkInt16: "i2",
    sitk.sitkUInt32: "u4", sitk.sitkInt32: "i4", sitk.sitkUInt64: "u8", sitk.sitkInt64: "i8",
    sitk.sitkFloat32: "f4", sitk.sitkVectorUInt8: "u1", sitk.sitkVectorInt8: "i1",
    sitk.sitkVectorUInt16: "u2", sitk.sitkVectorInt16: "i2", sitk.sitkVectorUInt32: "u4",
    sitk.sitkVectorInt32: "i4", sitk.sitkVectorFloat32: "f4",
}  # fmt: skip


def _patches(data: elements.Bytes, nested: elements.Elements, inverse: bool) -> list[tuple[int, bytes]]:
    """Changes after which GDCM gives values as stored; the first is that of MONOCHROME1, which it inverts."""
    name = b"MONOCHROME1"
    first, rest = [], []
    for tag, start, length in nested.places:
        if tag == elements.PHOTOMETRIC and inverse:
            at = -1 if nested.deflated else data.find(name, start, start + length)
            first = [(at + len(name) - 1, b"2")]
        elif tag != elements.PHOTOMETRIC and length:
            rest.append((start, (b"1" if tag == elements.SLOPE else b"0").ljust(length)))
    if inverse and not first:
        raise elements.Malformed("it says no place of MONOCHROME1")
    return first + rest


def _rescale(frames: list[Values], top: Values, grouped: bool) -> list[tuple[float, float]] | None:
    """Slope and intercept of each frame that GDCM does not apply; None where it does."""
    each = [(f.get(elements.SLOPE, (1.0,))[0], f.get(elements.INTERCEPT, (0.0,))[0]) for f in frames]
    dose = top.get(_DOSE, (1.0,))[0]
    if not all(math.isfinite(a) and a != 0.0 and math.isfinite(b) for a, b in [*each, (dose, 0.0)]):
        raise elements.Malformed("a slope or intercept is zero or not finite")
    if grouped and set(each) != {(1.0, 0.0)}:
        return each
    return [(dose, 0.0)] * len(frames) if dose != 1.0 else None


def _type(frames: list[Values], rescale: list[tuple[float, float]] | None, dtype: np.dtype) -> np.dtype:
    """Type of the values; double precision only where single has not the digits.

    Args:
        frames: values by tag of each frame.
        rescale: what is applied to them here.
        dtype: what GDCM gives without.
    """
    if rescale is None and dtype != np.float64:
        return dtype
    bits, signed = int(frames[0].get(_BITS, (32.0,))[0]), bool(frames[0].get(_SIGNED, (0.0,))[0])
    low, high = (-(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1) if signed else (0.0, 2.0**bits - 1)
    each = rescale or [
        (f.get(elements.SLOPE, (1.0,))[0], f.get(elements.INTERCEPT, (0.0,))[0]) for f in frames
    ]
    ends = [slope * stored + intercept for slope, intercept in each for stored in (low, high)]
    if rescale and all(slope.is_integer() and intercept.is_integer() for slope, intercept in each):
        for kind in map(np.dtype, ("u1", "i2", "u2", "i4", "u4")):
            if np.iinfo(kind).min <= min(ends) and max(ends) <= np.iinfo(kind).max:
                return kind
    exact = all(abs(slope) * 2.0**bits + abs(intercept) <= abs(slope) * _EXACT for slope, intercept in each)
    return np.dtype(np.float32 if exact else np.float64)


def _padding(top: Values) -> tuple[float, float] | None:
    """Lowest and highest stored value that stands for no pixel, in the sign of the pixels."""
    if _PADDING not in top:
        return None
    half = 1 << 15 if top.get(_SIGNED, (0.0,))[0] else 0
    ends = [(top[tag][0] + half) % (1 << 16) - half for tag in (_PADDING, _PADDING_LIMIT) if tag in top]
    return min(ends), max(ends)


def _pieces(
    files: list[_File], order: list[int], dtype: np.dtype, mask: NDArray[np.bool_] | None
) -> Iterator[NDArray[Any]]:
    """The values of the frames, one by one, and what is valid of them into the mask.

    Of a series, a file is open at a time.
    """
    whole = len(files) == 1
    for k, at in enumerate(order):
        file, number = (files[0], at) if whole else (files[at], 0)
        if k == 0 or not whole:
            image = _image(file)
            values = _array(image, file)
        if mask is not None and file.padding is not None:
            mask[k] = _is_pixel(values[number], file, number)
        yield _converted(values[number], file, number, dtype)


def _is_pixel(values: NDArray[Any], file: _File, at: int) -> NDArray[np.bool_]:
    """Which values of a frame, as GDCM gives them, are not stored as padding."""
    assert file.padding is not None
    frame = file.frames[at] if file.rescale is None else {}
    slope, intercept = frame.get(elements.SLOPE, (1.0,))[0], frame.get(elements.INTERCEPT, (0.0,))[0]
    low, high = sorted(slope * end + intercept for end in file.padding)
    margin = abs(slope) / 2.0
    return (values < low - margin) | (values > high + margin)


def _image(file: _File) -> Any:
    if not file.patches:
        return sitk.ReadImage(file.path)
    with tempfile.TemporaryFile() as copy:  # without a name: nothing stays when this process is killed
        with Path(file.path).open("rb") as source:
            shutil.copyfileobj(source, copy)
        for at, new in file.patches:
            copy.seek(at)
            copy.write(new)
        copy.flush()
        copy.seek(0)
        return sitk.ReadImage(f"/dev/fd/{copy.fileno()}", imageIO="GDCMImageIO")


def _array(image: Any, file: _File) -> NDArray[Any]:
    values: NDArray[Any] = sitk.GetArrayViewFromImage(image)
    if values.shape[:3] != file.size[::-1]:
        raise ValueError("it has another size than it says")
    return values


def _converted(values: NDArray[Any], file: _File, at: int, dtype: np.dtype) -> NDArray[Any]:
    if file.rescale is not None:
        slope, intercept = file.rescale[at]
        values = values * np.float64(slope) + intercept
    converted = values.astype(dtype)
    if dtype.kind != "f" and not np.array_equal(converted, values):
        raise ValueError("its values are beyond what it says")
    return converted


def _check_whole(file: Path) -> None:
    """Refuse a DICOM file without whole pixel data: ITK fills what is missing with zeros."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            whole = _is_whole(elements.inflated(data) or data, elements.byte_order(data))
        except (elements.Malformed, struct.error):
            whole = False
    if not whole:
        reason = f"its file {file.name} has no pixels, or is truncated"
        raise DataError(file.parent, reason, "Copy it again, or move what is no picture out of the folder")


def _is_whole(data: elements.Bytes, order: Literal["little", "big"]) -> bool:
    pixels = elements.packed(_PIXELS, order)
    at, whole = data.find(pixels), False
    while at >= 0 and not whole:
        explicit = data[at + 4 : at + 6] in (b"OB", b"OW")
        place = at + (8 if explicit else 4)
        length = int.from_bytes(data[place : place + 4], order)
        compressed = length == 0xFFFFFFFF  # a sequence with an end of its own
        whole = data.rfind(_END) > place if compressed else 0 < length <= len(data) - place - 4
        at = data.find(pixels, at + 1)
    return whole
