"""Parts of the procedural fields: positions of one slice, random waves, derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_STEP = 1e-4
"""Step of central differences in scene space, the same at every resolution."""


@dataclass(frozen=True)
class Slice:
    """Positions in scene space of the samples at one depth: x (nx,), y (ny,) and z; pictures are (ny, nx)."""

    x: Array
    y: Array
    z: float

    def shift(self, axis: int, by: float) -> Slice:
        """The slice at positions shifted along x, y or z."""
        shift = [by if axis == i else 0.0 for i in range(3)]
        return Slice(self.x + shift[0], self.y + shift[1], self.z + shift[2])

    @property
    def columns(self) -> Array:
        """(1, nx) x positions, for broadcasting."""
        return self.x[None, :]

    @property
    def rows(self) -> Array:
        """(ny, 1) y positions, for broadcasting."""
        return self.y[:, None]


Scalar = Callable[[Slice], Array]


class Waves:
    """A random field of plane waves with unit variance, evaluated as a product of one factor per axis.

    Args:
        seed: seed of directions, lengths and phases.
        low, high: shortest and longest wave vector, in periods per longest side.
        slope: amplitudes fall as length ** -slope.
        count: number of waves.
    """

    def __init__(
        self, seed: int, low: float, high: float, slope: float = 11.0 / 6.0, count: int = 128
    ) -> None:
        generator = np.random.default_rng(seed)
        direction = generator.standard_normal((count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = low * (high / low) ** generator.uniform(size=(count, 1))  # as many in each octave
        self.vectors = 2.0 * np.pi * direction * length
        # As many waves in each octave: a factor length^1.5 makes the variance that of a shell of modes.
        amplitude = length[:, 0] ** (1.5 - slope)
        self.amplitudes = amplitude / np.sqrt(0.5 * np.sum(amplitude**2))
        self.phases = generator.uniform(0.0, 2.0 * np.pi, count)

    def __call__(self, at: Slice) -> Array:
        """(ny, nx) values."""
        across = self.vectors[:, 0] * at.x[:, None]
        along = self.vectors[:, 1] * at.y[:, None] + (self.vectors[:, 2] * at.z + self.phases)
        rows = np.concatenate([np.cos(along), -np.sin(along)], axis=1) * np.tile(self.amplitudes, 2)
        return np.asarray(rows @ np.concatenate([np.cos(across), np.sin(across)], axis=1).T)


def gradient(field: Scalar, at: Slice) -> tuple[Array, Array, Array]:
    """Derivatives along x, y, z by central differences of a fixed small step."""

    def along(axis: int) -> Array:
        return np.asarray((field(at.shift(axis, _STEP)) - field(at.shift(axis, -_STEP))) / (2.0 * _STEP))

    return along(0), along(1), along(2)


def smoothstep(value: Array, low: float, high: float) -> Array:
    """0 below ``low``, 1 above ``high``, with continuous slope."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def vector(seed: int, low: float, high: float, slope: float = 11.0 / 6.0) -> tuple[Waves, Waves, Waves]:
    """Three independent random fields: the components of a vector field."""
    return tuple(Waves(seed * 31 + i, low, high, slope) for i in range(3))  # type: ignore[return-value]
