"""The charts as matplotlib figures, for papers: PDF and PNG."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from reports.charts import data, features, rate_distortion, stability, training
from reports.charts.figures.bars import feature_maps, histograms, ledger, timing
from reports.charts.figures.frame import style
from reports.charts.figures.lines import anytime, convergence, losses, over
from reports.charts.figures.scatter import rate_curves, tradeoff
from reports.style import series

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = [
    "anytime", "convergence", "feature_maps", "figures", "histograms", "ledger", "losses", "over",
    "rate_curves", "timing", "tradeoff", "write",
]  # fmt: skip
_TRADEOFFS = {
    "size": "size_bytes",
    "fps": "fps",
    "time": "train_seconds",
    "memory": "peak_host_bytes",
    "device-memory": "peak_device_bytes",
}


def figures(tables: dict[str, pd.DataFrame]) -> dict[str, Callable[[], Figure]]:
    """File name -> what draws it, for all charts that have data.

    Args:
        tables: results, curve, ledger, timing and features as documented in docs/concepts/architecture.md.
    """
    results, curve = tables["results"], tables["curve"]
    names = series(results, curve)
    wanted: dict[str, Callable[[], Figure]] = {}
    if rate_distortion.drawn(rate_distortion.curves(results)):
        wanted["rate-distortion"] = lambda: rate_curves(results)
    for short, against in _TRADEOFFS.items():
        if data.tradeoff(results, against):
            wanted[f"psnr-{short}"] = lambda against=against: tradeoff(results, against)  # type: ignore[misc]
    for short, what in (("psnr", "psnr"), ("size", "bytes_estimate")):
        if training.anytime(curve, results, what):
            wanted[f"anytime-{short}"] = lambda what=what: anytime(curve, results, what, names)  # type: ignore[misc]
    for short, against in (("seconds", "train_seconds"), ("iterations", "iteration")):
        if training.convergence(curve, against):
            wanted[f"convergence-{short}"] = lambda against=against: convergence(curve, against, names)  # type: ignore[misc]
    if panels := stability.few_views(results):
        wanted["few-views"] = partial(over, panels, "training views", "PSNR [dB]", names, log_y=False)
    for what, title in stability.COMPLEXITY.items():
        if panels := stability.by_complexity(results, what):
            wanted[f"complexity-{what.split('_')[0]}"] = partial(
                over, panels, "number of parts", title, names, log_y=what != "psnr"
            )
    if panels_of_losses := training.losses(tables):
        wanted["losses"] = lambda: losses(panels_of_losses)
    if features.histograms(tables["features"]):
        wanted["attributes"] = lambda: histograms(tables["features"], names)
    if data.timing(tables["timing"])[0]:
        wanted["timing"] = lambda: timing(tables["timing"])
    if data.ledger(tables["ledger"])[0]:
        wanted["ledger"] = lambda: ledger(tables["ledger"])
    return wanted


def write(tables: dict[str, pd.DataFrame], folder: Path) -> list[Path]:
    """Write all charts that have data as PDF and PNG; returns the PNG paths."""
    wanted = figures(tables)
    try:
        if maps := features.maps(tables["features"]):
            wanted["features-umap"] = lambda: feature_maps(maps)
    except features.Missing:
        pass  # the page tells why
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, draw in wanted.items():
        figure = draw()
        with style():  # resolution and font embedding are decided when saving
            figure.savefig(folder / f"{name}.pdf", metadata={"CreationDate": None})
            figure.savefig(folder / f"{name}.png")
        written.append(folder / f"{name}.png")
    return written
