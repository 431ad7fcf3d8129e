"""Lines of the noise floor in charts of PSNR."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from econgs_bench.reports.charts.chart import Level, Panel
from econgs_bench.reports.floors import Floor, of_table
from econgs_bench.reports.tables.protocols import comparable

if TYPE_CHECKING:
    import pandas as pd

_SAME = 0.05
"""One ray a pixel within so many dB of the floor is the truth itself."""


def with_floor(panel: Panel, floor: Floor | None, form: str = ".1f") -> Panel:
    """A panel with a dashed line at what the truth itself reaches, and a dotted one at one ray a pixel.

    The axes stay as they are. A floor that they do not hold is named above the chart alone.

    Args:
        panel: its vertical axis is PSNR in dB.
        floor: of what the panel shows; None where it is not known.
        form: of the values.
    """
    if floor is None:
        return panel
    levels = [Level(floor.truth, f"floor of the truth: {floor.truth:{form}} dB", "dash", 1.0)]
    ray = floor.one_ray
    if ray is not None and panel.y.holds(ray) and floor.truth - ray > _SAME:
        levels.append(Level(ray, f"one ray a pixel: {ray:{form}} dB", "dot", 0.7))
    return replace(panel, levels=levels)


def by_panel(results: pd.DataFrame) -> dict[str, Floor | None]:
    """Title of a panel of training curves -> the floor of its dataset, mean over the basic scenes.

    Args:
        results: the documented table.
    """
    basic = results[results["kind"] == "basic"].drop(columns="split")
    return {title: of_table(rows) for title, rows in comparable(basic)}
