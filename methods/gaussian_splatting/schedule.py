"""Schedule of a fit of 3DGS."""

from __future__ import annotations

from dataclasses import dataclass

from methods.shared.schedule import Proportional


@dataclass(frozen=True)
class Schedule(Proportional):
    """The published schedule, fitted to a budget.

    Phase boundaries (start and end of growth, SH degrees, end of the learning-rate decay) are the published
    fractions of the budget.

    Attributes:
        sh_degree: final SH degree.
        resets: whether opacities are reset at all.
        early_reset: also reset when growth starts (white background).
    """

    growth = (500, 15_000)
    sh_degree: int = 3
    resets: bool = True
    early_reset: bool = False

    @property
    def reset_interval(self) -> int:
        return self._scaled(3_000)

    def degree(self, iteration: int) -> int:
        """SH degree in use: one more every 1,000 published iterations."""
        return min(self.sh_degree, iteration // self._scaled(1_000))

    def collects(self, iteration: int) -> bool:
        """Whether densification statistics are still needed."""
        return iteration < self.growth_stop

    def prunes_large(self, iteration: int) -> bool:
        """Whether Gaussians that are too large go as well: once resets have begun."""
        return self.resets and iteration > self.reset_interval

    def resets_opacity(self, iteration: int) -> bool:
        if not self.resets or iteration >= self.growth_stop:
            return False
        return iteration % self.reset_interval == 0 or (self.early_reset and iteration == self.growth_start)
