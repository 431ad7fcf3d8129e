"""The trade-off of the first screen: difference of PSNR over ratio of a cost, against a reference method."""

from __future__ import annotations

import math
from statistics import fmean

from econgs_bench.reports.charts.chart import Chart
from econgs_bench.reports.charts.tradeoff import XY, Spot, Tradeoff, TradeoffLine, tradeoff_chart
from econgs_bench.reports.floors import Floor, mean
from econgs_bench.reports.schema import COLUMNS
from econgs_bench.reports.sections.answers.contest import Contest
from econgs_bench.reports.sections.answers.relative import Mark, marks, reference
from econgs_bench.reports.style import Model, label, model_named

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
    lines = [TradeoffLine(model_named(base), [Spot(1.0, 0.0)], title=label(base))]
    for mark in relatives:
        spot = Spot(math.exp(mark.cost.mean), mark.quality.mean)
        name = label(mark.method)
        lines.append(TradeoffLine(model_named(mark.method), [spot], bars=_cross(mark), title=name))
    panel = Tradeoff(
        COSTS[column],
        f"{COSTS[column]} relative to {label(base)}",
        lines,
        COLUMNS[column].better,
        _floor(contest, base),
        f"PSNR relative to {label(base)} [dB]",
        origin=(1.0, 0.0),
        width=_WIDTH,
        height=_HEIGHT,
    )
    return tradeoff_chart([panel], models, "+.1f")


def _floor(contest: Contest, base: str) -> Floor | None:
    """How far the noise floor is above a method: mean over datasets of means over scenes, as of marks."""
    above = []
    for dataset, scenes in contest.values("psnr").cells.get(base, {}).items():
        pairs = [(contest.floors[dataset][scene], fmean(seeds.values())) for scene, seeds in scenes.items()]
        above.append(mean(floor and floor.above(psnr) for floor, psnr in pairs))
    return mean(above)


def _cross(mark: Mark) -> list[list[XY]]:
    """The two intervals of a mark, as lines through it."""
    x, y = math.exp(mark.cost.mean), mark.quality.mean
    lines = []
    if mark.cost.ends is not None:
        lines.append([(end, y) for end in mark.cost.ends])
    if mark.quality.ends is not None:
        lines.append([(x, end) for end in mark.quality.ends])
    return lines
