"""Schedule of a fit of 3DGS-MCMC."""

from __future__ import annotations

from dataclasses import dataclass

from econgs_bench.methods.gaussian_splatting import schedule

LEAST_INTERVAL = 10
"""Least number of iterations between relocations: what has just moved must be seen before it is judged."""


@dataclass(frozen=True)
class Schedule(schedule.Schedule):
    """Phases of 3DGS without opacity resets; Gaussians are moved and added for five sixths of the budget."""

    growth = (500, 25_000)
    resets: bool = False

    @property
    def growth_interval(self) -> int:
        """Iterations between relocations: in a short budget fewer, so that there are as many as published.

        Each event adds a twentieth: at the published interval, a short fit would never reach its cap.
        """
        return min(super().growth_interval, max(LEAST_INTERVAL, self._scaled(self.longest_interval)))

    def collects(self, iteration: int) -> bool:
        """Nothing reads the gradients of screen positions."""
        return False
