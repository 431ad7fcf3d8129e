"""Formats of one unnamed field, with or without time steps: raw, ``.npy``, NRRD and NIfTI."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.readers.fields import Choice, Field, Variable, scalar
from econgs_bench.datasets.readers.finish import Spacing
from econgs_bench.datasets.readers.limits import Limits


class Single:
    """An open file of one field.

    Args:
        path: the file, for messages.
        variable: its field, named "value".
        load: step, from 0 -> values (nz, ny, nx), or (nz, ny, nx, components).
        spacing: sample distances along x, y, z; None where the file does not say them.
        limits: which values the file itself says are shown.
    """

    def __init__(
        self,
        path: Path,
        variable: Variable,
        load: Callable[[int], NDArray[np.generic]],
        spacing: Spacing | None,
        limits: Limits | None = None,
    ) -> None:
        self.path, self.limits = path, limits or Limits()
        self.variables: tuple[Variable, ...] = (variable,)
        self._load, self._spacing = load, spacing

    @property
    def plain(self) -> bool:
        """Whether there is nothing to choose: one scalar at one time."""
        return self.variables[0].steps == 1 and self.variables[0].components == 1

    def read(self, choice: Choice) -> Field:
        """The values of one choice."""
        from econgs_bench.datasets.readers.axes import place

        values = scalar(self._load(choice.step), choice, self.path)
        return replace(place(values, (None, None, None), self.path, choice.limits), spacing=self._spacing)
