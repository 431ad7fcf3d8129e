"""When things happen in a fit of Scaffold-GS or HAC: boundaries scale with the budget, intervals do not."""

from __future__ import annotations

import math
from dataclasses import dataclass

PUBLISHED = 30_000
"""Iterations of the published schedules, in which boundaries below are given."""


@dataclass(frozen=True)
class Schedule:
    """The published schedule, fitted to a budget. Iterations count from 1.

    Attributes:
        iterations: the budget.
        coding: whether attributes are quantised and coded (HAC): noise from 3,000 on, the context model from
            10,000 on, a pause of growth while the noise is new.
    """

    iterations: int
    coding: bool = False

    def _scaled(self, published: int) -> int:
        return max(1, round(published * self.iterations / PUBLISHED))

    @property
    def growth_start(self) -> int:
        return self._scaled(1_500)

    @property
    def growth_stop(self) -> int:
        return self._scaled(15_000)

    @property
    def noise_start(self) -> int:
        return self._scaled(3_000)

    @property
    def context_start(self) -> int:
        return self._scaled(10_000)

    @property
    def growth_interval(self) -> int:
        """100 iterations as published, fewer where that would leave less than ten growth events."""
        pause = self._scaled(4_000) - self.noise_start if self.coding else 0
        return max(1, min(100, (self.growth_stop - self.growth_start - pause) // 11))

    def visits(self, published: float) -> float:
        """A number of visits that was published for a growth interval of 100 iterations; a fifth at least."""
        return published * max(self.growth_interval / 100.0, 0.2)

    def collects(self, iteration: int) -> bool:
        """Whether growth statistics are taken."""
        return self._scaled(500) < iteration < self.growth_stop

    def grows(self, iteration: int) -> bool:
        """Whether a growth event follows."""
        paused = self.coding and self.noise_start <= iteration < self._scaled(4_000)
        growing = self.growth_start < iteration < self.growth_stop
        return growing and not paused and iteration % self.growth_interval == 0

    def noisy(self, iteration: int) -> bool:
        """Whether attributes carry quantisation noise."""
        return self.coding and iteration > self.noise_start

    def coded(self, iteration: int) -> bool:
        """Whether steps and probabilities come from the context model, and the rate counts."""
        return self.coding and iteration > self.context_start

    def exact(self, iteration: int) -> bool:
        """Whether attributes are rounded as the coder will round them: the last twentieth (not in HAC)."""
        return self.coded(iteration) and iteration > self._scaled(28_500)

    def stage(self, iteration: int) -> str:
        """Name of the stage, for people."""
        growth = "growth" if self.collects(iteration) else ""
        if self.exact(iteration):
            return "rounding"
        if self.coded(iteration):
            return "growth with context model" if growth else "context model"
        if self.noisy(iteration):
            return "growth under noise" if growth else "noise"
        return growth or ("refinement" if iteration >= self.growth_stop else "warm-up")

    def decayed(self, iteration: int, first: float, last: float) -> float:
        """Log-linear decay from ``first`` to ``last`` over the budget."""
        t = min(1.0, iteration / self.iterations)
        return math.exp((1.0 - t) * math.log(first) + t * math.log(last))
