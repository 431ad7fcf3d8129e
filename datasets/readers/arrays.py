"""Fields among named arrays: the conventions shared by NetCDF, HDF5, Zarr and NumPy's files.

The last three axes of an array are z, y, x; a leading one is time, or by its name channels. An axis of
time or channels elsewhere, and one that follows x, y and z, counts as leading: by its name too.
Arrays without named dimensions hold vectors if they have a fourth axis and the last axis has 2 to 4 entries;
with one entry it counts for nothing.
Positions come from coordinate variables (NetCDF's, HDF5's dimension scales, or arrays ``x``, ``y``, ``z`` of
fitting length). Missing values become the volume's mask: NaN of NetCDF and HDF5 files, ``_FillValue``,
``missing_value``, NetCDF's default fill, values outside ``valid_range``. ``scale_factor`` and ``add_offset``
are applied. All these attributes are meant in the type in which the values are viewed (``_Unsigned``).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.readers.axes import place
from econgs_bench.datasets.readers.container import MOST_ARRAYS, Array, Container
from econgs_bench.datasets.readers.fields import Choice, Field, Variable, channels_of, scalar
from econgs_bench.datasets.readers.finish import unpacked
from econgs_bench.datasets.readers.lengths import in_one_unit, metres
from econgs_bench.datasets.readers.notices import notice
from econgs_bench.datasets.scratch import converted, new_array

_TIME = ("time", "t", "times", "step", "time_step")
_CHANNEL = ("c", "channel", "channels")
_SPACE = {
    "x": "x", "lon": "x", "longitude": "x", "y": "y", "lat": "y", "latitude": "y", "z": "z", "lev": "z",
    "level": "z", "depth": "z", "height": "z", "altitude": "z", "plev": "z",
}  # fmt: skip
"""Names of axes of space, in any order."""
_COLORS = 4
_DEFAULT_FILL: dict[str, float] = {
    "f4": 9.969209968386869e36, "f8": 9.969209968386869e36, "i2": -32767, "u2": 65535, "i4": -2147483647,
    "u4": 4294967295, "i8": -9223372036854775806, "u8": 18446744073709551614,
}  # fmt: skip


def has_lone_last(array: Array) -> bool:
    """Whether the last axis counts for nothing: of one entry, without a name, and not needed for three."""
    return len(array.shape) > 3 and not any(array.dims) and array.shape[-1] == 1


class Arrays:
    """The three-dimensional fields of a container of arrays.

    Args:
        path: the file, for messages.
        container: the open file.
        missing: whether NaN means missing data.
        netcdf: whether NetCDF's default fill values do.
    """

    def __init__(self, path: Path, container: Container, missing: bool, netcdf: bool = False) -> None:
        self.path, self._file, self._missing, self._netcdf = path, container, missing, netcdf
        variables = []
        self._arranged: dict[str, tuple[Array, tuple[int, ...]]] = {}
        for stored in list(container.arrays.values())[:MOST_ARRAYS]:
            order = self._order(stored)
            array = replace(
                stored,
                shape=tuple(stored.shape[axis] for axis in order),
                dims=tuple(stored.dims[axis] for axis in order),
            )
            variable = variable_of(array)
            if variable is not None and not self._is_series_of_pictures(array):
                variables.append(variable)
                self._arranged[array.name] = array, order
        self.variables = tuple(variables)
        if not variables:
            shapes = ", ".join(map(_described, list(container.arrays.values())[:8]))
            reason = "holds no three-dimensional numeric array"
            raise DataError(path, reason, f"It holds {shapes or 'no arrays'}; write one of shape (z, y, x)")

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""
        variable = choice.variable
        array, order = self._arranged[variable.name]
        values = _viewed(self._at_step(array, order, variable, choice.step), array)
        mask = self._valid(values, array)
        values = _unpacked(values, array)
        if variable.components > 1:
            values = scalar(values, choice, self.path)
            if mask is not None:
                mask = np.asarray(mask.all(axis=-1))
        field = place(values, self._axes(array, variable), self.path, choice.limits, mask)
        return field if field.spacing is not None else replace(field, spacing=array.spacing)

    def _is_series_of_pictures(self, array: Array) -> bool:
        if not any(array.dims):
            return False
        colors = _last(array.dims[-1]) in _CHANNEL and array.shape[-1] <= _COLORS
        return colors or self._is_time(array.dims[-3])

    def _is_time(self, name: str) -> bool:
        positions = self._file.arrays.get(name)
        units = "" if positions is None else str(positions.attributes.get("units", ""))
        return bool(name) and (_last(name) in _TIME or " since " in units)

    def _order(self, array: Array) -> tuple[int, ...]:
        """The axes with those of space last, as far as names tell."""
        axes = tuple(range(len(array.shape)))
        if has_lone_last(array):
            return (axes[-1], *axes[:-1])
        if len(axes) < 3 or not any(array.dims):
            return axes
        names = [_last(name) for name in array.dims]
        times = [axis for axis in axes if self._is_time(array.dims[axis])]
        first = [axis for axis in times if axis in axes[-3:]]
        if len(axes) - len(times) > 3:  # of three axes none is left over for channels
            first += [axis for axis in axes[-3:] if names[axis] in _CHANNEL and axis not in first]
            if not first and names[-1] not in _SPACE and len({_SPACE.get(n) for n in names} - {None}) == 3:
                first = [axes[-1]]
        return (*first, *(axis for axis in axes if axis not in first))

    def _at_step(self, array: Array, order: tuple[int, ...], variable: Variable, step: int) -> NDArray[Any]:
        """Values (z, y, x) or (z, y, x, components)."""
        inner = 4 if variable.components > 1 and not any(array.dims) else 3
        leading = array.shape[:-inner]
        if not leading:
            return self._file.read(array.name)
        channel = _channel_axis(array)
        at = [step if n == variable.steps and n > 1 else 0 for n in leading]
        if order == tuple(range(len(order))):
            values = self._file.read(array.name, None if channel == 0 else at[0])
        else:
            whole = self._file.read(array.name).transpose(order)
            values = converted(whole if channel == 0 else whole[at[0]], whole.dtype)
        index = [slice(None) if axis == channel else at[axis] for axis in range(len(leading))]
        values = values[tuple(index if channel == 0 else index[1:])]
        return values if channel is None else np.moveaxis(values, 0, -1)

    def _valid(self, values: NDArray[Any], array: Array) -> NDArray[np.bool_] | None:
        """Mask of the valid values; None if all are."""
        fills = [n for name in ("_FillValue", "missing_value") for n in _numbers(array, name)]
        kind = values.dtype.str[1:]
        if self._netcdf and "_FillValue" not in array.attributes and array.dtype.str[1:] in _DEFAULT_FILL:
            fills.append(_as_viewed(_DEFAULT_FILL[array.dtype.str[1:]], array))
        low = max([-math.inf, *_numbers(array, "valid_range")[:1], *_numbers(array, "valid_min")])
        high = min([math.inf, *_numbers(array, "valid_range")[1:2], *_numbers(array, "valid_max")])
        if kind in ("f2", "f4"):  # as in the file
            with np.errstate(over="ignore"):
                fills = [float(np.dtype(kind).type(fill)) for fill in fills]
        scale, offset = _packing(array)
        if values.dtype.kind != "f" and any(isinstance(n, float) for n in (low, high) if math.isfinite(n)):
            # By NetCDF's conventions a range of another type than the packed values is of unpacked ones.
            ends = [(n - offset) / scale for n in (low, high)]
            low, high = min(ends), max(ends)
            margin = 1e-6 * max(abs(n) for n in ends if math.isfinite(n))
            low, high = low - margin, high + margin
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

    def _axes(self, array: Array, variable: Variable) -> list[NDArray[Any] | None]:
        """Positions along x, y, z; None for an axis without coordinates."""
        assert variable.dims is not None
        shape = variable.dims[::-1]
        if any(array.dims):
            names = list(array.dims[-3:])
        else:
            group = array.name.rpartition("/")[0]
            names = [f"{group}/{axis}".lstrip("/") for axis in "zyx"]
        coordinates = [self._file.arrays.get(name) for name in names]
        found = [
            a if a is not None and a.shape == (n,) and a.dtype.kind in "iuf" else None
            for a, n in zip(coordinates, shape, strict=True)
        ]
        if (None in found and not any(array.dims)) or found == [None] * 3:
            return [None, None, None]
        known = [a for a in found if a is not None]
        scales = in_one_unit([1.0] * len(known), [_unit(a) for a in known])
        axes = [self._positions(a) for a in known]
        if scales is not None:
            pairs = zip(axes, scales, strict=True)
            axes = [axis if scale == 1.0 else axis * scale for axis, scale in pairs]
        else:  # degrees and metres have no common scale: only the unevenness of each axis counts
            notice(f"{self.path}: axes of {array.name} have different units: mean sample distances 1:1:1 are "
                   "assumed; `spacing` sets them")  # fmt: skip
            axes = list(map(_by_mean_distance, axes))
        placed = iter(axes)
        return [None if a is None else next(placed) for a in found][::-1]

    def _positions(self, array: Array) -> NDArray[Any]:
        return _unpacked(_viewed(self._file.read(array.name), array), array)


def _described(array: Array) -> str:
    """Name and shape of an array, and its type if that is none of numbers of up to 64 bits."""
    plain = array.dtype.kind in "iufb" and array.dtype.itemsize <= 8
    kind = {"V": "compound", "S": "text"}.get(array.dtype.kind, array.dtype.name)
    return f"{array.name} {list(array.shape)}{'' if plain else f' ({kind})'}"


def variable_of(array: Array) -> Variable | None:
    """Name, dims, steps and components of a field; None for an array that is no field."""
    if array.dtype.kind not in "iufb" or array.dtype.itemsize > 8 or len(array.shape) < 3:
        return None
    shape, has_names = array.shape, any(array.dims)
    components = channels = 0
    if not has_names and len(shape) > 3 and 2 <= shape[-1] <= 4 and min(shape[-4:-1]) > 1:
        components, shape = shape[-1], shape[:-1]
        channels = channels_of(components, array.dtype)
    leading, inner = list(shape[:-3]), shape[-3:]
    channel = _channel_axis(array)
    if channel is not None:
        components = channels = leading.pop(channel)
    if min(shape) < 1 or min(inner) < 2 or math.prod(leading) != max(leading, default=1):
        return None
    dims = inner[2], inner[1], inner[0]
    return Variable(array.name, dims, max(leading, default=1), max(components, 1), channels)


def _channel_axis(array: Array) -> int | None:
    """Place of an axis of several channels, by its name."""
    for axis, name in enumerate(array.dims[:-3]):
        if _last(name) in _CHANNEL and array.shape[axis] > 1:
            return axis
    return None


def _last(name: str) -> str:
    return name.rpartition("/")[2].lower()


def _unit(array: Array) -> str:
    unit = str(array.attributes.get("units", "")).strip()
    if metres(unit) is None:
        unit = unit.lower()
    return "degrees" if unit.startswith("degree") else unit


def _by_mean_distance(axis: NDArray[Any]) -> NDArray[Any]:
    positions = axis.astype(np.float64)
    span = abs(float(positions[-1] - positions[0]))
    return positions * ((len(positions) - 1) / span) if math.isfinite(span) and span > 0.0 else positions


def _sign(array: Array) -> str:
    """The kind of integer in which values are viewed: "i", "u", or "" for that of the file."""
    kinds = {"true": "u", "false": "i"}
    kind = kinds.get(str(array.attributes.get("_Unsigned", "")).strip("\0 ").lower(), "")
    return kind if array.dtype.kind in "iu" and array.dtype.kind != kind else ""


def _viewed(values: NDArray[Any], array: Array) -> NDArray[Any]:
    """Values in the type that ``_Unsigned`` asks for."""
    kind = _sign(array)
    return values.view(values.dtype.str.replace(array.dtype.kind, kind)) if kind else values


def _as_viewed(number: float, array: Array) -> float:
    """A number of an attribute in that type: signed -1 is unsigned 255."""
    kind, bits = _sign(array), 8 * array.dtype.itemsize
    if kind == "u" and number < 0:
        return number + (1 << bits)
    return number - (1 << bits) if kind == "i" and number >= 1 << (bits - 1) else number


def _numbers(array: Array, name: str) -> list[float]:
    """The numbers of an attribute, also those written as text, in the type of the viewed values."""
    value = array.attributes.get(name)
    found: list[float] = []
    for entry in value if isinstance(value, list) else [value]:
        if isinstance(entry, str):
            try:
                found += [float(word) for word in entry.strip("\0 ").replace(",", " ").split()]
            except ValueError:
                continue
        elif isinstance(entry, int | float) and not isinstance(entry, bool):
            found.append(entry)
    whole = array.dtype.kind in "iu"
    found = [int(n) if whole and isinstance(value, str) and float(n).is_integer() else n for n in found]
    return [_as_viewed(n, array) for n in found]


def _packing(array: Array) -> tuple[float, float]:
    """CF's ``scale_factor`` and ``add_offset``."""
    plain = replace(array, attributes={k: v for k, v in array.attributes.items() if k != "_Unsigned"})
    scale = (_numbers(plain, "scale_factor") or [1.0])[0]
    return (scale if scale != 0.0 else 1.0), (_numbers(plain, "add_offset") or [0.0])[0]


def _unpacked(values: NDArray[Any], array: Array) -> NDArray[Any]:
    return unpacked(values, *_packing(array))
