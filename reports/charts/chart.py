"""A chart as a value: panels with axes, series and labels, which :mod:`.reports.charts.svg` draws."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from econgs_bench.reports.charts.labels import Label, place_labels, text_width
from econgs_bench.reports.style import Look

WIDTH, HEIGHT = 380.0, 310.0
"""Size of a panel in pixels, axes and titles included."""
INK, GRAY = "#222222", "#888888"
"""Colors of text, and of what is no series."""
_TOP, _RIGHT, _BOTTOM, _ABOVE = 8.0, 10.0, 44.0, 24.0
MOST_LABELS = 10
"""More series than this are named by a legend and when pointed at."""
_LEVEL = 14.0
"""Pixels of the line of text that names a level."""
_MOST_ROOM = 0.35
_STEPS = 40
"""Points along a line that labels keep clear of."""
_THIN = 1.0 / 6.0
"""A group of values within this share of an axis looks like a line."""
_FAR = 2.0
"""Values are far where they reach beyond the others by so many times the others' range."""
_OUTER = 0.25
"""Share of an axis for the far values at one of its ends."""


@dataclass(frozen=True)
class Axis:
    """One of two axes.

    Attributes:
        title: with the unit in brackets.
        low, high: values at the ends; ``low`` above ``high`` turns the axis around.
        log: whether it is logarithmic.
        ticks: (value, text).
        grid: whether a line crosses the panel at each tick.
        above: whether the texts of a horizontal axis are above the panel.
        links: text of a tick -> id of a place on the page.
        bends: (value, share) between the ends of a linear axis, upwards, where its scale changes.
    """

    title: str
    low: float
    high: float
    log: bool = False
    ticks: tuple[tuple[float, str], ...] = ()
    grid: bool = True
    above: bool = False
    links: Mapping[str, str] = field(default_factory=dict)
    bends: tuple[tuple[float, float], ...] = ()

    def holds(self, value: float) -> bool:
        """Whether a value is between the ends."""
        return min(self.low, self.high) <= value <= max(self.low, self.high)

    @property
    def unit(self) -> str:
        """The unit of the title, or ""."""
        return self.title.partition("[")[2].partition("]")[0]

    def share(self, value: float) -> float:
        """Position of a value, 0 at the low end and 1 at the high one."""
        if self.log:
            return math.log10(value / self.low) / math.log10(self.high / self.low)
        ends = [(self.low, 0.0), *self.bends, (self.high, 1.0)]
        place = sum(value > end for end, _ in self.bends)
        (low, before), (high, after) = ends[place : place + 2]
        return before + (after - before) * (value - low) / (high - low)

    @property
    def remarks(self) -> list[tuple[float, bool, str]]:
        """Of each bend its value, whether the compressed part is above it, and how much it is compressed."""
        ends = [(self.low, 0.0), *self.bends, (self.high, 1.0)]
        scales = [(b - a) / (after - before) for (a, before), (b, after) in pairwise(ends)]
        notes = []
        for (value, _), (below, above) in zip(self.bends, pairwise(scales), strict=True):
            upper = above > below
            times = max(above, below) / min(above, below)
            where = "above" if upper else "below"
            notes.append((value, upper, f"{where}: compressed {times:.0f} \N{MULTIPLICATION SIGN}"))
        return notes


def log_axis(values: Sequence[float], title: str, *, room: float = 0.0) -> Axis:
    """A logarithmic axis that holds all values with a margin.

    Args:
        values: positive.
        title: of the axis.
        room: share of the axis to keep free above the highest value, if that exceeds the margin.
    """
    logs = [math.log10(value) for value in values if value > 0] or [0.0]
    low, high = min(logs), max(logs)
    margin = max(0.4, 0.22 * (high - low))
    low -= margin
    high = max(high + margin, low + (high - low) / (1.0 - room))
    return Axis(title, 10**low, 10**high, True, tuple(_log_ticks(low, high)))


def linear_axis(
    values: Sequence[float], title: str, *, least: float = 0.0, room: float = 0.0, start: float | None = None
) -> Axis:
    """A linear axis that holds all values with a margin.

    Args:
        values: any.
        title: of the axis.
        least: the least difference between its ends.
        room: share of the axis to keep free above the highest value.
        start: its low end; then the margin is but a little above the highest value.
    """
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    if start is None:
        margin = max(0.12 * (high - low), (least - (high - low)) / 2) or 0.5
        low, high = low - margin, high + margin
    else:
        low = start
        high = low + 1.03 * (high - low) if high > low else low + 1.0
    high = low + (high - low) / (1.0 - room)
    return Axis(title, low, high, False, tuple(_ticks(low, high)))


