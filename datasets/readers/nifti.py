"""NIfTI-1 and -2 through nibabel, which applies slope and intercept."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.readers.finish import Spacing, check_expansion, positive_dims, wrong_size

_REMEDY = "Copy it again, or write it with nibabel as one 3-D scalar image"


def read_nifti(path: Path) -> tuple[NDArray[np.generic], Spacing]:
    """Values (nz, ny, nx) and voxel sizes; axes as in the file (the affine is not applied)."""
    import nibabel

    try:
        image: Any = nibabel.load(path)
        dims = tuple(int(n) for n in image.shape)
        dtype = image.header.get_data_dtype()
        zooms = [abs(float(z)) for z in image.header.get_zooms()]
    except MemoryError:
        raise
    except Exception as error:  # damaged headers fail in nibabel in many ways
        raise DataError(path, f"is not a readable NIfTI image ({error})", _REMEDY) from error
    while len(dims) > 3 and dims[-1] == 1:
        dims = dims[:-1]
    positive_dims(dims, path)
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise DataError(path, f"values of type {dtype} are no scalar field", _REMEDY)
    expected, size = math.prod(dims) * dtype.itemsize, path.stat().st_size
    if path.name.lower().endswith(".gz"):
        check_expansion(path, size, expected, dims, dtype.name)
    elif size < expected:
        raise wrong_size(path, expected, f"{size} bytes", dims, dtype.name)
    try:
        values = np.asanyarray(image.dataobj)
    except MemoryError:
        raise
    except Exception as error:  # a truncated or damaged stream
        raise DataError(path, f"its values cannot be read ({error})", _REMEDY) from error
    if values.dtype == np.float64 and dtype.itemsize < 4:
        # Slope and intercept turned small integers into float64: single precision holds all their values.
        values = values.astype(np.float32)
    x, y, z = (zoom if zoom > 0.0 and math.isfinite(zoom) else 1.0 for zoom in zooms[:3])
    return values.reshape(dims, order="F").transpose(2, 1, 0), (x, y, z)
