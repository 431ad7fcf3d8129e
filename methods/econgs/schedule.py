"""Schedule of a fit of ECoNGS."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from econgs_bench.methods.shared.schedule import AnchorSchedule


@dataclass(frozen=True)
class Schedule(AnchorSchedule):
    """The published schedule, 20,000 iterations, fitted to a budget.

    Attributes:
        iterations: the budget of the whole group, one (scene, view) pair each.
        coding: whether there is a second stage with the context model.
        growth_stop_share: share of the budget after which no anchor grows (the paper leaves it open: half,
            where the context model begins, or three quarters).
        context_share: share of the budget after which the second stage begins (published: half).
        rounding_share: share of the budget, at its end, with rounded attributes.
        growth_pauses: whether nothing grows while the noise is new (HAC).
    """

    published: ClassVar[int] = 20_000
    coding: bool = True
    growth_stop_share: float = 0.5
    context_share: float = field(default=0.5, kw_only=True)
    rounding_share: float = 0.05
    growth_pauses: bool = True

    @property
    def growth_stop(self) -> int:
        return max(1, round(self.growth_stop_share * self.iterations))

    @property
    def rounding_start(self) -> int:
        return self._scaled(round((1.0 - self.rounding_share) * self.published))

    @property
    def rest(self) -> range:
        return super().rest if self.growth_pauses else range(0)

    def corrects_rate(self, iteration: int, steps: int) -> bool:
        """Whether lambda_e is corrected after this iteration: so many times before rounding begins."""
        every = max(1, (self.rounding_start - self.context_start) // steps)
        return (
            self.coded(iteration)
            and not self.exact(iteration)
            and (iteration - self.context_start) % every == 0
        )
