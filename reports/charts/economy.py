"""The section of the page on what a quality costs on scenes of known complexity."""

from __future__ import annotations

from typing import TYPE_CHECKING

from econgs_bench.reports.charts import kinds
from econgs_bench.reports.charts.elements import Section, cards, legend, table
from econgs_bench.reports.conclusions import economy
from econgs_bench.reports.schema import PRUNED
from econgs_bench.reports.style import MISSING

if TYPE_CHECKING:
    from econgs_bench.reports.charts.report import Report
    from econgs_bench.reports.conclusions.economy import Economy

_WORDS = (
    "What a scene holds is measured by the bytes of its volume as the transfer function shows it, coded "
    "without loss; on the dashed gray line a model takes as many. A mark is a scene. A method that spends no "
    "more than a scene needs has low marks that rise with it. A line has the growth by least squares of "
    "logarithms, of three scenes and a decade at least. Faint marks: the smallest model is above that "
    "quality already, and less may do; they do not count for the line."
)
_NOTE = (
    "Bytes in KiB, in brackets against those of the volume. They are those of the first model of a method's "
    "rate-distortion curve that reaches the PSNR, interpolated (logarithm over dB) between neighbouring "
    "sizes, never extrapolated; \N{LESS-THAN OR EQUAL TO}: the smallest model is above it; "
    f"{MISSING}: no model reaches it, or it was not measured. dB per KiB: between neighbouring sizes, from "
    "the smallest on. Gaussians go by their blending weights over the training views, the least first, until "
    "the mean PSNR of the test views is that much lower; the default's model."
)


def economy_section(report: Report) -> Section | None:
    """Bytes and primitives for a quality, the worth of a KiB, and what could go."""
    rows = report.economies
    if not economy.has_facts(rows):
        return None
    charts = {}
    if (needs := kinds.needs(rows, report.models)).panels:
        charts["economy-bytes"] = needs
    if (prunable := kinds.prunable(rows, report.models)).panels:
        charts["economy-prunable"] = prunable
    entries = {name: look for chart in charts.values() for name, look in chart.legend.items()}
    grid = cards(panel for chart in charts.values() for panel in chart.panels)
    heads = ["Scene", "Method", "Volume [KiB]", *(f"{level:g} dB [KiB]" for level in economy.LEVELS)]
    heads += [f"{level:g} dB, primitives" for level in economy.LEVELS]
    heads += ["dB per KiB", "Gaussians", *(f"Can go at {drop:g} dB [%]" for drop in PRUNED.values())]
    html = (
        f"<p><b>{economy.conclusion(rows)}</b></p><p>{_WORDS}</p>{legend(entries)}{grid}"
        f'{table("What a quality costs", heads, [_row(one) for one in rows])}<p class="note">{_NOTE}</p>'
    )
    return Section("economy", "What a quality costs", html, charts)


def _row(one: Economy) -> list[str]:
    return [
        one.scene,
        one.model.title,
        MISSING if one.volume is None else f"{one.volume / economy.KIB:,.1f}",
        *(one.bytes_text(level) for level in economy.LEVELS),
        *(one.primitives_text(level) for level in economy.LEVELS),
        one.gains_text(),
        MISSING if one.gaussians is None else f"{one.gaussians:,.0f}",
        *(one.prunable_text(column) for column in PRUNED),
    ]
