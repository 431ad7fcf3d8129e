"""Headerless ``.raw`` and ``.raw.gz``: x fastest, dims and type in the name or in a sidecar.

Name: ``fuel_64x64x64_uint8.raw`` (x, y, z; little endian unless ``_be`` follows the type).
Sidecar ``fuel.raw.toml`` beside ``fuel.raw`` (it wins over the name)::

    dims = [64, 64, 64]        # x, y, z
    dtype = "uint8"
    endian = "little"          # or "big"
    spacing = [1.0, 1.0, 1.0]
    header_bytes = 0           # bytes before the first value
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from datasets.errors import DataError
from datasets.readers.finish import UNIT, Spacing, positive_dims, read_values
from datasets.toml import read_toml

_DTYPES = tuple(f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("u", ""))
_DTYPES = (*_DTYPES, "float16", "float32", "float64")
_DIMS_IN_NAME = re.compile(r"(?<![0-9a-z])(\d+(?:x\d+)+)(?![0-9a-z])")
_DTYPE_IN_NAME = re.compile(r"(?<![0-9a-z])(u?int\d*|float\d*)[_-]?(le|be)?(?![0-9a-z])")
_REMEDY = "It may hold dims, dtype, endian, spacing, header_bytes; dims = [x, y, z] and dtype are needed"


class _Sidecar(BaseModel):
    """The keys of a sidecar."""

    model_config = ConfigDict(strict=True, extra="forbid")

    dims: list[int] = Field(min_length=1)
    dtype: str
    endian: Literal["little", "big"] = "little"
    spacing: list[float] = Field(list(UNIT), min_length=3, max_length=3)
    header_bytes: int = Field(0, ge=0)


@dataclass(frozen=True)
class Layout:
    """Layout of a raw file: dims, type, spacing and offset."""

    dims: tuple[int, ...]
    dtype: np.dtype
    spacing: Spacing = UNIT
    header_bytes: int = 0


def read_raw(path: Path) -> tuple[NDArray[np.generic], Spacing]:
    """Values (nz, ny, nx) and spacing of a raw file."""
    layout = layout_of(path)
    positive_dims(layout.dims, path)
    gzipped = path.name.lower().endswith(".gz")
    return read_values(path, 0, layout.header_bytes, layout.dims, layout.dtype, gzipped), layout.spacing


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
    x, y, z = sidecar.spacing
    return Layout(tuple(sidecar.dims), dtype, (x, y, z), sidecar.header_bytes)
