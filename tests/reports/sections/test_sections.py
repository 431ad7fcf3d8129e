"""Sections of a report: trade-offs, rates, training, parts, and which of them a store has."""

import json

import numpy as np
import pandas as pd
import pytest

from econgs_bench.reports.charts.lines import Line, lines
from econgs_bench.reports.charts.tradeoff import tradeoff_chart
from econgs_bench.reports.fronts import pareto
from econgs_bench.reports.report import Report
from econgs_bench.reports.sections import order
from econgs_bench.reports.sections.anytime.table import anytime, time_to_quality
from econgs_bench.reports.sections.losses.table import losses, steps
from econgs_bench.reports.sections.parts.chart import ledger, timing
from econgs_bench.reports.sections.rates.conclusion import of_report
from econgs_bench.reports.sections.section import Page, to_html
from econgs_bench.reports.sections.tradeoffs.table import tradeoffs
from econgs_bench.reports.style import Model
from tests.reports.conftest import fill, settings


def curve_table(rows):
    """A curve table from (job, scene, method, iteration, seconds, psnr, bytes, parts)."""
    columns = "job scene method iteration train_seconds psnr bytes_estimate loss_parts"
    table = pd.DataFrame(rows, columns=columns.split())
    parts = [json.loads(text) if text else {} for text in table["loss_parts"]]
    table["loss"] = [sum(v for k, v in p.items() if k != "bits per attribute") or 0.1 for p in parts]
    return table.assign(dataset="d", preset="quick", seed=0, **settings(""))


def tradeoff_data(maker, column="size_bytes"):
    """What the chart of PSNR against a column shows."""
    return tradeoffs(maker.report().at_shared_seeds, column)


def tradeoff(maker, column="size_bytes"):
    """The chart of PSNR against a column."""
    return tradeoff_chart(tradeoff_data(maker, column), maker.report().models)


def sections(tables):
    """Anchor -> HTML of the sections of questions."""
    report = Report(tables)
    page = Page(report, order.family(report))
    return {
        each.anchor: to_html(each)
        for each in order.sections(page)
        if each.anchor not in ("results", "provenance")
    }


def texts(panel):
    """The labels of a panel."""
    return {label.text for label in panel.labels}


def results_table(maker, **scenes):
    for method, names in scenes.items():
        for scene in names:
            maker.run("d", scene, method, views=0)
    return maker.tables()["results"]


# --------------------------------------------------------------------------- trade-offs


def test_the_pareto_front_is_that_of_exhaustive_comparison():
    rng = np.random.default_rng(0)
    points = [(float(x), float(y)) for x, y in rng.integers(0, 12, (60, 2))]
    for better in (1, -1):
        alone = {
            (x, y)
            for x, y in points
            if not any(
                better * a >= better * x and b >= y and (a, b) != (x, y) for a, b in points
            )
        }  # fmt: skip
        assert set(pareto(points, better)) == alone


def test_the_dominated_region_holds_what_some_mean_is_better_than(maker):
    for method, psnr, size in (("a", 30.0, 10), ("b", 35.0, 40), ("c", 29.0, 20), ("d", 34.0, 80)):
        maker.run(method=method, psnr=psnr, size=size << 20, views=0)
    (panel,) = tradeoff_data(maker)
    assert panel.front == [(10.0, 30.0), (40.0, 35.0)]
    assert panel.dominated(1000.0, 20.0) == [
        (10, 20), (10, 30), (40, 30), (40, 35), (1000, 35), (1000, 20)
    ]  # fmt: skip


def test_more_frames_per_second_are_better_and_less_memory_is(maker):
    maker.run(method="slow", fps=1.0, psnr=30.0, views=0, peak_host_bytes=1 << 20)
    maker.run(method="fast", fps=9.0, psnr=30.0, views=0, peak_host_bytes=9 << 20)
    assert tradeoff_data(maker, "fps")[0].front == [(9.0, 30.0)]
    assert tradeoff_data(maker, "peak_host_bytes")[0].front == [(1.0, 30.0)]
    assert tradeoff_data(maker, "peak_device_bytes") == []


def test_one_method_alone_has_no_front(maker):
    maker.run(views=0)
    (panel,) = tradeoff_data(maker, "fps")
    assert panel.front == panel.dominated(0.0, 0.0) == []


def test_rates_of_a_method_are_compared_on_the_seeds_that_all_of_them_have(maker):
    for seed, psnr in ((0, 33.8), (1, 33.0)):
        for method in ("econgs", "3dgs"):
            maker.run(method=method, seed=seed, psnr=psnr, size=400, views=0)
    words = "compared on the seeds"
    assert not any(words in html for html in sections(maker.tables()).values())
    maker.run(method="econgs", variant="rate_weight=0.01", seed=0, psnr=33.1, size=200, views=0)
    (panel,) = tradeoff_data(maker)
    means = {line.model.title: [spot.y for spot in line.means] for line in panel.lines}
    assert means == {"ECoNGS-R": [33.1, 33.8], "3DGS": [pytest.approx(33.4)]}
    html = sections(maker.tables())
    assert [anchor for anchor in html if words in html[anchor]] == ["tradeoffs"]


