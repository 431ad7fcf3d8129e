"""NIfTI-1 and -2 through nibabel, which applies slope and intercept."""

from __future__ import annotations

import gzip
import logging
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.fields import Variable, channels_of
from econgs_bench.datasets.readers.finish import (
    Spacing,
    check_expansion,
    left_out,
    positive_dims,
    unpacked_type,
    wrong_size,
)
from econgs_bench.datasets.readers.notices import notice
from econgs_bench.datasets.readers.single import Single

_REMEDY = "Copy it again, or write it with nibabel as one 3-D scalar image"
_NIFTI2 = (540, 0x1C020000)  # size of its header, in either byte order


def open_nifti(path: Path) -> Single:
    """The field of a file, with its time steps; axes as in the file (the affine gives only distances)."""
    try:
        with _remarks(path):
            image: Any = _image(path)
        dims = tuple(int(n) for n in image.shape)
        dtype = image.header.get_data_dtype()
        spacing = _spacing(path, image) if len(dims) >= 3 else None
    except MemoryError:
        raise
    except Exception as error:  # damaged headers fail in nibabel in many ways
        raise DataError(path, f"is not a readable NIfTI image ({error})", _REMEDY) from error
    while len(dims) > 3 and dims[-1] == 1:
        dims = dims[:-1]
    colors = len(dtype.names) if dtype.names else 0
    # The fourth axis is time, the fifth holds components.
    steps, components = (*dims[3:], 1, 1)[:2]
    parts = max(components, colors)
    if len(dims) < 3 or len(dims) > 5 or (colors and components > 1):
        positive_dims(dims, path)
    positive_dims(dims[:3], path)
    if min(dims) < 1:
        text = " x ".join(map(str, dims))
        raise DataError(path, f"has no samples (size {text})", "Write it again with positive dims")
    if not colors and (dtype.kind not in "iuf" or dtype.itemsize > 8):
        raise DataError(path, f"values of type {dtype} are no scalar field", _REMEDY)
    at = Path(image.file_map["image"].filename or path)  # of a pair, the file of the values
    if not at.is_file():
        raise DataError(path, f"its data file {at} does not exist", "Keep header and data together")
    expected, size = math.prod(dims) * dtype.itemsize, at.stat().st_size
    if _is_gzip(at):
        check_expansion(at, size, expected, dims, dtype.name)
    elif size < expected:
        raise wrong_size(at, expected, f"{size} bytes", dims, dtype.name)
    elif text := left_out(size, image.dataobj.offset + expected):
        notice(f"{at}: {text}")

    def load(step: int) -> NDArray[np.generic]:
        try:
            if len(dims) == 3:
                values = np.asanyarray(image.dataobj).reshape(dims, order="F")
            else:
                values = np.asanyarray(image.dataobj[:, :, :, step])
        except MemoryError:
            raise
        except Exception as error:  # a truncated or damaged stream
            raise DataError(path, f"its values cannot be read ({error})", _REMEDY) from error
        if colors:
            values = np.stack([values[name] for name in values.dtype.names], axis=-1)
        values = values.reshape(*dims[:3], *([parts] if parts > 1 else []))
        if values.dtype == np.float64 and dtype.itemsize < 4:
            # Slope and intercept turned small integers into float64.
            packing = image.dataobj.slope, image.dataobj.inter
            values = values.astype(unpacked_type(dtype, *packing), copy=False)
        return np.asarray(values.transpose(2, 1, 0, *range(3, values.ndim)))

    x, y, z = dims[:3]
    channels = min(colors, 3) or channels_of(components, dtype)
    variable = Variable("value", (x, y, z), steps, max(parts, 1), channels)
    return Single(path, variable, load, spacing)


@contextmanager
def _remarks(path: Path) -> Iterator[None]:
    """Let nibabel's remarks on a header be lines that name the file; it would write them on stderr itself."""
    from nibabel.imageglobals import logger

    told = logging.Handler(logging.WARNING)
    told.emit = lambda record: notice(f"{path}: {record.getMessage()}")  # type: ignore[method-assign]
    before = logger.handlers, logger.propagate
    logger.handlers, logger.propagate = [told], False
    try:
        yield
    finally:
        logger.handlers, logger.propagate = before


def _is_gzip(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def _image(path: Path) -> Any:
    """The image of a file of any name."""
    import nibabel

    name = path.name.lower()
    if name.endswith((".img", ".hdr", ".img.gz", ".hdr.gz")):
        pair: Any = nibabel.load(path)
        values = Path(pair.file_map["image"].filename)
        packed = values.with_name(f"{values.name}.gz")
        if packed.is_file() and not values.exists():  # an open header beside packed values
            pair = type(pair).from_file_map(pair.file_map | {"image": nibabel.FileHolder(str(packed))})
        return pair
    if name.endswith(".nii.gz" if _is_gzip(path) else ".nii"):
        return nibabel.load(path)
    file: Any = gzip.open(path) if _is_gzip(path) else path.open("rb")  # noqa: SIM115 (read on demand)
    second = int.from_bytes(file.read(4), sys.byteorder) in _NIFTI2
    kind = nibabel.Nifti2Image if second else nibabel.Nifti1Image
    file.seek(0)
    holder = nibabel.FileHolder(fileobj=file)
    return kind.from_file_map({"header": holder, "image": holder})


def _spacing(path: Path, image: Any) -> Spacing | None:
    """Voxel sizes of the affine (sform, else qform), else pixdim; None where there is neither."""
    import nibabel

    sizes = [abs(float(zoom)) for zoom in image.header.get_zooms()[:3]]
    known = all(math.isfinite(size) and size > 0.0 for size in sizes)
    header = image.header
    if "sform_code" in header and max(int(header["sform_code"]), int(header["qform_code"])) > 0:
        of_affine = [float(size) for size in nibabel.affines.voxel_sizes(image.affine)]
        usable = all(math.isfinite(size) and size > 0.0 for size in of_affine)
        if usable and not (known and np.allclose(of_affine, sizes, rtol=1e-3)):
            given, other = _text(of_affine), _text(sizes)
            notice(f"{path}: voxels are {given} by its affine, which counts, and {other} by its pixdim")
            sizes, known = of_affine, True
    return (sizes[0], sizes[1], sizes[2]) if known and len(sizes) == 3 else None


def _text(sizes: list[float]) -> str:
    return " x ".join(f"{size:g}" for size in sizes)
