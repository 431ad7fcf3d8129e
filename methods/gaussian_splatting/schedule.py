"""Schedule of a fit of 3DGS."""

from __future__ import annotations

from dataclasses import dataclass

from econgs_bench.methods.shared.schedule import Proportional


@dataclass(frozen=True)
class Schedule(Proportional):
    """The published schedule, fitted to a budget.

    Phase boundaries (start and end of growth, SH degrees, end of the learning-rate decay) are the published
    fractions of the budget.

    Attributes:
        sh_degree: final SH degree.
        resets: whether opacities are reset at all.
        early_reset: also reset when growth starts (white background).
        least_interval: least iterations before the first reset and between two.
    """

    growth = (500, 15_000)
    sh_degree: int = 3
    resets: bool = True
    early_reset: bool = False
    least_interval: int = 0

    @property
    def reset_interval(self) -> int:
        return max(self._scaled(3_000), self.least_interval)

    def degree(self, iteration: int) -> int:
        """SH degree in use: one more every 1,000 published iterations."""
        return min(self.sh_degree, iteration // self._scaled(1_000))

    def collects(self, iteration: int) -> bool:
        """Whether densification statistics are still needed."""
        return iteration < self.growth_stop

    def prunes_large(self, iteration: int) -> bool:
        """Whether Gaussians that are too large go as well: once the first published interval is over."""
        return iteration > self._scaled(3_000)

    def prunes_invisible(self, iteration: int) -> bool:
        """Whether Gaussians that no pixel shows are removed, without growth."""
        return False

    def shaded(self, iteration: int) -> bool:
        """Whether colors are shaded: the second stage of methods that have one."""
        return False

    def resets_opacity(self, iteration: int) -> bool:
        if not self.resets or iteration >= self.growth_stop:
            return False
        early = self.early_reset and self.growth_start >= self.least_interval
        return iteration % self.reset_interval == 0 or (early and iteration == self.growth_start)

    @property
    def settling_start(self) -> int:
        """Iteration up to which :meth:`settled` is 1."""
        return self.last_growth

    def settled(self, iteration: int, last: float) -> float:
        """Factor on learning rates: 1 until nothing grows, from there to ``last`` at the end."""
        rest = Proportional(max(1, self.iterations - self.settling_start), decay=self.decay)
        return rest.decayed(max(0, iteration - self.settling_start), 1.0, last)
