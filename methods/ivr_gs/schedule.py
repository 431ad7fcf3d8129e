"""Schedule of a fit of iVR-GS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from econgs_bench.methods.gaussian_splatting.schedule import Schedule

SHADED = 30_000


@dataclass(frozen=True)
class IvrSchedule(Schedule):
    """Both stages: spherical harmonics with normals, then Blinn-Phong attributes.

    Attributes:
        grows_shaded: whether Gaussians also grow in the first part of the second stage.
    """

    published: ClassVar[int] = 40_000
    growth = (500, 10_000)
    longest_interval: ClassVar[int] = 500
    grows_shaded: bool = True

    @property
    def shading_start(self) -> int:
        """Last iteration of the first stage."""
        return min(self.iterations, self._scaled(SHADED))

    @property
    def shaded_interval(self) -> int:
        """Between events of growth, then of pruning, in the second stage."""
        return max(1, min(100, self._scaled(2_000) // 3))

    def shaded(self, iteration: int) -> bool:
        return iteration > self.shading_start

    @property
    def _second_stop(self) -> int:
        """Iteration from which nothing grows in the second stage."""
        return self.shading_start + self._scaled(2_000)

    @property
    def last_growth(self) -> int:
        """Iteration after which nothing grows."""
        return min(self.iterations, self._second_stop) if self.grows_shaded else self.growth_stop

    def _grows_again(self, iteration: int) -> bool:
        return self.grows_shaded and self.shading_start < iteration < self._second_stop

    def collects(self, iteration: int) -> bool:
        """Whether densification statistics are needed."""
        return iteration < self.growth_stop or self._grows_again(iteration)

    def grows(self, iteration: int) -> bool:
        """Whether Gaussians are cloned, split and pruned."""
        if self._grows_again(iteration):
            return (iteration - self.shading_start) % self.shaded_interval == 0
        return super().grows(iteration)

    def prunes_invisible(self, iteration: int) -> bool:
        if iteration < self.growth_stop or self._grows_again(iteration):
            return False
        interval = self.shaded_interval if self.shaded(iteration) else self.growth_interval
        return iteration % interval == 0

    def prunes_large(self, iteration: int) -> bool:
        """Whether Gaussians that are too large go as well: in the first stage alone."""
        return not self.shaded(iteration) and super().prunes_large(iteration)

    @property
    def settling_start(self) -> int:
        """Iteration up to which :meth:`settled` is 1: one of the second stage."""
        return max(self.shading_start, self.last_growth)

    def decayed(self, iteration: int, first: float, last: float) -> float:
        """From ``first`` to ``last`` over the first stage; ``last`` in the second."""
        whole = self.shading_start / self.iterations
        return super().decayed(min(self.iterations, round(iteration / whole)), first, last)
