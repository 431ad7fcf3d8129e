"""Schedule of a fit of Plenoxels."""

from __future__ import annotations

import math
from dataclasses import dataclass

PUBLISHED = 128_000
"""Iterations of the published schedule."""
FINER = 38_400
"""Published iteration after which the grid gets twice the vertices."""
DENSITY_LAST = 0.05 / 30.0
"""Last learning rate of densities / first one, where the decay ends."""
SH_LAST = 5e-6 / 1e-2
DECAY = 250_000
"""Published iterations until then: longer than a fit."""
DELAY = 15_000
"""Published iterations in which the rate of densities rises to its full value."""
DELAYED = 0.01
"""Share of the rate at the beginning of that."""


@dataclass(frozen=True)
class Schedule:
    """The published schedule, all of it in proportion to the budget.

    Attributes:
        iterations: the budget.
    """

    iterations: int

    @property
    def finer(self) -> int:
        """Iteration after which the grid gets finer."""
        return max(1, round(FINER * self.iterations / PUBLISHED))

    def density_learning_rate(self, iteration: int, first: float) -> float:
        """Learning rate of densities at an iteration, from 1."""
        published = iteration * PUBLISHED / self.iterations
        rise = math.sin(0.5 * math.pi * min(1.0, published / DELAY))
        decayed = first * math.pow(DENSITY_LAST, published / DECAY)
        return decayed * (DELAYED + (1.0 - DELAYED) * rise)

    def sh_learning_rate(self, iteration: int, first: float) -> float:
        """Learning rate of SH coefficients at an iteration, from 1."""
        return first * math.pow(SH_LAST, iteration * PUBLISHED / self.iterations / DECAY)
