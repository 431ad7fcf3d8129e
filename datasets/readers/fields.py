"""Files of several variables: their contents, a choice among them, and its values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.readers.finish import Spacing
from econgs_bench.datasets.readers.limits import Limits

_CHUNK = 1 << 24
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Variable:
    """One variable of a file, before any value is read.

    Attributes:
        name: its name in the file.
        dims: samples along x, y, z; None for a mesh, whose grid depends on the resolution.
        steps: number of time steps.
        components: 1 for scalars. A vector is read as its magnitude; its components are the variables
            ``name.x``, ``name.y``, ``name.z`` (``name.0``, ``name.1``... where there are not three).
        channels: number of components, the first ones, that are colors or channels of a picture; those after
            them are alpha. 0: the components are those of a vector.
    """

    name: str
    dims: tuple[int, int, int] | None
    steps: int = 1
    components: int = 1
    channels: int = 0

    def part(self, component: int) -> str:
        """Name of one of its components."""
        return f"{self.name}.{_AXES[component] if self.components == 3 else component}"


@dataclass(frozen=True)
class Choice:
    """One scalar field of a file.

    Attributes:
        variable: variable of the file.
        component: component of a vector; None for the magnitude of a vector and for scalars.
        step: time step, from 0.
        resolution: samples along the longest side, for meshes only; None for the default.
        limits: which values are shown.
    """

    variable: Variable
    component: int | None = None
    step: int = 0
    resolution: int | None = None
    limits: Limits = field(default_factory=Limits)

    @property
    def name(self) -> str:
        """The variable's name, or that of its component."""
        return self.variable.name if self.component is None else self.variable.part(self.component)


@dataclass(frozen=True, eq=False)
class Field:
    """The values of one choice; attributes as in :class:`.datasets.volume.Volume`.

    ``spacing`` is None where the file does not say it.
    """

    values: NDArray[np.generic]
    spacing: Spacing | None
    mask: NDArray[np.bool_] | None
    value_range: tuple[float, float]
    whole: tuple[float, float] | None = None
    vertices: NDArray[np.float32] | None = None
    vertex_values: NDArray[np.generic] | None = None


class Source(Protocol):
    """An open file of one format."""

    variables: tuple[Variable, ...]

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""


def choose(
    path: Path,
    variables: Iterable[Variable],
    name: str | None,
    step: int | None,
    resolution: int | None,
    limits: Limits | None = None,
) -> Choice:
    """The choice of a name, a step and a resolution.

    Args:
        path: the file, for messages.
        variables: variables of the file.
        name: name of a variable or a component, as in the file or as :func:`plain` makes it; None for the
            only variable of a file.
        step: None for the first.
        resolution: None for the default.
        limits: which values are shown; None for the default.

    Raises:
        UnknownName: no such variable; the remedy lists near matches.
        DataError: several variables and no name, no such step, or a resolution for a grid.
    """
    parts: dict[str, tuple[Variable, int | None]] = {}
    for variable in variables:
        if variable.components > 1:
            for i in range(variable.components):
                parts.setdefault(variable.part(i), (variable, i))
    for variable in variables:
        parts[variable.name] = (variable, None)
    whole = [variable.name for variable in variables]
    if name is None:
        if len(whole) > 1:
            remedy = f"Name one: {', '.join(whole[:20])}"
            raise DataError(path, f"holds {len(whole)} variables", remedy)
        name = whole[0]
    if name not in parts:
        same = [k for k in parts if plain(k) == plain(name)]
        if not same:
            raise unknown("variable", name, parts, of=str(path))
        name = same[0]
    variable, component = parts[name]
    if step is not None and not 0 <= step < variable.steps:
        steps = "one time step, 0" if variable.steps == 1 else f"time steps 0 to {variable.steps - 1}"
        raise DataError(path, f"has no time step {step}", f"{variable.name!r} has {steps}")
    if resolution is not None and variable.dims is not None:
        raise DataError(path, "is a grid, which has its own resolution", "Only meshes can be resampled")
    return Choice(variable, component, step or 0, resolution, limits or Limits())


def plain(name: str) -> str:
    """A name with letters, digits and ``_.-`` only, for tables and command lines."""
    characters = "".join(c if c.isascii() and (c.isalnum() or c in ".-") else " " for c in name)
    return "_".join(characters.split())


def channels_of(components: int, dtype: np.dtype) -> int:
    """Channels among the components of values without a word on them: unsigned bytes are colors."""
    return 3 if components in (3, 4) and dtype == np.uint8 else 0


def scalar(values: NDArray[np.generic], choice: Choice, path: Path) -> NDArray[np.generic]:
    """Scalars as they are; of vectors a component (last axis) or magnitudes (float32, float64 of doubles).

    Raises:
        DataError: colors that are no shades of gray, and no component is chosen.
    """
    variable = choice.variable
    if variable.components == 1:
        return values
    if choice.component is not None:
        return values[..., choice.component]
    if variable.channels:
        first = values[..., 0]
        for channel in range(1, variable.channels):
            if any(not np.array_equal(a[..., channel], b) for a, b in zip(values, first, strict=True)):
                first_part, *others = (variable.part(i) for i in range(variable.components))
                remedy = f"Choose a channel: {path}:variable={first_part} (or {', '.join(others)})"
                raise DataError(path, f"{variable.name!r} has colors or channels, no single values", remedy)
        return first
    out = np.empty(values.shape[:-1], np.float64 if values.dtype.itemsize > 4 else np.float32)
    step = max(1, _CHUNK * len(values) // max(values.nbytes, 1))
    for start in range(0, len(values), step):  # in parts: no second copy of all components
        part = values[start : start + step].astype(out.dtype)
        np.sqrt(np.einsum("...c,...c->...", part, part), out=out[start : start + step])
    return out
