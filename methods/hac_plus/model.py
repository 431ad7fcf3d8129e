"""A trained HAC++ representation: that of HAC, with other streams."""

from __future__ import annotations

from econgs_bench.methods.hac.model import HacModel


class HacPlusModel(HacModel):
    """Scenes as their streams give them back; see :class:`.methods.hac.model.HacModel`."""

    method = "hac-plus"
    suffix = ".hacplus"
