"""The page's section on ladders: links that lead somewhere, pictures where there are files."""

from __future__ import annotations

import re

import pytest

from econgs_bench.reports.family import Family
from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import frame
from econgs_bench.reports.sections.ladders import section as ladders
from econgs_bench.reports.sections.section import Page
from tests.reports.page.test_page import Outline, page
from tests.reports.sections.ladders.test_table import table

RUNGS = [
    {"method": name, "place": place, "psnr": psnr, "purpose": "more noise"}
    for name in ("3dgs", "hac")
    for place, psnr in ((0, 30.0), (1, 29.0), (2, 20.0))
]


def breaks(tables, root, folder):
    """The section of pictures and rungs."""
    return ladders.breaks(Page(Report(tables), Family(), root=root, folder=folder))


@pytest.fixture
def tables(maker):
    """A store with a ladder, whose rungs have the pictures of two usual runs."""
    maker.run("vortices", "cores", method="3dgs")
    maker.run("vortices", "cores", method="hac")
    stored = maker.tables()
    views = stored["views"].to_dict("records")
    rungs = table(*RUNGS)
    own = [
        view | {"job": job}
        for i, job in enumerate(rungs["job"])
        for view in views
        if view["job"] == f"measure-{i // 3:04d}"
    ]
    return stored | {"rungs": rungs, "rung_views": frame("rung_views", own)}


def test_heads_of_the_heat_map_lead_to_methods_and_ladders(maker, tables) -> None:
    source, text = page(maker, tables=tables)
    outline = Outline(source)
    assert {"method-3dgs", "method-hac", "ladder-noise"} <= outline.references
    assert outline.references <= set(outline.ids)
    assert outline.wrong == []
    assert "3DGS breaks first on “noise” (r2 on vortices/cores: quality, \N{MINUS SIGN}10.0 dB)" in text
    assert "hold 1 rung of 2 on 1 ladder" in text


def test_pictures_end_at_the_break_and_are_no_condition(maker, tables) -> None:
    html = breaks(tables, maker.root, maker.root / "charts").html
    assert len(re.findall("<img ", html)) == 1 + 2 * 3  # the truth once
    assert html.count("--kind:") == 2
    bare = breaks(tables, maker.root / "elsewhere", maker.root / "none").html
    assert "<img" not in bare
    assert {path.name for path in (maker.root / "charts").glob("breaks-*")} == {
        f"breaks-{name}.{suffix}" for name in ("3dgs", "hac") for suffix in ("pdf", "png")
    }
    assert 'href="charts/breaks-hac.png"' in html
    assert not (maker.root / "none").exists()
    assert bare.count("20.00 dB") == html.count("20.00 dB") == 2
    assert breaks(maker.tables(), maker.root, maker.root / "none") is None


def test_pictures_beyond_the_limit_are_left_out(maker, tables, monkeypatch) -> None:
    monkeypatch.setattr(ladders, "PICTURE_BYTES", 3000)
    html = breaks(tables, maker.root, maker.root / "charts").html
    assert "<img" not in html
    assert "omits pictures of 1 ladder to" in html


def test_several_seeds_have_a_spread(maker, tables) -> None:
    rows = [*RUNGS, RUNGS[2] | {"seed": 1, "psnr": 22.0}]
    html = breaks(tables | {"rungs": table(*rows)}, maker.root, maker.root / "charts").html
    assert "21.00 ± 1.41 dB (\N{MINUS SIGN}9.00)" in html
    assert html.count("±") == 1


def test_the_least_flicker_is_marked(maker, tables) -> None:
    tables["rungs"]["flicker"] = [None, 2.0, None, None, 1.0, None]
    html = breaks(tables, maker.root, maker.root / "charts").html
    assert re.findall("<b>([0-9.]+)</b>", html) == ["1.00"]
    assert "3DGS flickers most, 2.00, and HAC least, 1.00 (1 scene)" in html
    assert html.count("change of error of") == 2
