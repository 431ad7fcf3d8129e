"""When boxes shrink and lines grow: published iterations, scaled to the budget."""

from __future__ import annotations

import math
from dataclasses import dataclass

PUBLISHED = 30_000
"""Iterations of the published schedule, to which the following belong."""
GROWTH = (2_000, 3_000, 4_000, 5_500, 7_000)
"""Lines get more rows after these."""
MASKS = (2_000, 4_000)
"""Empty cells are looked for after these, before lines grow."""
_LAST = 0.1
"""What learning rates fall to."""


@dataclass(frozen=True)
class Schedule:
    """The course of a fit; iterations count from 1.

    Attributes:
        iterations: the budget.
        first_side, side: rows of lines of a cube, first and in the end.
        through: learning rates fall to the end of the budget, wherever they start.
        always: empty cells are looked for whenever lines grow.
    """

    iterations: int
    first_side: int
    side: int
    through: bool
    always: bool

    def _scaled(self, published: int) -> int:
        return max(1, round(published * self.iterations / PUBLISHED))

    def masks(self, iteration: int) -> int:
        """How often empty cells have been looked for after this iteration."""
        return sum(iteration >= self._scaled(one) for one in (GROWTH if self.always else MASKS))

    def grows(self, iteration: int) -> bool:
        """Whether lines get more rows after this iteration."""
        return iteration in map(self._scaled, GROWTH)

    def rows(self, iteration: int) -> int:
        """Rows of lines of a cube after this iteration: evenly spaced in their logarithms."""
        done = sum(iteration >= self._scaled(one) for one in GROWTH) / len(GROWTH)
        return round(math.exp((1.0 - done) * math.log(self.first_side) + done * math.log(self.side)))

    def learning_rate_share(self, iteration: int) -> float:
        """Learning rates of an iteration, as a share of the first ones."""
        starts = [0, *(self._scaled(one) for one in GROWTH)]
        last = max(one for one in starts if one < iteration)
        whole = self.iterations - last if self.through else self.iterations
        return float(_LAST ** ((iteration - last) / max(1, whole)))

    def stage(self, iteration: int) -> str:
        """Name of the stage of an iteration, for people."""
        rows = self.rows(iteration - 1)
        return f"{rows} rows" if iteration > self._scaled(MASKS[0]) else f"{rows} rows, whole box"
