"""Schedule of a fit of VEG."""

from __future__ import annotations

from dataclasses import dataclass

from econgs_bench.methods.ivr_gs.schedule import IvrSchedule


@dataclass(frozen=True)
class VegSchedule(IvrSchedule):
    """Both stages as iVR-GS's, with growth to half of the budget and without resets of opacities."""

    growth = (500, 20_000)
    resets: bool = False