def test_points_are_linked_to_rows(maker):
    maker.run(scene="a", method="ivr-gs", rate=64, views=0)
    dots = tradeoff(maker, "fps").panels[0].series
    keys = ["measure-0000", "vortex / iVR-GS @ 64 / quick / test"]
    assert [each.keys for each in dots] == [([key],) for key in keys]


def test_fits_that_differ_in_the_rate_knob_are_one_line_from_small_to_large(maker):
    for weight, psnr, size, fps in (
        (1e-3, 35.0, 300, 50.0),
        (1e-2, 33.0, 100, 60.0),
        (5e-3, 34.0, 200, 40.0),
    ):
        maker.run(method="hac", variant=f"rate_weight={weight:g}", psnr=psnr, size=size, fps=fps, views=0)
    (panel,) = tradeoff_data(maker, "fps")
    (line,) = panel.lines
    assert line.model == Model("hac")
    assert [spot[:2] for spot in line.means] == [(60.0, 33.0), (40.0, 34.0), (50.0, 35.0)]


def test_of_many_variants_the_unnamed_are_without_their_scenes(maker):
    for k in range(12):
        maker.run(
            method="econgs", variant=f"features={k + 1}" if k else "", psnr=30.0 + k, size=k + 1, views=0
        )
    (panel,) = tradeoff_data(maker)
    assert {line.model: len(line.scenes) for line in panel.lines if line.scenes} == {Model("econgs"): 1}
    assert all(line.means for line in panel.lines)


# --------------------------------------------------------------------------- rates


def rate_store(maker):
    for weight, psnr, size in ((1e-2, 33.0, 100), (5e-3, 34.0, 200), (1e-3, 35.0, 300), (5e-4, 36.0, 400)):
        for method, gain in (("hac", 0.0), ("econgs", 0.5)):
            variant = f"rate_weight={weight:g}"
            maker.run(method=method, variant=variant, psnr=psnr + gain, size=size << 10, views=0)
    maker.run(method="3dgs", psnr=37.0, size=9 << 20, views=0)


def test_the_page_tells_bd_rates(maker):
    rate_store(maker)
    html = sections(maker.tables())["rate-distortion"]
    first = of_report(maker.report())[0]
    assert first.psnr == pytest.approx(0.5, abs=0.01)
    assert f"{first.rate:+.1f} %".replace("-", "\N{MINUS SIGN}") in html
    assert "33.50 to 36.00" in html


# --------------------------------------------------------------------------- training


def test_anytime_counts_a_joint_fit_by_shares(maker):
    rows = [
        ("j", s, "econgs", i, 20.0 * i, p + i, 2 << 20, "")
        for s, p in (("a", 29.0), ("b", 31.0))
        for i in (1, 2)
    ]
    rows += [
        (s, s, "3dgs", i, 10.0 * i, p + i, 4 << 20, "") for s, p in (("a", 20.0), ("b", 30.0)) for i in (1, 2)
    ]
    results = results_table(maker, econgs="ab", **{"3dgs": "ab"})
    joint, single = anytime(curve_table(rows), results)["d"]
    assert (joint.x, joint.y) == ([10.0, 20.0], [31.0, 32.0])
    assert (single.x, single.y) == ([10.0, 20.0], [26.0, 27.0])


def test_anytime_weighs_scenes_and_a_finished_fit_keeps_its_value(maker):
    rows = [("j", s, "m", i, 3.0 * i, 30.0, None, "") for s in "abc" for i in (1, 2)]
    rows += [("k", "d", "m", 1, 1.0, 34.0, None, ""), ("k", "d", "m", 2, 5.0, 38.0, None, "")]
    (line,) = anytime(curve_table(rows), results_table(maker, m="abcd"))["d"]
    assert line.x == [1.0, 2.0, 5.0]
    assert line.y == pytest.approx([31.0, 31.25, 32.0])


def test_anytime_says_where_scenes_are_missing(maker):
    rows = [("j", "a", "m", 1, 3.0, 30.0, None, "")]
    (line,) = anytime(curve_table(rows), results_table(maker, m="ab"))["d"]
    assert line.title == "m (1 of 2 scenes)"


