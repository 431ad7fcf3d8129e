"""The noise floor in charts: a line where the axis holds it, else its value, and axes as without it."""

import re

import pytest

from econgs_bench.reports.charts import svg
from econgs_bench.reports.charts.chart import Axis, Panel, linear_axis
from econgs_bench.reports.charts.levels import with_floor
from econgs_bench.reports.charts.tradeoff import tradeoff_chart
from econgs_bench.reports.floors import Floor
from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.order import charts
from econgs_bench.reports.sections.tradeoffs.table import tradeoffs

AXIS = Axis("PSNR [dB]", 20.0, 40.0)
PLAIN = Panel("t", linear_axis([0.0, 1.0], "x"), AXIS)
ACROSS = re.compile(r'<path d="M([\d.]+) ([\d.]+)h([\d.]+)" stroke="[^"]*"[^>]*stroke-dasharray="([\d ]+)"')


def lines(panel):
    """(height in pixels, dashes) of the lines that cross the whole panel."""
    left, _, width, _ = panel.box
    found = [tuple(match) for match in ACROSS.findall(svg.drawing(panel))]
    return [
        (float(y), dash)
        for x, y, long, dash in found
        if float(x) == pytest.approx(left, abs=0.06) and float(long) == pytest.approx(width, abs=0.06)
    ]


def test_a_floor_within_the_axis_is_a_line_at_its_value():
    panel = with_floor(PLAIN, Floor(35.0, 25.0))
    (floor, dashes), (ray, dots) = lines(panel)
    _, top, _, height = panel.box
    assert floor == pytest.approx(top + 0.25 * height, abs=0.06)
    assert ray == pytest.approx(top + 0.75 * height, abs=0.06)
    assert dashes != dots
    texts = [text for *_, text in panel.level_texts]
    assert ["35.0 dB" in texts[0], "25.0 dB" in texts[1]] == [True, True]
    assert all(f">{text}<" in svg.drawing(panel) for text in texts)
    assert all(middle < top for middle, *_ in panel.level_texts)


@pytest.mark.parametrize(("floor", "where"), [(54.1, "above"), (12.0, "below")])
def test_a_floor_beyond_the_axis_is_a_text_and_moves_nothing(floor, where):
    panel = with_floor(PLAIN, Floor(floor, None))
    assert panel.y is AXIS
    assert lines(panel) == []
    ((_, _, text),) = panel.level_texts
    assert f"{floor:.1f} dB" in text
    assert where in text
    assert f">{text}<" in svg.drawing(panel)


def test_one_ray_a_pixel_is_drawn_where_the_chart_holds_it_and_it_is_not_the_truth():
    assert len(with_floor(PLAIN, Floor(54.0, 30.0)).levels) == 2
    assert len(with_floor(PLAIN, Floor(54.0, 15.0)).levels) == 1
    assert len(with_floor(PLAIN, Floor(30.0, 30.0)).levels) == 1
    assert with_floor(PLAIN, None) is PLAIN


def filled(maker, floors):
    """Two methods, one at four rates and two lengths, on two scenes with these floors."""
    for scene, floor in zip(("a", "b"), floors, strict=True):
        more = {"floor": floor and floor[0], "one_ray": floor and floor[1], "views": 0, "reason": None}
        for rate, psnr in ((0.5, 30.0), (1.0, 31.0), (2.0, 32.0), (4.0, 33.0)):
            maker.run("d", scene, "econgs", rate=rate, psnr=psnr, size=int(1e6 * rate), **more)
        for variant, factor in (("", 1), ("iterations=1400", 2)):
            for method, psnr in (("econgs", 31.0), ("3dgs", 29.0)):
                maker.run("d", scene, method, variant, psnr=psnr + factor, seconds=40.0 * factor,
                          size=int(1e6 * factor), **more)  # fmt: skip
    return maker.report()


@pytest.mark.parametrize("name", ["psnr-size", "psnr-fps", "race-train", "race-size", "anytime-psnr"])
def test_every_chart_of_psnr_has_the_mean_floor_of_its_scenes(maker, name):
    found = dict(charts(filled(maker, [(50.0, 28.0), (60.0, 32.0)])))
    (panel,) = found[name].panels
    assert [level.value for level in panel.levels] == [55.0, 30.0]
    plain = {key: chart.panels[0] for key, chart in charts(without(maker.tables()))}[name]
    assert plain.levels == ()
    assert (panel.y, panel.x, panel.series[-1].y) == (plain.y, plain.x, plain.series[-1].y)


def without(tables):
    return Report({**tables, "results": tables["results"].assign(floor=None, one_ray=None)})


def test_the_chart_that_decides_has_it_relative_to_the_reference(maker):
    report = filled(maker, [(31.0, None), (33.0, None)])
    (panel,) = dict(charts(report))["decision-size"].panels
    (level,) = panel.levels
    assert level.value == pytest.approx(32.0 - 30.0)
    assert "+2.0 dB" in level.text


def test_a_scene_without_a_floor_leaves_the_mean_without_a_line(maker):
    report = filled(maker, [(50.0, 28.0), None])
    panels = tradeoffs(report.at_shared_seeds, "size_bytes")
    (panel,) = tradeoff_chart(panels, report.models).panels
    assert panel.levels == ()


def test_notes_of_charts_name_a_fixed_number_of_rays_of_their_datasets(maker):
    for dataset, samples in (("one", 1), ("many", 0)):
        for method in ("econgs", "3dgs"):
            maker.run(dataset, "a", method, samples=samples, reason=None, views=0)
    found = dict(charts(maker.report()))
    assert found["psnr-size"].note.count("one ray a pixel (one)") == 1
    maker.rows["results"] = [row for row in maker.rows["results"] if row["dataset"] == "many"]
    assert "ray" not in dict(charts(maker.report()))["psnr-size"].note
