"""Base classes of schedules: phase boundaries scale with the budget, intervals do not."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

Decay = Literal["linear", "exponential"]


@dataclass(frozen=True)
class Proportional:
    """A published schedule, fitted to a budget. Iterations count from 1.

    Attributes:
        iterations: the budget.
        decay: how learning rates go from the first to the last value.
        published: that of the published schedule.
        growth: published iterations between which primitives grow.
        longest_interval: published number of iterations from one growth event to the next.
    """

    iterations: int
    decay: Decay = field(default="exponential", kw_only=True)
    published: ClassVar[int] = 30_000
    growth: ClassVar[tuple[int, int]]
    longest_interval: ClassVar[int] = 100

    def _scaled(self, published: int) -> int:
        return max(1, round(published * self.iterations / self.published))

    def decayed(self, iteration: int, first: float, last: float) -> float:
        """From ``first`` to ``last`` over the budget."""
        t = min(1.0, iteration / self.iterations)
        if self.decay == "linear":
            return (1.0 - t) * first + t * last
        return math.exp((1.0 - t) * math.log(first) + t * math.log(last))

    @property
    def rest(self) -> range:
        """Iterations in which nothing grows."""
        return range(0)

    @property
    def growth_start(self) -> int:
        return self._scaled(self.growth[0])

    @property
    def growth_stop(self) -> int:
        return self._scaled(self.growth[1])

    @property
    def growth_interval(self) -> int:
        """Iterations between growth events: as published, fewer where that would leave less than ten."""
        free = self.growth_stop - self.growth_start - len(self.rest)
        return max(1, min(self.longest_interval, free // 11))

    @property
    def last_growth(self) -> int:
        """Iteration after which nothing grows."""
        return self.growth_stop

    def prunes_by_contribution(self, iteration: int) -> bool:
        """Whether primitives that add least go before this iteration (:mod:`.methods.shared.pruning`).

        Once growth has ended, and half-way from there to the end.
        """
        begin = self.last_growth
        return iteration in (begin + 1, begin + 1 + (self.iterations - begin) // 2)

    def grows(self, iteration: int) -> bool:
        """Whether a growth event follows."""
        growing = self.growth_start < iteration < self.growth_stop
        return growing and iteration not in self.rest and iteration % self.growth_interval == 0


@dataclass(frozen=True)
class AnchorSchedule(Proportional):
    """Base class of the schedules of anchors: Scaffold-GS, HAC, ECoNGS.

    Attributes:
        coding: whether attributes are quantised and coded: trained under noise, then with the context model.
        context_share: share of the budget after which the context model begins (published for HAC: a third).
    """

    growth = (1_500, 15_000)
    coding: bool = False
    context_share: float = field(default=1 / 3, kw_only=True)

    @property
    def last_growth(self) -> int:
        """Iteration after which nothing grows and, where attributes are coded, the context model is there."""
        return max(self.growth_stop, self.context_start if self.coding else 0)

    @property
    def noise_start(self) -> int:
        """Attributes are trained under quantisation noise from here on, where they are quantised."""
        return self._scaled(3_000)

    @property
    def context_start(self) -> int:
        """From here on steps and probabilities come from the context model, and bits count."""
        return max(1, round(self.context_share * self.iterations))

    @property
    def rest(self) -> range:
        """Iterations in which nothing grows since the noise is new."""
        return range(self.noise_start, self._scaled(4_000))

    def visits(self, published: float) -> float:
        """A number of visits that was published for a growth interval of 100 iterations.

        A fifth of it at least: after fewer views nothing can be judged.
        """
        return published * max(self.growth_interval / 100.0, 0.2)

    def collects(self, iteration: int) -> bool:
        """Whether growth statistics are taken."""
        return self._scaled(500) < iteration < self.growth_stop

    def noisy(self, iteration: int) -> bool:
        """Whether attributes carry quantisation noise."""
        return self.coding and iteration > self.noise_start

    def coded(self, iteration: int) -> bool:
        """Whether steps and probabilities come from the context model, and bits count."""
        return self.coding and iteration > self.context_start

    @property
    def rounding_start(self) -> int:
        """Attributes are rounded as the coder will round them from here on: in the last twentieth."""
        return self._scaled(round(0.95 * self.published))

    def exact(self, iteration: int) -> bool:
        """Whether attributes are rounded as the coder will round them."""
        return self.coded(iteration) and iteration > self.rounding_start

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
