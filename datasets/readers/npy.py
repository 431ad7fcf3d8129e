"""NumPy ``.npy`` files of shape (nz, ny, nx), or with a leading axis of time; memory-mapped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.container import Array
from econgs_bench.datasets.readers.fields import Variable
from econgs_bench.datasets.readers.finish import left_out
from econgs_bench.datasets.readers.notices import notice
from econgs_bench.datasets.readers.single import Single


def open_npy(path: Path) -> Single:
    """The field of a file; NumPy knows no spacing."""
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except MemoryError:
        raise
    except Exception as error:  # a damaged header fails in NumPy's parser in many ways
        remedy = "Write it with numpy.save (no objects), shape (z, y, x)"
        raise DataError(path, f"is not a readable .npy file ({error})", remedy) from error
    if not isinstance(values, np.memmap):
        raise DataError(path, "holds several arrays", "Save one array with numpy.save")
    if text := left_out(path.stat().st_size, values.offset + values.nbytes):
        notice(f"{path}: {text}")
    return of_array(path, values)


def of_array(path: Path, values: NDArray[Any]) -> Single:
    """A field by the conventions of arrays without names (:mod:`.datasets.readers.arrays`)."""
    from econgs_bench.datasets.readers.arrays import has_lone_last, variable_of

    array = Array("value", values.shape, values.dtype, ("",) * values.ndim)
    if has_lone_last(array):
        return of_array(path, np.moveaxis(values, -1, 0))
    variable = variable_of(array)
    if variable is None or values.ndim == 3:  # what is no field is refused when its values are read
        dims = (values.shape[2], values.shape[1], values.shape[0]) if values.ndim == 3 else (1, 1, 1)
        return Single(path, Variable("value", dims), lambda _: values, None)
    steps = values.reshape(variable.steps, *values.shape[-4 if variable.components > 1 else -3 :])
    return Single(path, variable, lambda step: steps[step], None)
