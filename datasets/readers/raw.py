"""Headerless ``.raw`` and ``.raw.gz``: x fastest, dims and type in the name or in a sidecar.

Name: ``fuel_64x64x64_uint8.raw`` (x, y, z; little endian unless ``_be`` follows the type).
A fourth length is the number of time steps. Sidecar ``fuel.raw.toml`` beside ``fuel.raw`` (it wins over
the name)::

    dims = [64, 64, 64]        # x, y, z
    dtype = "uint8"
    endian = "little"          # or "big"
    spacing = [1.0, 1.0, 1.0]
    header_bytes = 0           # bytes before the first value
    range = [0.0, 255.0]       # values at 0 and 1 of a transfer function
    missing = [-999.0]         # values that stand for missing data (one number, or several)
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.fields import Variable
from econgs_bench.datasets.readers.finish import UNIT, Spacing, positive_dims, read_values
from econgs_bench.datasets.readers.limits import Limits
from econgs_bench.datasets.readers.single import Single
from econgs_bench.datasets.toml import read_toml

_DTYPES = tuple(f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("u", ""))
_DTYPES = (*_DTYPES, "float16", "float32", "float64")
_DIMS_IN_NAME = re.compile(r"(?<![0-9a-z])(\d+(?:x\d+)+)(?![0-9a-z])")
_DTYPE_IN_NAME = re.compile(r"(?<![0-9a-z])(u?int\d*|float\d*)[_-]?(le|be)?(?![0-9a-z])")
_REMEDY = (
    "It may hold dims, dtype, endian, spacing, header_bytes, range, missing; "
    "dims = [x, y, z] and dtype are needed"
)


class _Sidecar(BaseModel):
    """The keys of a sidecar."""

    model_config = ConfigDict(strict=True, extra="forbid")

    dims: list[int] = Field(min_length=1)
    dtype: str
    endian: Literal["little", "big"] = "little"
    spacing: list[float] | None = Field(None, min_length=3, max_length=3)
    header_bytes: int = Field(0, ge=0)
    range: list[float] | None = Field(None, min_length=2, max_length=2)
    missing: float | list[float] = []


@dataclass(frozen=True)
class Layout:
    """Layout of a raw file: dims, type, spacing, offset, and which values are shown."""

    dims: tuple[int, ...]
    dtype: np.dtype
    spacing: Spacing | None = None
    header_bytes: int = 0
    limits: Limits | None = None


def open_raw(path: Path) -> Single:
    """The field of a raw file; a fourth length is the number of time steps."""
    layout = layout_of(path)
    dims, steps = (layout.dims[:3], layout.dims[3]) if len(layout.dims) == 4 else (layout.dims, 1)
    positive_dims(dims, path)
    positive_dims((steps, 1, 1), path)
    gzipped = path.name.lower().endswith(".gz")

    def load(step: int) -> NDArray[np.generic]:
        whole = (*dims[:2], dims[2] * steps)
        values = read_values(path, 0, layout.header_bytes, whole, layout.dtype, gzipped, True)
        return values[step * dims[2] : (step + 1) * dims[2]]

    x, y, z = dims
    return Single(path, Variable("value", (x, y, z), steps), load, layout.spacing, layout.limits)


def layout_of(path: Path) -> Layout:
    """Dims, type, spacing and offset from the sidecar or the name.

    Raises:
        DataError: neither holds them, or they are invalid.
    """
    sidecar = path.with_name(path.name + ".toml")
    if sidecar.is_file():
        return _from_sidecar(sidecar)
    name = path.name.lower()
    dims, dtype = _DIMS_IN_NAME.findall(name), _DTYPE_IN_NAME.findall(name)
    if not dims or not dtype:
        missing = " and ".join([*(["dims"] if not dims else []), *(["type"] if not dtype else [])])
        raise DataError(
            path,
            f"its name does not say the {missing} of the values",
            f"Name it like head_128x256x256_uint8.raw (x, y, z), or write {sidecar.name} with dims and dtype",
        )
    type_name, endian = dtype[-1]
    return Layout(tuple(int(n) for n in dims[-1].split("x")), _dtype(type_name, endian == "be", path))


def _dtype(name: str, big: bool, path: Path) -> np.dtype:
    if name not in _DTYPES:
        raise DataError(path, f"unknown type {name!r}", f"Known types: {', '.join(_DTYPES)}")
    return np.dtype(name).newbyteorder(">" if big else "<")


def _from_sidecar(path: Path) -> Layout:
    sidecar = read_toml(path, _Sidecar, _REMEDY, _Sidecar.model_fields)
    dtype = _dtype(sidecar.dtype, sidecar.endian == "big", path)
    x, y, z = sidecar.spacing or UNIT
    spacing = None if sidecar.spacing is None else (x, y, z)
    missing = sidecar.missing if isinstance(sidecar.missing, list) else [sidecar.missing]
    ends = sidecar.range
    limits = Limits(None if ends is None else (ends[0], ends[1]), tuple(missing))
    return Layout(tuple(sidecar.dims), dtype, spacing, sidecar.header_bytes, limits)
