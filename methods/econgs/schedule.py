"""When things happen in a fit: phase boundaries scale with the budget, intervals do not."""

from __future__ import annotations

import math
from dataclasses import dataclass

PUBLISHED = 20_000
"""Iterations of the published schedule (two stages of 10,000), in which boundaries below are given."""


@dataclass(frozen=True)
class Schedule:
    """The published schedule, fitted to a budget. Iterations count from 1.

    Attributes:
        iterations: the budget of the whole group, one (scene, view) pair each.
        growth_stop_share: share of the budget after which no anchor grows (the paper leaves it open: half,
            where the context model begins, or three quarters).
        context: whether there is a second stage with the context model.
    """

    iterations: int
    growth_stop_share: float = 0.5
    context: bool = True

    def _scaled(self, published: int) -> int:
        return max(1, round(published * self.iterations / PUBLISHED))

    @property
    def growth_start(self) -> int:
        return self._scaled(1_500)

    @property
    def growth_stop(self) -> int:
        return max(1, round(self.growth_stop_share * self.iterations))

    @property
    def noise_start(self) -> int:
        """Attributes are trained under quantisation noise from here on."""
        return self._scaled(3_000)

    @property
    def context_start(self) -> int:
        """The second stage: steps and probabilities by the context model, the rate in the loss."""
        return self._scaled(10_000)

    @property
    def growth_interval(self) -> int:
        """100 iterations as published, fewer where that would leave less than ten growth events."""
        growing = self.growth_stop - self.growth_start - (self._scaled(4_000) - self.noise_start)
        return max(1, min(100, growing // 11))

    def visits(self, published: float) -> float:
        """A number of visits that the paper ties to its growth interval of 100 iterations.

        A fifth of it at least: after fewer views nothing can be judged.
        """
        return published * max(self.growth_interval / 100.0, 0.2)

    def collects(self, iteration: int) -> bool:
        """Whether growth statistics are taken."""
        return self._scaled(500) < iteration < self.growth_stop

    def grows(self, iteration: int) -> bool:
        """Whether a growth event follows; it rests while the noise is new."""
        return (
            self.growth_start < iteration < self.growth_stop
            and not self.noise_start <= iteration < self._scaled(4_000)
            and iteration % self.growth_interval == 0
        )

    def noisy(self, iteration: int) -> bool:
        return self.context and iteration > self.noise_start

    def coded(self, iteration: int) -> bool:
        """Whether it belongs to the second stage."""
        return self.context and iteration > self.context_start

    def exact(self, iteration: int) -> bool:
        """Whether attributes are rounded as the coder will round them: the last tenth of the second stage."""
        return self.coded(iteration) and iteration > self._scaled(19_000)

    def settles_rent(self, iteration: int) -> bool:
        """Whether anchors that add nothing go before this iteration: nothing grows after the first time."""
        begin = max(self.growth_stop, self.context_start if self.context else 0)
        return iteration in (begin + 1, begin + 1 + (self.iterations - begin) // 2)

    def corrects_rate(self, iteration: int, steps: int) -> bool:
        """Whether lambda_e is corrected after this iteration: so many times before rounding begins."""
        every = max(1, (self._scaled(19_000) - self.context_start) // steps)
        return (
            self.coded(iteration)
            and not self.exact(iteration)
            and (iteration - self.context_start) % every == 0
        )

    def stage(self, iteration: int) -> str:
        """Name of the stage, for people."""
        if self.exact(iteration):
            return "rounding"
        if self.coded(iteration):
            return "context model"
        if self.noisy(iteration):
            return "growth under noise" if self.collects(iteration) else "noise"
        return "growth" if self.collects(iteration) else "warm-up"

    def decayed(self, iteration: int, first: float, last: float) -> float:
        """Log-linear decay from ``first`` to ``last`` over the budget."""
        t = min(1.0, iteration / self.iterations)
        return math.exp((1.0 - t) * math.log(first) + t * math.log(last))
