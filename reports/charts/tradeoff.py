"""Quality against a cost: one chart for all axes, of scenes, means, fronts and ratios."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from econgs_bench.reports.charts.chart import (
    GRAY,
    Axis,
    Chart,
    Panel,
    Series,
    Text,
    broken_axis,
    log_axis,
)
from econgs_bench.reports.charts.levels import with_floor
from econgs_bench.reports.floors import Floor
from econgs_bench.reports.fronts import pareto
from econgs_bench.reports.style import OTHERS, OTHERS_NAME, Look, Model, looks, named

_FEW = 30  # points of a panel

XY = tuple[float, float]
"""Cost and quality, as shown."""


class Spot(NamedTuple):
    """A mark.

    Attributes:
        x, y: cost and quality, as shown.
        name: what it is, where it is pointed at.
        keys: of the rows of the page's table that it stands for.
        size: bytes, which order the marks of a line.
    """

    x: float
    y: float
    name: str = ""
    keys: Sequence[str] = ()
    size: float = 0.0


@dataclass
class TradeoffLine:
    """A model.

    Attributes:
        model: whose, which decides the look.
        means: marks, joined by a line unless there is a ``path``.
        scenes: faint marks without a line.
        path: a line of its own.
        band: outline of a filled area.
        bars: intervals through a mark.
        title: what it is called, if not as its model.
    """

    model: Model
    means: list[Spot] = field(default_factory=list)
    scenes: list[Spot] = field(default_factory=list)
    path: list[XY] = field(default_factory=list)
    band: list[XY] = field(default_factory=list)
    bars: list[list[XY]] = field(default_factory=list)
    title: str = ""

    @property
    def name(self) -> str:
        return self.title or self.model.title


@dataclass
class Tradeoff:
    """A panel.

    Attributes:
        title: dataset and protocol.
        cost: title of the horizontal axis.
        lines: its models.
        better: 1 if a higher x is better, -1 if a lower one is, 0 where there is no front.
        floor: of the truth, mean over the scenes; None where it is not known.
        quality: title of the vertical axis.
        origin: of two lines across the panel; None without.
        x: the horizontal axis, if it is not logarithmic.
        width, height: in pixels; 0: those of every panel.
    """

    title: str
    cost: str
    lines: list[TradeoffLine]
    better: int = -1
    floor: Floor | None = None
    quality: str = "PSNR [dB]"
    origin: XY | None = None
    x: Axis | None = None
    width: float = 0.0
    height: float = 0.0

    @property
    def means(self) -> list[XY]:
        return [spot[:2] for line in self.lines for spot in line.means]

    @property
    def spots(self) -> list[XY]:
        """The means and the scenes."""
        return [spot[:2] for line in self.lines for spot in (*line.means, *line.scenes)]

    @property
    def front(self) -> list[XY]:
        """The means that no other mean is better than in both; empty where there is nothing to compare."""
        return pareto(self.means, self.better) if self.better and len(set(self.means)) > 1 else []

    def dominated(self, edge: float, bottom: float) -> list[XY]:
        """Outline of the region in which everything is worse than some mean.

        Args:
            edge: the worst x that the axis shows.
            bottom: the worst y that it shows.
        """
        corners = self.front
        if not corners:
            return []
        steps = [(corners[0][0], bottom)]
        for (x, y), (after, _) in zip(corners, [*corners[1:], (edge, 0.0)], strict=True):
            steps += [(x, y), (after, y)]
        return [*steps, (edge, bottom)]

    def looks(self, models: list[Model]) -> list[tuple[TradeoffLine, Look]]:
        """The lines with their looks, gray ones first; what is on the Pareto front is never gray."""
        front = set(self.front)
        apart = [line.model for line in self.lines if any(spot[:2] in front for spot in line.means)]
        lines = {line.model: line for line in self.lines}
        styles = looks(lines, models, apart)
        return [(lines[each], style) for each, style in styles.items()]

    def labels(self, models: list[Model]) -> list[Text]:
        """A line's title at its right end; at a scene if it has no mean of its own."""
        labels = []
        own = named(line.model for line in self.lines)
        for line, style in self.looks(models):
            if style is OTHERS:
                continue
            end = max([spot[:2] for spot in line.means or line.scenes] + line.path[-1:])
            # In the color of its method, which is named at another mark.
            text = line.name if line.model in own or line.title else line.model.options or line.name
            text += "" if line.means else " (incomplete)"
            labels.append(Text(*end, text, style.color))
        return labels


