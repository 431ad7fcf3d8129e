"""The charts as matplotlib figures, for papers: PDF and PNG."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reports import data
from reports.style import PARTS, color, linear_range, log_range, log_ticks, mib, place_labels, series

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKERS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "triangle-down": "v",
    "star": "*",
    "x": "X",
    "cross": "P",
}
_RC: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.edgecolor": "#666666",
    "pdf.fonttype": 42,
    "savefig.dpi": 200,
    "figure.dpi": 100,
    "legend.frameon": False,
}


@contextmanager
def _style() -> Iterator[None]:
    import matplotlib

    with matplotlib.rc_context(_RC):
        yield


def _figure(columns: int, width: float = 4.6, height: float = 3.6) -> tuple[Figure, list[Axes]]:
    """Axes side by side; no pyplot, so nothing global is touched and no display is needed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, [figure.add_subplot(1, columns, i + 1) for i in range(columns)]


def _settle(figure: Figure) -> None:
    """Lay the axes out once; saving would otherwise do it again for each format."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")


def tradeoff(results: pd.DataFrame, against: str) -> Figure:
    """PSNR against size, FPS or training time (log), one panel per dataset.

    Args:
        results: the documented table.
        against: "size_bytes", "fps" or "train_seconds".
    """
    import matplotlib.ticker as ticker

    from reports.style import marker

    names = series(results)
    panels = data.tradeoff(results, against)
    with _style():
        figure, axes = _figure(max(1, len(panels)))
        if not panels:
            axes[0].text(0.5, 0.5, "nothing measured", ha="center", va="center", transform=axes[0].transAxes)
        for axis, panel in zip(axes, panels, strict=False):
            axis.set_xscale("log")
            low, high = log_range(panel.all_x)
            axis.set_xlim(10**low, 10**high)
            axis.set_ylim(*linear_range(panel.all_y, 2.0))
            ticks = log_ticks(low, high)
            axis.set_xticks([value for value, _ in ticks], [text for _, text in ticks])
            axis.xaxis.set_minor_locator(ticker.NullLocator())
            for line in panel.lines:
                shade = color(line.name, names)
                axis.scatter(line.scene_x, line.scene_y, s=14, color=shade, alpha=0.35, linewidths=0)
                symbol = _MARKERS[marker(line.name, names)]
                axis.plot(line.x, line.y, "-", marker=symbol, color=shade, markersize=6.5, linewidth=1.3)
            axis.set_title(panel.dataset, loc="left", fontweight="bold")
            axis.set_xlabel(data.AXIS[against].title)
            axis.set_ylabel("PSNR [dB]")
        _settle(figure)
        for axis, panel in zip(axes, panels, strict=False):
            _annotate(axis, panel.labels(), list(zip(panel.all_x, panel.all_y, strict=True)), names)
    return figure


def _annotate(
    axis: Axes,
    labels: list[tuple[float, float, str, str]],
    avoid: list[tuple[float, float]],
    names: list[str],
) -> None:
    """Write each text (x, y, text, series) beside its point, in points of 1/72 inch."""
    scale = 72.0 / axis.figure.dpi
    box = axis.get_window_extent()

    def place(x: float, y: float) -> tuple[float, float]:
        px, py = axis.transData.transform((x, y))
        return (px - box.x0) * scale, (py - box.y0) * scale

    spots = [place(x, y) for x, y, _, _ in labels]
    texts = [text for _, _, text, _ in labels]
    around = [place(x, y) for x, y in avoid]
    size = (box.width * scale, box.height * scale)
    places = place_labels(spots, texts, *size, avoid=around, char=4.9, line=11.0)
    for (x, y, text, name), spot in zip(labels, places, strict=True):
        axis.annotate(
            text,
            (x, y),
            (spot.dx * 0.8, spot.dy),
            textcoords="offset points",
            ha=spot.anchor,
            va="center",
            color=color(name, names),
            fontsize=8,
        )


def convergence(
    curve: pd.DataFrame, against: str = "train_seconds", names: list[str] | None = None
) -> Figure:
    """Validation PSNR over training seconds or iterations; a panel per dataset, a line per fitted scene."""
    names = names or series(curve)  # the colors of the whole report, if it is part of one
    panels = data.convergence(curve, against)
    with _style():
        figure, axes = _figure(max(1, len(panels)))
        for axis, (dataset, lines) in zip(axes, panels.items(), strict=False):
            for line in lines:
                axis.plot(line.x, line.y, "-o", color=color(line.name, names), markersize=2.5, linewidth=1.2)
            axis.margins(x=0.02, y=0.08)
            left, right = axis.get_xlim()
            axis.set_xlim(left, right + 0.3 * (right - left))  # room for the labels at the ends
            axis.set_title(dataset, loc="left", fontweight="bold")
            axis.set_xlabel(data.CURVE_AXIS[against])
            axis.set_ylabel("validation PSNR [dB]")
        _settle(figure)
        for axis, lines in zip(axes, panels.values(), strict=False):
            ends = [(line.x[-1], line.y[-1], line.title, line.name) for line in lines]
            _annotate(axis, ends, [], names)
    return figure


def ledger(table: pd.DataFrame) -> Figure:
    """Share of the bytes by part, a stacked bar per dataset and method with its total."""
    bars, parts = data.ledger(table)
    with _style():
        columns = 4  # of the legend, which stands below the bars
        height = 0.8 + 0.34 * max(1, len(bars)) + 0.22 * -(-len(parts) // columns)
        longest = max((len(bar.title) for bar in bars), default=0)
        figure, (axis,) = _figure(1, 7.2 + 0.07 * max(0, longest - 45), height)
        left = [0.0] * len(bars)
        for i, part in enumerate(parts):
            widths = [bar.percent(part) for bar in bars]
            axis.barh(
                [bar.title for bar in bars],
                widths,
                left=left,
                color=PARTS[i % len(PARTS)],
                label=part,
                height=0.62,
            )
            left = [a + b for a, b in zip(left, widths, strict=True)]
        for i, bar in enumerate(bars):
            axis.text(101, i, f"{mib(bar.total)} MiB", va="center", fontsize=8)
        axis.set_xlim(0, 118)
        axis.set_xticks(range(0, 101, 20))
        axis.set_ylim(len(bars) - 0.4, -0.6)
        axis.grid(axis="y", visible=False)
        axis.set_xlabel("share of size [%]")
        if parts:
            figure.legend(loc="outside lower center", ncols=columns)
        _settle(figure)
    return figure


def write(tables: dict[str, pd.DataFrame], folder: Path) -> list[Path]:
    """Write all charts that have data as PDF and PNG; returns the PNG paths."""
    results, curve, parts = tables["results"], tables["curve"], tables["ledger"]
    names = series(results, curve)
    wanted: dict[str, Callable[[], Figure]] = {
        f"psnr-{short}": lambda against=against: tradeoff(results, against)  # type: ignore[misc]
        for short, against in (("size", "size_bytes"), ("fps", "fps"), ("time", "train_seconds"))
        if data.tradeoff(results, against)
    }
    for short, against in (("seconds", "train_seconds"), ("iterations", "iteration")):
        if data.convergence(curve, against):
            wanted[f"convergence-{short}"] = lambda against=against: convergence(curve, against, names)  # type: ignore[misc]
    if data.ledger(parts)[0]:
        wanted["ledger"] = lambda: ledger(parts)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, draw in wanted.items():
        figure: Any = draw()
        with _style():  # resolution and font embedding are decided when saving
            figure.savefig(folder / f"{name}.pdf", metadata={"CreationDate": None})
            figure.savefig(folder / f"{name}.png")
        written.append(folder / f"{name}.png")
    return written
