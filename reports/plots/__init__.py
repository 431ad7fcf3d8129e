"""The charts of the page, as plotly figures in plain JSON."""

from reports.plots.bars import feature_maps, histograms, ledger, timing
from reports.plots.frame import Figure
from reports.plots.lines import anytime, convergence, losses
from reports.plots.scatter import rate_curves, tradeoffs

__all__ = [
    "Figure", "anytime", "convergence", "feature_maps", "histograms", "ledger", "losses", "rate_curves",
    "timing", "tradeoffs",
]  # fmt: skip