def tradeoff_chart(panels: Sequence[Tradeoff], models: list[Model], form: str = ".1f") -> Chart:
    """Quality over a cost (log); the region that the front dominates is shaded.

    Args:
        panels: each a panel.
        models: all of the report.
        form: of the values of floors.
    """
    drawn = [_panel(panel, models, form) for panel in panels]
    gray = any(style is OTHERS for panel in panels for _, style in panel.looks(models))
    return Chart(drawn, {OTHERS_NAME: OTHERS} if gray else {})


def _panel(panel: Tradeoff, models: list[Model], form: str) -> Panel:
    ends = {
        id(line): [spot for bar in (line.path, line.band, *line.bars) for spot in bar] for line in panel.lines
    }
    every = [*panel.spots, *(spot for own in ends.values() for spot in own)]
    heights = [
        [y for _, y in ((spot[:2]) for spot in (*line.means, *line.scenes))] + [y for _, y in ends[id(line)]]
        for line in panel.lines
    ]
    x = panel.x or log_axis([x for x, _ in every], panel.cost)
    y = broken_axis(heights, panel.quality, least=1.0 if panel.origin else 2.0)
    series = _front(panel.dominated(x.low if panel.better > 0 else x.high, y.low))
    if panel.origin is not None:
        across, up = panel.origin
        gray = Look(GRAY, "", "solid")
        series += [Series("", [x.low, x.high], [up, up], gray, line=1.0)]
        series += [Series("", [across, across], [y.low, y.high], gray, line=1.0)]
    for line, look in panel.looks(models):
        series += _series(line, look)
    avoid = panel.spots if len(panel.spots) <= _FEW else panel.means
    labels = panel.labels(models)
    shape = (panel.width, panel.height) if panel.width else ()
    along = any(line.path for line in panel.lines)
    drawn = Panel(panel.title, x, y, series, labels, avoid, along)
    if shape:
        drawn = replace(drawn, width=panel.width, height=panel.height)
    return with_floor(drawn, panel.floor, form)


def _series(line: TradeoffLine, look: Look) -> list[Series]:
    """Band, faint marks, intervals, line and marks of a model."""
    found = []
    plain = Look(look.color, "", "solid")
    if line.band:
        found.append(Series("", *_columns(line.band), plain, fill=True, opacity=0.15))
    if line.scenes:
        dot = Series(line.name, (), (), Look(look.color, "circle", ""), mark=5.0, opacity=0.4)
        found.append(_marks(line.scenes, dot))
    found += [Series("", *_columns(bar), plain, line=1.0) for bar in line.bars]
    if line.path:
        found.append(Series("", *_columns(line.path), look, line=1.6))
    if line.means:
        size = 6.0 if look is OTHERS or line.path else 8.5
        marks = Series(line.name, (), (), look, line=0.0 if line.path else 1.6, mark=size)
        found.append(_marks(line.means, marks))
    return found


def _columns(points: Sequence[XY]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]


def _marks(spots: Sequence[Spot], series: Series) -> Series:
    """A series with these points."""
    x, y, names, keys, _ = zip(*spots, strict=True)
    return replace(series, x=x, y=y, names=names, keys=keys if any(keys) else ())


def _front(outline: list[XY]) -> list[Series]:
    """The region below the Pareto front, and the front."""
    if not outline:
        return []
    x, y = _columns(outline)
    look = Look(GRAY, "", "dash")
    return [Series("", x, y, look, fill=True, opacity=0.13), Series("", x[1:-1], y[1:-1], look, line=1.0)]