def broken_axis(groups: Sequence[Sequence[float]], title: str, *, least: float = 0.0) -> Axis:
    """A linear axis that holds all values; far ones are compressed where they would press others into a line.

    Of the groups that span little of the axis, the shortest range with more than half of them is the bulk, if
    half of all groups reach into it. With half of itself at both sides it has its own scale, at least half of
    the axis, where the other values reach beyond it by more than twice its length. All values are drawn.
    Groups that span more and lie beside the bulk are not compressed for single values.

    Args:
        groups: values of each model.
        title: of the axis.
        least: the least difference between its ends.
    """
    values = [value for group in groups for value in group]
    bulk = _bulk(groups)
    if bulk is None:
        return linear_axis(values, title, least=least)
    lowest, highest = min(values), max(values)
    room = max(bulk[1] - bulk[0], least) / 2
    low, high = max(lowest, bulk[0] - room), min(highest, bulk[1] + room)
    far = _FAR * (high - low)
    under, over = low - lowest > far, highest - high > far
    if not (under or over):
        return linear_axis(values, title, least=least)
    low, high = low if under else lowest, high if over else highest
    start, end = (_OUTER if under else 0.0), (1.0 - _OUTER if over else 1.0)
    bottom = low - 1.12 * (low - lowest) if under else low - 0.12 * (high - low)
    top = high + 1.12 * (highest - high) if over else high + 0.12 * (high - low)
    bends = [(low, start)] * under + [(high, end)] * over
    ticks = list(_ticks(low if under else bottom, high if over else top))
    # Not beside the ticks of the bulk.
    ticks += _ticks(bottom, low - 0.2 * (low - bottom), 3.0) if under else ()
    ticks += _ticks(high + 0.2 * (top - high), top, 3.0) if over else ()
    return Axis(title, bottom, top, False, tuple(sorted(ticks)), bends=tuple(bends))


def _bulk(groups: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """The shortest range that holds more than half of the thin groups; None where it is not that of most."""
    ends = [(min(group), max(group)) for group in groups if group]
    if not ends:
        return None
    whole = max(high for _, high in ends) - min(low for low, _ in ends)
    thin = sorted((low, high) for low, high in ends if high - low < _THIN * whole)
    most = len(thin) // 2 + 1
    ranges = [
        (low, sorted(high for _, high in thin[i:])[most - 1])
        for i, (low, _) in enumerate(thin[: len(thin) - most + 1])
    ]
    left, right = min(ranges, key=lambda one: one[1] - one[0], default=(0.0, 0.0))
    reach = sum(low <= right and high >= left for low, high in ends)
    points = not any(left <= low < high <= right for low, high in ends)
    beside = any((high < left or low > right) and high - low >= _THIN * whole for low, high in ends)
    return (left, right) if left < right and 2 * reach >= len(ends) and not (points and beside) else None


def room_for(titles: Sequence[str]) -> float:
    """Share of a panel's width for labels to the right of their points: none if they are too many."""
    longest = max(map(text_width, titles)) if 0 < len(titles) <= MOST_LABELS else 0.0
    return min(_MOST_ROOM, (longest + 16.0) / (WIDTH - 60.0)) if longest else 0.0


def _log_ticks(low: float, high: float) -> Iterable[tuple[float, str]]:
    """Ticks from 10**low to 10**high: 1, 2, 5 within two decades, else decades."""
    digits = (1, 2, 5) if high - low < 1.8 else (1,)
    step = max(1, round((high - low) / 3.5))
    for power in range(math.floor(low), math.ceil(high) + 1):
        for digit in digits:
            value = digit * 10.0**power
            if low <= math.log10(value) <= high and (len(digits) > 1 or power % step == 0):
                yield value, f"{value:,.{max(0, -power)}f}"


def _ticks(low: float, high: float, steps: float = 5.0) -> Iterable[tuple[float, str]]:
    """Round values, so many or somewhat more or less."""
    rough = (high - low) / steps
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(digit * power for digit in (1, 2, 5, 10) if digit * power >= rough)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1):
        yield i * step, f"{i * step:,.{decimals}f}"


@dataclass(frozen=True)
class Series:
    """Points, a line through them, or an area.

    Attributes:
        title: name where a point is pointed at; "" if none can be.
        x, y: equally long.
        look: color, marker and dash.
        line: width in pixels; 0: no line.
        mark: diameter of the markers in pixels; 0: none.
        opacity: of the markers.
        fill: whether the outline of an area is given, which is filled.
        names: of the points, or empty.
        keys: per point the keys of the table's rows that it stands for, or empty.
    """

    title: str
    x: Sequence[float]
    y: Sequence[float]
    look: Look
    line: float = 0.0
    mark: float = 0.0
    opacity: float = 1.0
    fill: bool = False
    names: Sequence[str] = ()
    keys: Sequence[Sequence[str]] = ()


class Text(NamedTuple):
    """A label at a point of a panel."""

    x: float
    y: float
    text: str
    color: str


class Bar(NamedTuple):
    """A horizontal bar, or a part of one.

    Attributes:
        y: its row.
        start, end: values of x.
        color: of its area.
        about: what it is where it is pointed at, in lines.
    """

    y: float
    start: float
    end: float
    color: str
    about: str


class Level(NamedTuple):
    """A horizontal line across a panel, which a line of text above it names.

    Attributes:
        value: of y; the axis need not hold it.
        text: what it is, with the value.
        dash: "dash" or "dot".
        width: in pixels.
    """

    value: float
    text: str
    dash: str
    width: float


