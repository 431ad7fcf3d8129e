"""The chart of ladders shows how far each method climbs."""

from __future__ import annotations

import pytest

from reports.charts.ladders import ladder_chart, ladders_section
from reports.charts.report import Report
from reports.tables.ladders import climbed, ladders
from tests.reports.tables.test_ladders import table

ROWS = [
    {"place": 0}, {"place": 1}, {"place": 2, "psnr": 20.0}, {"place": 3, "psnr": 10.0},
    {"method": "b", "place": 0}, {"method": "b", "place": 1, "status": "oom", "psnr": None},
    {"method": "c", "place": 0}, {"method": "c", "place": 3},
]  # fmt: skip


def test_a_bar_is_the_rungs_that_hold_and_then_the_kind_of_break() -> None:
    chart = ladder_chart(climbed(ladders(table(*ROWS))))
    (panel,) = chart.panels
    assert list(chart.legend) == ["holds", "quality", "failed step"]
    lengths = {}
    for bar in panel.bars:
        lengths.setdefault(bar.about.partition(",")[0], []).append((bar.end - bar.start) / 0.9)
    assert lengths == {
        "a": pytest.approx([0.5, 0.5]), "b": pytest.approx([0.25, 0.75]), "c": pytest.approx([1.0])
    }  # fmt: skip
    assert any("breaks at r2 on vortices/cores: quality" in bar.about for bar in panel.bars)


def test_the_section_of_a_page(maker) -> None:
    maker.run(method="a")
    tables = maker.tables()
    assert ladders_section(Report(tables)) is None
    section = ladders_section(Report(tables | {"rungs": table(*ROWS)}))
    assert section is not None
    assert "vortices/cores" in section.html
    assert section.html.count("<tr") == 3  # a head and two breaks
