"""Schedule of a fit of Scaffold-GS or HAC."""

from __future__ import annotations

from econgs_bench.methods.shared.schedule import AnchorSchedule


class Schedule(AnchorSchedule):
    """The published schedule, fitted to a budget. Iterations count from 1.

    With coding (HAC) there is noise from 3,000 on, the context model from 10,000 on, a pause of growth while
    the noise is new, and rounding in the last twentieth (not in the paper).
    """

    @property
    def rest(self) -> range:
        """Iterations in which nothing grows since the noise is new: none without coding."""
        return super().rest if self.coding else range(0)
