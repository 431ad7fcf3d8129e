"""The common form of NetCDF, HDF5 and ``.npz`` files: named arrays."""

from __future__ import annotations

from collections.abc import Container as Names
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.readers.finish import Spacing

MOST_ARRAYS = 10_000
"""Arrays of a file beyond these are ignored."""
LISTED = "iufbcSV"
"""Kinds of arrays that are listed, for an error to name: fields are of the first four."""


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


def of_dimension(dim: str, array: str, names: Names[str]) -> str:
    """The array of a dimension's positions: of its name, in the group of an array or the nearest above it.

    Args:
        dim: name of the dimension; "" for none.
        array: the array that has it.
        names: arrays of the file.

    Returns:
        The name with its group; in the array's own group where there is no such array.
    """
    group = array.rpartition("/")[0]
    groups = ["/".join(group.split("/")[:depth]) for depth in range(len(group.split("/")), -1, -1)]
    found = [f"{at}/{dim}".lstrip("/") for at in groups]
    return next((name for name in found if name in names), found[0]) if dim else ""


class Container(Protocol):
    """An open file of named arrays."""

    arrays: dict[str, Array]

    def read(self, name: str, first: int | None = None) -> NDArray[Any]:
        """An array, or its part at one index of its first dimension."""
