"""The chart that decides: difference of PSNR over ratio of a cost, relative to a reference method."""

from __future__ import annotations

import math
from statistics import fmean

from econgs_bench.reports.charts.chart import GRAY, Chart, Panel, Series, Text, broken_axis, log_axis
from econgs_bench.reports.charts.levels import with_floor
from econgs_bench.reports.conclusions.contest import Contest
from econgs_bench.reports.conclusions.relative import Mark, marks, reference
from econgs_bench.reports.floors import Floor, mean
from econgs_bench.reports.fronts import pareto
from econgs_bench.reports.schema import COLUMNS
from econgs_bench.reports.style import Look, Model, label, look, model_named

COSTS = {"size_bytes": "Size", "train_seconds": "Training time", "fps": "Frames per second"}
"""Column of a cost -> its title."""
_WIDTH, _HEIGHT = 520.0, 380.0


def decisions(contest: Contest, models: list[Model]) -> dict[str, Chart]:
    """Name of the file -> :func:`decision`, for each cost that can be compared."""
    return {
        f"decision-{column.partition('_')[0]}": chart
        for column in COSTS
        if (chart := decision(contest, column, models)) is not None
    }


def decision(contest: Contest, column: str, models: list[Model]) -> Chart | None:
    """One mark per method with its 95 % interval in both directions, and the Pareto front.

    Args:
        contest: the methods and rows.
        column: a key of :data:`COSTS`.
        models: all of the report.

    Returns:
        The chart, or None where no method can be compared with the reference.
    """
    relatives = marks(contest, column)
    if not relatives:
        return None
    base = reference(contest)
    spots = {base: (1.0, 0.0)} | {
        mark.method: (math.exp(mark.cost.mean), mark.quality.mean) for mark in relatives
    }
    crosses = {mark.method: _cross(mark) for mark in relatives}
    every = [*spots.values(), *(spot for cross in crosses.values() for line in cross for spot in line)]
    x = log_axis([spot[0] for spot in every], f"{COSTS[column]} relative to {label(base)}")
    heights = [
        [spot[1], *(end for line in crosses.get(method, ()) for _, end in line)]
        for method, spot in spots.items()
    ]
    y = broken_axis(heights, f"PSNR relative to {label(base)} [dB]", least=1.0)
    series = [_line([(x.low, 0.0), (x.high, 0.0)], GRAY), _line([(1.0, y.low), (1.0, y.high)], GRAY)]
    front = pareto(list(spots.values()), COLUMNS[column].better)
    if len(front) > 1:
        series.append(_line(front, GRAY, dash="dash"))
    labels = []
    for method, spot in spots.items():
        style = look(model_named(method), models)
        series += [_line(line, style.color) for line in crosses.get(method, ())]
        series.append(Series(label(method), [spot[0]], [spot[1]], style, mark=9.0, names=[""]))
        labels.append(Text(*spot, label(method), style.color))
    panel = Panel(COSTS[column], x, y, series, labels, width=_WIDTH, height=_HEIGHT)
    return Chart([with_floor(panel, _floor(contest, base), "+.1f")])


def _floor(contest: Contest, base: str) -> Floor | None:
    """How far the noise floor is above a method: mean over datasets of means over scenes, as of marks."""
    above = []
    for dataset, scenes in contest.values("psnr").cells[base].items():
        pairs = [(contest.floors[dataset][scene], fmean(seeds.values())) for scene, seeds in scenes.items()]
        above.append(mean(floor and floor.above(psnr) for floor, psnr in pairs))
    return mean(above)


def _cross(mark: Mark) -> list[list[tuple[float, float]]]:
    """The two intervals of a mark, as lines through it."""
    x, y = math.exp(mark.cost.mean), mark.quality.mean
    lines = []
    if mark.cost.ends is not None:
        lines.append([(end, y) for end in mark.cost.ends])
    if mark.quality.ends is not None:
        lines.append([(x, end) for end in mark.quality.ends])
    return lines


def _line(spots: list[tuple[float, float]], color: str, dash: str = "solid") -> Series:
    x, y = zip(*spots, strict=True)
    return Series("", x, y, Look(color, "", dash), line=1.0)