def test_charts_of_training_show_the_default_of_a_rate_knob(maker):
    parts = json.dumps({"image": 0.01, "rate": 0.002})
    rows = [(job, "a", "m", i, 3.0 * i, 30.0, None, parts) for job in "jkln" for i in (1, 2)]
    variants = {"j": "rate_weight=0.1", "k": "", "l": "a=1,rate_weight=0.1", "n": "a=1,rate_weight=0.2"}
    table = curve_table(rows)
    axes = pd.DataFrame([settings(variants[job]) for job in table["job"]])
    table = table.assign(**{name: axes[name] for name in axes})
    # Of "a=1" there is no fit at the default rate: all of them are shown.
    shown = ["m", "m [a=1,rate_weight=0.1]", "m [a=1,rate_weight=0.2]"]
    results = results_table(maker, m="a")
    assert [line.model.title for line in anytime(table, results)["d"]] == shown
    rows = steps({"curve": table, "losses": table[:0].assign(losses=[])})
    assert [panel.title for panel in losses(rows)] == shown


def test_time_to_quality_is_linear_between_evaluations():
    curve = Line(Model("m"), "m", [10.0, 20.0, 40.0, 80.0], [31.0, 33.0, 32.5, 33.5])
    assert [time_to_quality(curve, level) for level in (30, 32, 34)] == [10.0, 15.0, None]


# --------------------------------------------------------------------------- parts of a whole


def test_timing_is_shares_of_the_frame_and_the_rest_is_told():
    rows = [("frame", 0.010), ("decode", 0.002), ("shade", 0.0), ("rasterise", 0.005)]
    table = pd.DataFrame(rows, columns=["part", "seconds"]).assign(
        job="j", dataset="d", scene="a", method="econgs", variant="", rate=None, preset="quick", seed=0
    )
    (bar,), parts = timing(table)
    assert parts == ["decode", "rasterise", "other"]
    assert [bar.percent(part) for part in parts] == pytest.approx([20.0, 50.0, 30.0])
    assert bar.total_text == "10.0 ms"


def test_bars_are_means_over_the_seeds_that_have_all_scenes():
    def table(column, values):
        rows = [
            (f"{scene}{seed}", scene, seed, part, value)
            for seed, (scenes, parts) in enumerate(values)
            for scene in scenes
            for part, value in parts.items()
        ]
        table = pd.DataFrame(rows, columns=["job", "scene", "seed", "part", column])
        return table.assign(dataset="d", method="econgs", variant="", rate=None, preset="quick")

    sizes = [
        ("ab", {"positions": 10, "features": 30}),
        ("ab", {"positions": 20, "features": 40}),
        ("a", {"positions": 99}),
    ]
    (bar,), _ = ledger(table("bytes", sizes))
    assert (bar.title, bar.total) == ("d · ECoNGS-R", 100.0)  # of two scenes: 80 and 120
    assert bar.percent("positions") == pytest.approx(30.0)
    times = [("ab", {"frame": 0.01, "decode": 0.004}), ("ab", {"frame": 0.02, "decode": 0.008})]
    (bar,), _ = timing(table("seconds", times))
    assert (bar.total_text, bar.percent("decode")) == ("15.0 ms", pytest.approx(40.0))


def test_no_timing_without_parts():
    table = pd.DataFrame({"part": ["frame"], "seconds": [0.01]}).assign(
        job="j", dataset="d", scene="a", method="plenoxels", variant="", rate=None, preset="quick", seed=0
    )
    assert timing(table) == ([], [])


# --------------------------------------------------------------------------- sections


def test_sections_of_a_normal_store(maker):
    """One rate, no parts of the loss, no times of parts, one seed and number of views."""
    fill(maker, "normal")
    assert list(sections(maker.tables())) == [
        "confidence", "anytime", "ledger"
    ]  # fmt: skip


def test_no_sections_without_data(maker):
    maker.run(status="failed", reason="boom")
    ((anchor, html),) = sections(maker.tables()).items()
    assert anchor == "stability"
    assert "1 of 1: failed 1" in html


def test_uncertainty_has_intervals_seeds_and_differences(maker):
    for seed, shift in enumerate((0.0, 0.3, -0.3)):
        maker.run(method="a", seed=seed, psnr=34.0 + shift)
        maker.run(method="b", seed=seed, psnr=30.0 + shift)
    html = sections(maker.tables())["confidence"]
    assert "± 0.30 (3 seeds): 34.00, 34.30, 33.70" in html
    assert "\N{MINUS SIGN}4.00" in html
    assert "lower" in html


def test_every_series_of_a_figure_is_named(maker):
    fill(maker, "failures")
    report = maker.report()
    panels = anytime(report.tables["curve"], report.results)
    (panel, *_) = lines(panels, "", "", report.models).panels
    assert texts(panel) == {"3DGS (1 of 2 scenes)", "ECoNGS-R"}
