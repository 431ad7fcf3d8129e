"""Schedule of a fit of ECoNGS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from methods.shared.schedule import AnchorSchedule


@dataclass(frozen=True)
class Schedule(AnchorSchedule):
    """The published schedule (two stages of 10,000 iterations), fitted to a budget.

    Attributes:
        iterations: the budget of the whole group, one (scene, view) pair each.
        growth_stop_share: share of the budget after which no anchor grows (the paper leaves it open: half,
            where the context model begins, or three quarters).
        context: whether there is a second stage with the context model.
    """

    published: ClassVar[int] = 20_000
    growth_stop_share: float = 0.5
    context: bool = True

    @property
    def growth_stop(self) -> int:
        return max(1, round(self.growth_stop_share * self.iterations))

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