@dataclass(frozen=True, eq=False)
class Panel:
    """Series on two axes.

    Attributes:
        title: above it.
        labels: names beside points; the panel moves them apart.
        avoid: further points that no label covers.
        along: whether labels keep clear of the series' lines too, whose x ascend.
        stages: (x, text) of vertical lines.
        bars: drawn below the series.
        levels: drawn below the series as well, where the vertical axis holds them.
        width, height: in pixels, axes included.
    """

    title: str
    x: Axis
    y: Axis
    series: Sequence[Series] = ()
    labels: Sequence[Text] = ()
    avoid: Sequence[tuple[float, float]] = ()
    along: bool = False
    stages: Sequence[tuple[float, str]] = ()
    bars: Sequence[Bar] = ()
    levels: Sequence[Level] = ()
    width: float = WIDTH
    height: float = HEIGHT

    @cached_property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, width and height of the area between the axes, in pixels from the upper left corner."""
        ticks = max((text_width(text) for _, text in self.y.ticks), default=0.0)
        left = ticks + (28.0 if self.y.title else 10.0)
        top, bottom = (_ABOVE, _TOP) if self.x.above else (_TOP, _BOTTOM)
        top += _LEVEL * len(self.levels)
        return left, top, self.width - left - _RIGHT, self.height - top - bottom

    @cached_property
    def level_texts(self) -> list[tuple[float, Level, str]]:
        """(middle in pixels, level, text) of the lines above the panel."""
        below = self.box[1] - _LEVEL * len(self.levels)
        return [
            (
                below + _LEVEL * (i + 0.3),
                one,
                one.text + ("" if self.y.holds(one.value) else self._outside(one)),
            )
            for i, one in enumerate(self.levels)
        ]

    def _outside(self, level: Level) -> str:
        return ", above the chart" if level.value > max(self.y.low, self.y.high) else ", below the chart"

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Pixels of a point, y down."""
        left, top, width, height = self.box
        return left + width * self.x.share(x), top + height * (1.0 - self.y.share(y))

    def path(self, x: Sequence[float], y: Sequence[float]) -> list[tuple[float, float]]:
        """Pixels of a line through points, with its corners where the scale of the vertical axis changes."""
        spots: list[tuple[float, float]] = []
        for start, end in pairwise(zip(x, y, strict=True)):
            left, right = self.place(*start), self.place(*end)
            low, high = sorted((start[1], end[1]))
            across = [value for value, _ in self.y.bends if low < value < high]
            spots.append(left)
            for value in across if start[1] < end[1] else across[::-1]:
                share = (value - start[1]) / (end[1] - start[1])
                spots.append((left[0] + share * (right[0] - left[0]), self.place(end[0], value)[1]))
        return [*spots, *([self.place(x[-1], y[-1])] if len(x) else [])]

    def along_path(self, series: Series) -> list[tuple[float, float]]:
        """Pixels of points along a line whose x ascend."""
        x, y = np.transpose(self.path(series.x, series.y))
        across = np.linspace(x[0], x[-1], _STEPS) if len(x) > 1 else x
        return list(zip(across.tolist(), np.interp(across, x, y).tolist(), strict=True))

    @cached_property
    def remarks(self) -> list[tuple[float, float, float, str]]:
        """(left, middle, bend, text) of a remark on each change of scale, where least is drawn; in pixels."""
        left, _, width, _ = self.box
        spots = [spot for one in self.series if one.title and one.x for spot in self.path(one.x, one.y)]
        for one in self.series:
            if one.title and one.line:
                spots += self.along_path(one)
        notes = []
        for value, above, text in self.y.remarks:
            bend = self.place(self.x.low, value)[1]
            middle, long = bend + (-9.0 if above else 10.0), text_width(text)
            starts = np.linspace(left + 5.0, left + width - 5.0 - long, 9).tolist()
            starts.sort(
                key=lambda start: sum(
                    start - 6.0 < x < start + long + 6.0 and abs(y - middle) < 10.0 for x, y in spots
                )
            )
            notes.append((starts[0], middle, bend, text))
        return notes

    @cached_property
    def placed(self) -> list[tuple[Text, Label]]:
        """The labels and where they are, without overlaps where there is room."""
        left, top, width, height = self.box
        spots = [self.place(label.x, label.y) for label in self.labels]
        around = [self.place(*spot) for spot in self.avoid]
        for across, rise, _, text in self.remarks:
            around += [(across + step, rise) for step in range(0, int(text_width(text)) + 10, 10)]
        for series in self.series if self.along else ():
            around += self.along_path(series)
        texts = [label.text for label in self.labels]
        places = place_labels(spots, texts, (left, top, left + width, top + height), avoid=around)
        return list(zip(self.labels, places, strict=True))


@dataclass(frozen=True)
class Chart:
    """Panels that belong together, and one legend of all of them.

    Attributes:
        panels: in reading order.
        legend: name -> look.
        note: remarks below panels and legend, on what is left out and why.
        title: of the chart beside others of a section.
    """

    panels: Sequence[Panel]
    legend: dict[str, Look] = field(default_factory=dict)
    note: str = ""
    title: str = ""
