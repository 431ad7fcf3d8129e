"""NumPy ``.npy`` files of shape (nz, ny, nx), memory-mapped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.readers.finish import UNIT, Spacing


def read_npy(path: Path) -> tuple[NDArray[np.generic], Spacing]:
    """Values and unit spacing."""
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except MemoryError:
        raise
    except Exception as error:  # a damaged header fails in NumPy's parser in many ways
        remedy = "Write it with numpy.save (no objects), shape (z, y, x)"
        raise DataError(path, f"is not a readable .npy file ({error})", remedy) from error
    if not isinstance(values, np.ndarray):
        raise DataError(path, "holds several arrays", "Save one array with numpy.save")
    return values, UNIT
