"""What a quality costs on scenes of known complexity."""

from __future__ import annotations

from econgs_bench.reports.schema import PRUNED
from econgs_bench.reports.sections.economy import conclusion as economy
from econgs_bench.reports.sections.economy.conclusion import Economy
from econgs_bench.reports.sections.section import Page, Section
from econgs_bench.reports.style import MISSING
from econgs_bench.reports.tables.table import Table

_WORDS = (
    "What a scene holds is measured by the bytes of its volume as the transfer function shows it, coded "
    "without loss."
)
_NOTE = (
    "Bytes in KiB, in brackets against those of the volume: of the first model of a method's curve that "
    "reaches the PSNR, interpolated (logarithm over dB), never extrapolated. \N{LESS-THAN OR EQUAL TO}: "
    f"the smallest model is above it. {MISSING}: no model reaches it, or it was not measured. dB per KiB: "
    "between neighbouring sizes, from the smallest on. Gaussians go by their blending weights over the "
    "training views, the least first, until the mean PSNR of the test views is that much lower; the "
    "default's model."
)


def section(page: Page) -> Section | None:
    """Bytes and primitives for a quality, the worth of a KiB, and what could go."""
    rows = economy.of_report(page.report)
    if not economy.has_facts(rows):
        return None
    heads = ["Scene", "Method", "Volume [KiB]", *(f"{level:g} dB [KiB]" for level in economy.LEVELS)]
    heads += [f"{level:g} dB, primitives" for level in economy.LEVELS]
    heads += ["dB per KiB", "Gaussians", *(f"Can go at {drop:g} dB [%]" for drop in PRUNED.values())]
    table = Table("What a quality costs", heads, [_row(one) for one in rows])
    answer = [economy.conclusion(rows)]
    return Section("economy", "What a quality costs", answer, _WORDS, tables=[table], note=_NOTE)


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
