"""The common form of NetCDF, HDF5 and ``.npz`` files: named arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.readers.finish import Spacing

MOST_ARRAYS = 10_000
"""Arrays of a file beyond these are ignored."""


@dataclass(frozen=True)
class Array:
    """A named array of a file.

    Attributes:
        name: name in the file.
        shape: lengths of the axes, slowest first.
        dtype: type in the file.
        dims: names of its dimensions; "" for one without a name.
        attributes: strings, and lists of numbers.
        spacing: sample distances along x, y, z, where the file has them for this array.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    dims: tuple[str, ...]
    attributes: dict[str, Any] = field(default_factory=dict)
    spacing: Spacing | None = None


class Container(Protocol):
    """An open file of named arrays."""

    arrays: dict[str, Array]

    def read(self, name: str, first: int | None = None) -> NDArray[Any]:
        """An array, or its part at one index of its first dimension."""
