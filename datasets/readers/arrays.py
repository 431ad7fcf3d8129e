"""Fields among named arrays: the conventions shared by NetCDF, HDF5 and ``.npz`` files.

The last three axes of an array are z, y, x; a leading one is time. Arrays without named dimensions hold
vectors if they have a fourth axis and the last axis has 2 to 4 entries. Positions come from coordinate
variables (NetCDF's, HDF5's dimension scales, or arrays ``x``, ``y``, ``z`` of fitting length). Missing values
become the volume's mask: NaN of NetCDF and HDF5 files, ``_FillValue``, ``missing_value``, NetCDF's default
fill, values outside ``valid_range``. ``scale_factor`` and ``add_offset`` are applied.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.readers.axes import place
from datasets.readers.container import Array, Container
from datasets.readers.fields import Choice, Field, Variable, scalar
from datasets.scratch import converted, new_array

_TIME = ("time", "t", "times", "step", "time_step")
_DEFAULT_FILL = {"f4": 9.969209968386869e36, "f8": 9.969209968386869e36, "i2": -32767, "i4": -2147483647}
_MOST = 10_000

_log = logging.getLogger(__name__)


class Arrays:
    """The three-dimensional fields of a container of arrays.

    Args:
        path: the file, for messages.
        container: the open file.
        missing: whether NaN and NetCDF's default fill values mean missing data.
    """

    def __init__(self, path: Path, container: Container, missing: bool) -> None:
        self.path, self._file, self._missing = path, container, missing
        self._shapes: dict[str, tuple[tuple[int, ...], int]] = {}  # leading axes and components
        variables = []
        for array in list(container.arrays.values())[:_MOST]:
            variable = self._variable(array)
            if variable is not None:
                variables.append(variable)
        self.variables = tuple(variables)
        if not variables:
            shapes = ", ".join(f"{a.name} {list(a.shape)}" for a in list(container.arrays.values())[:8])
            reason = "holds no three-dimensional numeric array"
            raise DataError(path, reason, f"It holds {shapes or 'no arrays'}; write one of shape (z, y, x)")

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""
        array = self._file.arrays[choice.variable.name]
        leading, components = self._shapes[array.name]
        values = self._file.read(array.name) if not leading else self._at_step(array, leading, choice.step)
        if array.attributes.get("_Unsigned") in ("true", "True") and values.dtype.kind == "i":
            values = values.view(values.dtype.str.replace("i", "u"))
        mask = self._valid(values, array)
        values = _unpacked(values, array)
        if components > 1:
            values = scalar(values, choice)
            if mask is not None:
                mask = np.asarray(mask.all(axis=-1))
        return place(values, self._axes(array, components), self.path, mask)

    def _variable(self, array: Array) -> Variable | None:
        """Name, dims and steps of a field; None for an array that is no field."""
        if array.dtype.kind not in "iufb" or array.dtype.itemsize > 8 or len(array.shape) < 3:
            return None
        shape, has_names = array.shape, any(array.dims)
        components = 1
        if not has_names and len(shape) > 3 and 2 <= shape[-1] <= 4:
            components, shape = shape[-1], shape[:-1]
        leading, inner = shape[:-3], shape[-3:]
        if min(shape) < 1 or min(inner) < 2 or math.prod(leading) != max(leading, default=1):
            return None
        if has_names and self._is_time(array, len(leading)):
            return None  # a series of pictures
        self._shapes[array.name] = (leading, components)
        return Variable(array.name, (inner[2], inner[1], inner[0]), max(leading, default=1), components)

    def _is_time(self, array: Array, axis: int) -> bool:
        name = array.dims[axis]
        positions = self._file.arrays.get(name)
        units = "" if positions is None else str(positions.attributes.get("units", ""))
        return name.rpartition("/")[2].lower() in _TIME or " since " in units

    def _at_step(self, array: Array, leading: tuple[int, ...], step: int) -> NDArray[Any]:
        along = leading.index(max(leading))
        values = self._file.read(array.name, step if along == 0 else 0)
        values = values.reshape(*leading[1:], *array.shape[len(leading) :])
        for axis in range(1, len(leading)):
            values = values[step if axis == along else 0]
        return values

    def _valid(self, values: NDArray[Any], array: Array) -> NDArray[np.bool_] | None:
        """Mask of the valid values; None if all are."""
        attributes = array.attributes
        fills = [*_numbers(attributes.get("_FillValue")), *_numbers(attributes.get("missing_value"))]
        kind = values.dtype.str[1:]
        if self._missing and "_FillValue" not in attributes and kind in _DEFAULT_FILL and any(array.dims):
            fills.append(_DEFAULT_FILL[kind])
        low, high = (*_numbers(attributes.get("valid_range")), -math.inf, math.inf)[:2]
        low = max([low, *_numbers(attributes.get("valid_min"))])
        high = min([high, *_numbers(attributes.get("valid_max"))])
        if kind in ("f2", "f4"):  # as in the file
            with np.errstate(over="ignore"):
                fills = [float(np.dtype(kind).type(fill)) for fill in fills]
        mask: NDArray[np.bool_] | None = None
        for k, part in enumerate(values):
            valid = ~((part < low) | (part > high))
            if self._missing and values.dtype.kind == "f":
                valid &= ~np.isnan(part)
            for fill in fills:
                valid &= part != fill
            if mask is None and not valid.all():
                mask = new_array(values.shape, bool)
                mask[:k] = True
            if mask is not None:
                mask[k] = valid
        return mask

    def _axes(self, array: Array, components: int) -> list[NDArray[Any] | None]:
        """Positions along x, y, z; None for an axis without coordinates."""
        shape = array.shape[: len(array.shape) - (components > 1)][-3:]
        if any(array.dims):
            names = list(array.dims[-3:])
        else:
            group = array.name.rpartition("/")[0]
            names = [f"{group}/{axis}".lstrip("/") for axis in "zyx"]
        coordinates = [self._file.arrays.get(name) for name in names]
        fits = [
            a is not None and a.shape == (n,) and a.dtype.kind in "iuf"
            for a, n in zip(coordinates, shape, strict=True)
        ]
        if not all(fits) and not any(array.dims):
            return [None, None, None]
        axes = [self._file.read(name) if fit else None for name, fit in zip(names, fits, strict=True)]
        units = {_unit(a) for a, fit in zip(coordinates, fits, strict=True) if fit and a is not None}
        if len(units) > 1 or (any(fits) and not all(fits)):
            # Degrees and metres have no common scale: only the unevenness of each axis counts.
            text = "%s: axes of %s have different units or no positions; mean sample distances are taken as 1"
            _log.info(text, self.path, array.name)
            axes = [None if axis is None else _by_mean_distance(axis) for axis in axes]
        return list(reversed(axes))


def _unit(array: Array) -> str:
    unit = str(array.attributes.get("units", "")).strip().lower()
    return "degrees" if unit.startswith("degree") else unit


def _by_mean_distance(axis: NDArray[Any]) -> NDArray[Any]:
    positions = axis.astype(np.float64)
    span = abs(float(positions[-1] - positions[0]))
    return positions * ((len(positions) - 1) / span) if math.isfinite(span) and span > 0.0 else positions


def _numbers(value: Any) -> list[float]:
    """An attribute's numbers; empty for text."""
    entries = value if isinstance(value, list) else [value]
    return [float(n) for n in entries if isinstance(n, int | float)]


def _unpacked(values: NDArray[Any], array: Array) -> NDArray[Any]:
    """Values after CF's ``scale_factor`` and ``add_offset``."""
    scale = (_numbers(array.attributes.get("scale_factor")) or [1.0])[0]
    offset = (_numbers(array.attributes.get("add_offset")) or [0.0])[0]
    if scale == 1.0 and offset == 0.0:
        return values
    out = converted(values, np.float32 if values.dtype.itemsize <= 2 else np.float64)
    out *= scale
    out += offset
    return out
