"""When a model pays: models beside the compressed volume."""

from __future__ import annotations

from econgs_bench.reports.charts.lines import lines
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.sections.volumes.conclusion import (
    HEADS,
    conclusion,
    over_grids,
    payoffs,
    row,
    sides,
)
from econgs_bench.reports.tables.table import Table

_GRID, _RATIO = "grid [N³]", "bytes of model / volume, equal PSNR"
_WORDS = (
    "The compressed volume is drawn by the ray marcher that drew the ground truth: its error is that of the "
    "compression alone, which favours it. It takes every other transfer function without more bytes, and "
    "the scenes of a variable share its size. A model that the smallest volume measured "
    "surpasses has no line over grids. The charts of trade-offs have its curves."
)


def section(page: Page) -> Section | None:
    """Models beside the compressed volume; None where there are not both."""
    found = payoffs(page.report.curves, sides(page.report.stored["dvr"]))
    if not found:
        return None
    panels = over_grids(found)
    charts = {"payoff": lines(panels, _GRID, _RATIO, page.report.models, log_y=True)} if panels else {}
    table = Table("Models and the volume at equal PSNR", HEADS, [row(one) for one in found])
    return Section("volumes", "When does a model pay", conclusion(found), _WORDS, charts, [table])
