"""The charts of the page, as plotly figures in plain JSON."""

from reports.charts.traces.bars import feature_maps, histograms, ledger, timing
from reports.charts.traces.frame import Figure
from reports.charts.traces.lines import anytime, convergence, losses, over
from reports.charts.traces.scatter import rate_curves, tradeoffs

__all__ = [
    "Figure", "anytime", "convergence", "feature_maps", "histograms", "ledger", "losses", "over",
    "rate_curves", "timing", "tradeoffs",
]  # fmt: skip
