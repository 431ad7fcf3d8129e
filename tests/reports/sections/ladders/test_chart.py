"""The chart of ladders shows how far each method climbs."""

from __future__ import annotations

import re

from econgs_bench.reports.charts.chart import Bar
from econgs_bench.reports.charts.labels import text_width
from econgs_bench.reports.charts.svg import file, page_panel
from econgs_bench.reports.family import Family
from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.ladders.chart import KINDS, anchor, ladder_chart
from econgs_bench.reports.sections.ladders.section import section
from econgs_bench.reports.sections.ladders.table import climbed, ladders
from econgs_bench.reports.sections.section import Page
from tests.reports.sections.ladders.test_table import table

ROWS = [
    {"place": 0}, {"place": 1}, {"place": 2, "psnr": 20.0}, {"place": 3, "psnr": 10.0},
    {"method": "b", "place": 0}, {"method": "b", "place": 1, "status": "oom", "psnr": None},
    {"method": "c", "place": 0}, {"method": "c", "place": 2},
]  # fmt: skip


def test_a_field_is_a_rung_that_holds_or_the_kind_of_break() -> None:
    chart = ladder_chart(climbed(ladders(table(*ROWS))))
    (panel,) = chart.panels
    names = {look.color: name for name, look in chart.legend.items()}
    assert list(chart.legend) == ["holds", "quality", "failed step", "not measured"]
    assert chart.legend["quality"].color == KINDS["quality"]
    fields: dict[str, list[Bar]] = {}
    for bar in panel.bars:
        fields.setdefault(bar.about.partition(",")[0], []).append(bar)
    assert {method: [names[bar.color] for bar in bars] for method, bars in fields.items()} == {
        "a": ["holds", "quality", "quality"],
        "b": ["failed step", "not measured", "not measured"],
        "c": ["not measured", "holds", "not measured"],
    }
    for bars in fields.values():
        edges = [edge for bar in bars for edge in (bar.start, bar.end)]
        assert edges == sorted(edges)
    assert any("first breaks at r2 on vortices/cores: quality" in bar.about for bar in panel.bars)


def test_many_methods_have_several_panels_of_readable_width() -> None:
    names = [f"method {i:02}" for i in range(57)]
    rows = [{"method": name, "place": place} for name in names for place in (0, 1)]
    extra = ({"ladder": "extra", "place": place} for place in (0, 1))  # of the method a alone
    climbs = climbed(ladders(table(*rows, *extra)))
    chart = ladder_chart(climbs)
    assert max(panel.width for panel in chart.panels) < 1100
    assert len(chart.panels) == 8
    assert [text for panel in chart.panels for _, text in panel.x.ticks] == ["a", *names]
    for panel in chart.panels:
        assert panel.box[2] / len(panel.x.ticks) > max(text_width(text) for _, text in panel.x.ticks)
        assert {text for _, text in panel.y.ticks} == (
            {"noise", "extra"} if panel is chart.panels[0] else {"noise"}
        )
        assert {bar.about.partition(",")[0] for bar in panel.bars} == {text for _, text in panel.x.ticks}
    assert float(re.search(r'width="([\d.]+)"', file(chart))[1]) < 1200


def test_long_names_of_variants_do_not_meet() -> None:
    rows = [
        {"method": "econgs", "variant": f"configuration=paper,features={i}", "place": place}
        for i in range(9)
        for place in (0, 1)
    ]
    chart = ladder_chart(climbed(ladders(table(*rows))))
    for panel in chart.panels:
        assert panel.box[2] / len(panel.x.ticks) > max(text_width(text) for _, text in panel.x.ticks)


def test_heads_lead_to_details_on_the_page_alone() -> None:
    chart = ladder_chart(climbed(ladders(table(*ROWS))))
    (panel,) = chart.panels
    for target in ("method-a", "method-b", "ladder-noise"):
        assert page_panel(panel).count(f'href="#{target}"') == 1
    assert "href" not in file(chart)
    assert anchor("method", "3DGS [a=1,b=x]") == "method-3dgs-a-1-b-x"


def test_the_section_of_a_page(maker) -> None:
    maker.run(method="a")
    tables = maker.tables()
    assert section(Page(Report(tables), Family())) is None
    found = section(Page(Report(tables | {"rungs": table(*ROWS)}), Family()))
    assert found is not None
    assert list(found.charts) == ["ladders"]
