"""What the training loss is made of while models are trained."""

from __future__ import annotations

from econgs_bench.reports.sections.losses.chart import losses_chart
from econgs_bench.reports.sections.losses.table import LEAST_SHARE, losses, steps
from econgs_bench.reports.sections.notes import rates_left_out, variants_left_out
from econgs_bench.reports.sections.section import Page, Section

_WORDS = (
    "The training loss and its weighted parts (logarithmic), means over stretches of the fits (50, which "
    "stages cut). A dashed line stands where a stage begins."
)
_SINGLE = (
    " Of fits by older versions there are single steps; their dashed lines stand at the first one that has "
    "seen a part, which may have joined at any time since the one before."
)


def section(page: Page) -> Section | None:
    """A panel per dataset and method; None where no method tells parts of its loss."""
    tables = page.report.tables
    rows = steps(tables)
    panels = losses(rows)
    if not panels:
        return None
    words = _WORDS + (_SINGLE if "first" not in rows or rows["first"].isna().any() else "")
    if small := sorted({name for panel in panels for name in panel.small}):
        words += f" Not drawn, for they are under {LEAST_SHARE:g} of it: {', '.join(small)}."
    words += rates_left_out(tables["curve"]) + variants_left_out(rows)
    return Section("losses", "Parts of the loss", words=words, charts={"losses": losses_chart(panels)})
