"""How the values of primitives are distributed, and which anchors have similar features."""

from __future__ import annotations

from econgs_bench.reports.sections.attributes.chart import histogram_chart, map_chart
from econgs_bench.reports.sections.attributes.table import Missing, histograms, maps
from econgs_bench.reports.sections.notes import rates_left_out, variants_left_out
from econgs_bench.reports.sections.section import Page, Section, cards, legend

_WORDS = (
    "Distribution of what the primitives carry, all scenes of a dataset together. Quantised values are "
    "spread over neighbouring bins as far as their steps reach."
)
_MAP = (
    "<h3>Anchors by their features</h3><p>UMAP: neighbours have similar features; distances between "
    "clusters, and their sizes, say little.</p>"
)


def section(page: Page) -> Section | None:
    """A histogram per attribute, and a map where anchors have features; None without attributes."""
    table = page.report.tables["features"]
    panels = histograms(table)
    if not panels:
        return None
    words = _WORDS + rates_left_out(table) + variants_left_out(table)
    charts = {"attributes": histogram_chart(panels, page.report.models)}
    try:
        charts["features-umap"] = map_chart(maps(table))
    except Missing as why:
        note = f"No map of anchors by their features: {why}."
        return Section("attributes", "Attributes", words=words, charts=charts, note=note)
    first, second = (legend(chart.legend) + cards(chart.panels) for chart in charts.values())
    html = first + _MAP + second
    return Section("attributes", "Attributes", words=words, charts=charts, html=html, layout=False)
