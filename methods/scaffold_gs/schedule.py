"""Schedule of a fit of Scaffold-GS or HAC."""

from __future__ import annotations

from dataclasses import dataclass

from methods.shared.schedule import AnchorSchedule


@dataclass(frozen=True)
class Schedule(AnchorSchedule):
    """The published schedule, fitted to a budget. Iterations count from 1.

    Attributes:
        coding: whether attributes are quantised and coded (HAC): noise from 3,000 on, the context model from
            10,000 on, a pause of growth while the noise is new.
    """

    coding: bool = False

    @property
    def rest(self) -> range:
        """Iterations in which nothing grows since the noise is new: none without coding."""
        return super().rest if self.coding else range(0)

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
