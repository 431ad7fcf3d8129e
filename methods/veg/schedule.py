"""Schedule of a fit of VEG."""

from __future__ import annotations

from dataclasses import dataclass

from econgs_bench.methods.ivr_gs.schedule import IvrSchedule


@dataclass(frozen=True)
class VegSchedule(IvrSchedule):
    """Both stages as iVR-GS's, with growth to half of the budget.

    No opacity is reset, and neither large nor invisible Gaussians go: another transfer function may show
    them.
    """

    growth = (500, 20_000)
    resets: bool = False

    def prunes_invisible(self, iteration: int) -> bool:
        return False

    def prunes_large(self, iteration: int) -> bool:
        return False
