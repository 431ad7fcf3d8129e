"""What files of several variables offer, and what is read from them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datasets.errors import DataError
from datasets.names import unknown
from datasets.readers.finish import UNIT, Spacing

_CHUNK = 1 << 24
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Variable:
    """What a file tells of one of its variables before any value is read.

    Attributes:
        name: its name in the file.
        dims: samples along x, y, z; None for a mesh, whose grid depends on the resolution asked for.
        steps: number of time steps.
        components: 1 for scalars. A vector is read as its magnitude; its components are the variables
            ``name.x``, ``name.y``, ``name.z`` (``name.0``, ``name.1``... where there are not three).
    """

    name: str
    dims: tuple[int, int, int] | None
    steps: int = 1
    components: int = 1

    def part(self, component: int) -> str:
        """Name of one of its components."""
        return f"{self.name}.{_AXES[component] if self.components == 3 else component}"


@dataclass(frozen=True)
class Choice:
    """One scalar field of a file.

    Attributes:
        variable: one of the file's.
        component: of a vector; None for the magnitude of a vector and for scalars.
        step: time step, from 0.
        resolution: meshes only: samples along the longest side; None for the default.
    """

    variable: Variable
    component: int | None = None
    step: int = 0
    resolution: int | None = None

    @property
    def name(self) -> str:
        """The variable's name, or that of its component."""
        return self.variable.name if self.component is None else self.variable.part(self.component)


@dataclass(frozen=True, eq=False)
class Field:
    """The values of one choice, not yet checked; attributes as in :class:`datasets.volume.Volume`."""

    values: NDArray[np.generic]
    spacing: Spacing = UNIT
    mask: NDArray[np.bool_] | None = None
    value_range: tuple[float, float] | None = None
    vertices: NDArray[np.float32] | None = None
    vertex_values: NDArray[np.generic] | None = None


class Source(Protocol):
    """An open file of one format."""

    variables: tuple[Variable, ...]

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""


def choose(
    path: Path, variables: Iterable[Variable], name: str | None, step: int | None, resolution: int | None
) -> Choice:
    """The choice that a name, a step and a resolution make.

    Args:
        path: for messages.
        variables: of the file.
        name: of a variable or of a component, exactly or with the characters that
            :func:`plain` replaces; None where the file has one variable only.
        step: None for the first.
        resolution: None for the default.

    Raises:
        UnknownName: no such variable; near matches are listed.
        DataError: several variables and no name, no such step, or a resolution for a grid.
    """
    known: dict[str, tuple[Variable, int | None]] = {}
    for variable in variables:
        if variable.components > 1:
            for i in range(variable.components):
                known.setdefault(variable.part(i), (variable, i))
    for variable in variables:
        known[variable.name] = (variable, None)
    whole = [variable.name for variable in variables]
    if name is None:
        if len(whole) > 1:
            remedy = f"Name one: {', '.join(whole[:20])}"
            raise DataError(path, f"holds {len(whole)} variables", remedy)
        name = whole[0]
    if name not in known:
        same = [k for k in known if plain(k) == plain(name)]
        if not same:
            raise unknown("variable", name, known, of=str(path))
        name = same[0]
    variable, component = known[name]
    if step is not None and not 0 <= step < variable.steps:
        steps = "one time step, 0" if variable.steps == 1 else f"time steps 0 to {variable.steps - 1}"
        raise DataError(path, f"has no time step {step}", f"{variable.name!r} has {steps}")
    if resolution is not None and variable.dims is not None:
        raise DataError(path, "is a grid, which has its own resolution", "Only meshes can be resampled")
    return Choice(variable, component, step or 0, resolution)


def plain(name: str) -> str:
    """A name with letters, digits and ``_.-`` only, for tables and command lines."""
    kept = "".join(c if c.isascii() and (c.isalnum() or c in ".-") else " " for c in name)
    return "_".join(kept.split())


def scalar(values: NDArray[np.generic], component: int | None) -> NDArray[np.generic]:
    """One component (last axis) of an array of vectors, or their magnitudes (float32; float64 of doubles)."""
    if component is not None:
        return values[..., component]
    out = np.empty(values.shape[:-1], np.float64 if values.dtype.itemsize > 4 else np.float32)
    step = max(1, _CHUNK * len(values) // max(values.nbytes, 1))
    for start in range(0, len(values), step):  # part by part: no second copy of all components
        part = values[start : start + step].astype(out.dtype)
        np.sqrt(np.einsum("...c,...c->...", part, part), out=out[start : start + step])
    return out


def need(package: str, path: Path) -> None:
    """Refuse at once where an optional package is missing.

    Raises:
        DataError: it is; the remedy says how to install it.
    """
    if find_spec(package) is None:
        remedy = "Run: pip install 'econgs-bench[io]'"
        raise DataError(path, f"the Python package {package} is needed to read it", remedy)
