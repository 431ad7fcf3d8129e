import json
import sys
from unittest.mock import Mock, patch

import numpy as np
import pandas as pd
import pytest

from econgs_bench.reports.charts import data, features, kinds, training
from econgs_bench.reports.charts.report import Report
from econgs_bench.reports.charts.sections import chart_sections
from econgs_bench.reports.style import Model
from tests.reports.conftest import fill, settings

ECONGS = Model("econgs")


def curve_table(rows):
    """A curve table from (job, scene, method, iteration, seconds, psnr, bytes, parts)."""
    columns = "job scene method iteration train_seconds psnr bytes_estimate loss_parts"
    table = pd.DataFrame(rows, columns=columns.split())
    parts = [json.loads(text) if text else {} for text in table["loss_parts"]]
    table["loss"] = [sum(v for k, v in p.items() if k != "bits per attribute") or 0.1 for p in parts]
    return table.assign(dataset="d", preset="quick", seed=0, **settings(""))


def losses(curve, stretches=()):
    """The losses of a curve, and of (job, method, stage, first, iteration, parts)."""
    table = pd.DataFrame(stretches, columns=["job", "method", "stage", "first", "iteration", "losses"])
    table["losses"] = [json.dumps(parts) for parts in table["losses"]]
    table = table.assign(dataset="d", scene="a", preset="quick", seed=0, **settings(""))
    return training.losses(training.steps({"curve": curve, "losses": table}))


def tradeoff_data(maker, column="size_bytes"):
    """What the chart of PSNR against a column shows."""
    return data.tradeoff(maker.report().at_shared_seeds, column)


def tradeoff(maker, column="size_bytes"):
    """The chart of PSNR against a column."""
    return kinds.tradeoff(tradeoff_data(maker, column), column, maker.report().models)


def rates(maker):
    """The panels of rate-distortion curves."""
    report = maker.report()
    return kinds.rate_curves(data.rate_panels(report.curves), report.models).panels


def sections(tables):
    """Anchor -> HTML of the sections with charts."""
    return {section.anchor: section.html for section in chart_sections(Report(tables))}


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
        assert set(data.pareto(points, better)) == alone


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
    assert [anchor for anchor in html if words in html[anchor]] == ["rate-distortion", "tradeoffs"]


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


def test_rate_curves_hold_the_numbers_and_single_sizes_are_marks(maker):
    rate_store(maker)
    (panel,) = rates(maker)
    assert [len(curve.x) for curve in panel.series] == [4, 4, 1]
    assert panel.series[0].x == pytest.approx([100 / 1024, 200 / 1024, 300 / 1024, 400 / 1024])
    assert panel.series[1].y == [33.5, 34.5, 35.5, 36.5]
    assert panel.x.log
    assert texts(panel) == {"HAC", "ECoNGS-R", "3DGS"}


def test_the_page_tells_bd_rates(maker):
    rate_store(maker)
    html = sections(maker.tables())["rate-distortion"]
    first = maker.report().differences[0]
    assert first.psnr == pytest.approx(0.5, abs=0.01)
    assert f"{first.rate:+.1f} %".replace("-", "\N{MINUS SIGN}") in html
    assert "33.50 to 36.00" in html


# --------------------------------------------------------------------------- training


def test_each_scene_of_a_joint_fit_has_its_curve():
    rows = [
        ("j", s, "econgs", i, float(i), p + i, None, "")
        for s, p in (("a", 30.0), ("b", 33.0))
        for i in (1, 2)
    ]
    assert [line.title for line in training.convergence(curve_table(rows), "iteration")["d"]] == ["a", "b"]


def test_of_many_fits_convergence_is_the_mean_of_each_method():
    rows = [
        (f"{method}{k}", f"s{k}", method, i, 2.0 * i, 30.0 + k + i, None, "")
        for method, last in (("econgs", 2), ("3dgs", 3))
        for k in range(13)
        for i in range(1, last + 1)
    ]
    lines = training.convergence(curve_table(rows), "iteration")["d"]
    assert [(line.title, line.x, line.y) for line in lines] == [
        ("ECoNGS-R", [1, 2], pytest.approx([37.0, 38.0])),
        ("3DGS", [1, 2, 3], pytest.approx([37.0, 38.0, 39.0])),
    ]
    few = curve_table([row for row in rows if row[1] < "s2"])
    assert len(training.convergence(few, "iteration")["d"]) == 10


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
    joint, single = training.anytime(curve_table(rows), results, "psnr")["d"]
    assert (joint.x, joint.y) == ([10.0, 20.0], [31.0, 32.0])
    assert (single.x, single.y) == ([10.0, 20.0], [26.0, 27.0])
    sizes = training.anytime(curve_table(rows), results, "bytes_estimate")["d"]
    assert [line.y for line in sizes] == [[1.0, 1.0], [4.0, 4.0]]


def test_anytime_weighs_scenes_and_a_finished_fit_keeps_its_value(maker):
    rows = [("j", s, "m", i, 3.0 * i, 30.0, None, "") for s in "abc" for i in (1, 2)]
    rows += [("k", "d", "m", 1, 1.0, 34.0, None, ""), ("k", "d", "m", 2, 5.0, 38.0, None, "")]
    (line,) = training.anytime(curve_table(rows), results_table(maker, m="abcd"), "psnr")["d"]
    assert line.x == [1.0, 2.0, 5.0]
    assert line.y == pytest.approx([31.0, 31.25, 32.0])


def test_anytime_says_where_scenes_are_missing(maker):
    rows = [("j", "a", "m", 1, 3.0, 30.0, None, "")]
    (line,) = training.anytime(curve_table(rows), results_table(maker, m="ab"), "psnr")["d"]
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
    assert [line.model.title for line in training.anytime(table, results, "psnr")["d"]] == shown
    assert [line.model.title for line in training.convergence(table, "iteration")["d"]] == shown
    assert [panel.title for panel in losses(table)] == shown


def test_time_to_quality_is_linear_between_evaluations():
    curve = training.Curve(Model("m"), "m", [10.0, 20.0, 40.0, 80.0], [31.0, 33.0, 32.5, 33.5])
    assert [training.time_to_quality(curve, level) for level in (30, 32, 34)] == [10.0, 15.0, None]


def test_loss_parts_without_figures_that_are_no_part_and_with_the_start_of_the_rate():
    early = json.dumps({"image": 0.02, "scale": 1e-9})
    late = json.dumps({"image": 0.01, "scale": 1e-9, "rate": 0.002, "bits per attribute": 3.0})
    rows = [
        ("j", s, "econgs", i, 1.0, 30.0, None, early if i < 300 else late) for s in "ab" for i in (100, 300)
    ]
    (panel,) = losses(curve_table(rows))
    assert [part.name for part in panel.parts] == ["loss", "image", "rate"]
    assert panel.parts[0].y == pytest.approx([0.02 + 1e-9, 0.012 + 1e-9])
    assert panel.marks == [(300.0, "rate first seen")]
    assert panel.small == ["scale"]
    assert kinds.losses([panel]).panels[0].stages == panel.marks


def test_parts_that_join_together_share_a_mark():
    late = json.dumps({"image": 0.01, "rate": 0.002, "masks": 0.001})
    early = json.dumps({"image": 0.02})
    rows = [("j", "a", "hac", i, 1.0, 30.0, None, early if i < 300 else late) for i in (100, 300)]
    (panel,) = losses(curve_table(rows))
    assert panel.marks == [(300.0, "rate, masks first seen")]


def test_losses_are_means_over_stretches_with_marks_where_stages_begin():
    steps = [("j", "a", "econgs", 100, 1.0, 30.0, None, json.dumps({"image": 9.0, "scale": 1.0}))]
    stretches = [
        (job, "econgs", stage, i - 9, i, {"loss": base + rate, "image": base, "rate": rate})
        for job, base in (("j", 0.02), ("k", 0.04))
        for stage, i, rate in (
            ("warm-up", 10, 0.0),
            ("growth", 20, 0.0),
            ("noise", 30, 0.01),
            ("noise", 40, 0.01),
        )
    ]
    (panel,) = losses(curve_table(steps), stretches)
    assert panel.marks == [(11.0, "growth"), (21.0, "noise")]
    loss, image, rate = panel.parts
    assert (loss.x, loss.y) == ([10.0, 20.0, 30.0, 40.0], pytest.approx([0.03, 0.03, 0.04, 0.04]))
    assert image.y == pytest.approx([0.03] * 4)
    assert rate.x == [30.0, 40.0]
    # A stage of a single step has a mark, with its neighbour, and no point.
    short = [("j", "m", stage, first, last, {"loss": loss, "image": loss}) for stage, first, last, loss in
             (("a", 1, 100, 1.0), ("b", 101, 101, 9.0), ("c", 102, 200, 1.0))]  # fmt: skip
    (panel,) = losses(curve_table([]), short)
    assert panel.marks == [(101.0, "b, c")]
    assert panel.parts[0].y == [1.0, 1.0]
    # A method that has none there is drawn from its steps.
    other = curve_table(
        [("m", "a", "hac", i, 1.0, 30.0, None, '{"image": 1.0, "scale": 0.5}') for i in (1, 2)]
    )
    assert [panel.title for panel in losses(other, stretches)] == ["ECoNGS-R", "HAC"]


# --------------------------------------------------------------------------- parts of a whole


def test_timing_is_shares_of_the_frame_and_the_rest_is_told():
    rows = [("frame", 0.010), ("decode", 0.002), ("shade", 0.0), ("rasterise", 0.005)]
    table = pd.DataFrame(rows, columns=["part", "seconds"]).assign(
        job="j", dataset="d", scene="a", method="econgs", variant="", rate=None, preset="quick", seed=0
    )
    (bar,), parts = data.timing(table)
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
    (bar,), _ = data.ledger(table("bytes", sizes))
    assert (bar.title, bar.total) == ("d · ECoNGS-R", 100.0)  # of two scenes: 80 and 120
    assert bar.percent("positions") == pytest.approx(30.0)
    times = [("ab", {"frame": 0.01, "decode": 0.004}), ("ab", {"frame": 0.02, "decode": 0.008})]
    (bar,), _ = data.timing(table("seconds", times))
    assert (bar.total_text, bar.percent("decode")) == ("15.0 ms", pytest.approx(40.0))


def test_no_timing_without_parts():
    table = pd.DataFrame({"part": ["frame"], "seconds": [0.01]}).assign(
        job="j", dataset="d", scene="a", method="plenoxels", variant="", rate=None, preset="quick", seed=0
    )
    assert data.timing(table) == ([], [])


# --------------------------------------------------------------------------- attributes


def features_table(count=60):
    """Values of two attributes in two scenes."""
    rng = np.random.default_rng(0)
    rows = [
        (scene, name, list(rng.normal(size=count * width)), width)
        for scene in "ab"
        for name, width in (("opacity", 1), ("features", 4))
    ]
    table = pd.DataFrame(rows, columns=["scene", "name", "values", "width"])
    return table.assign(job="j", dataset="d", method="econgs", preset="quick", **settings(""))


def test_histograms_pool_scenes_and_components():
    panels = features.histograms(features_table(9000))
    assert [panel.attribute for panel in panels] == ["opacity", "features"]
    shares = panels[1].shares[ECONGS]
    values = np.concatenate(features_table(9000).query("name == 'features'")["values"].to_list())
    counted, _ = np.histogram(values, panels[1].edges)
    assert shares == pytest.approx(100 * counted / len(values))


def test_scalings_of_offsets_and_of_gaussians_have_histograms_of_their_own():
    rows = np.concatenate([np.full((500, 3), 0.2), np.full((500, 3), 5.0)], axis=1)
    table = features_table().iloc[:1].assign(name="scalings", values=[rows.ravel().tolist()], width=6)
    offsets, gaussians = features.histograms(table)
    assert [one.attribute for one in (offsets, gaussians)] == ["scalings of offsets", "scalings of Gaussians"]
    assert offsets.edges[0] < 0.2 < offsets.edges[-1] < 1.0
    assert 4.0 < gaussians.edges[0] < 5.0 < gaussians.edges[-1]
    (explicit,) = features.histograms(table.assign(width=3))
    assert explicit.attribute == "scalings", "another method's"


def test_attributes_are_of_the_default_rate():
    rates = pd.concat([features_table().assign(**settings(v)) for v in ("", "rate_weight=0.01", "offsets=5")])
    assert list(features.histograms(rates)[0].shares) == [ECONGS, Model("econgs", "offsets=5")]


def test_an_attribute_that_is_the_same_everywhere_has_a_histogram():
    table = features_table().assign(values=[[1.0] * 5] * 4)
    assert sum(features.histograms(table)[0].shares[ECONGS]) == pytest.approx(100.0)


def test_without_umap_the_reason_is_told(maker):
    maker.run(method="econgs", views=0)
    tables = maker.tables() | {"features": features_table()}
    with patch.dict(sys.modules, {"umap": None}):
        html = sections(tables)["attributes"]
    assert "umap-learn is not installed" in html


def test_without_vectors_the_reason_is_told():
    with pytest.raises(features.Missing, match="no method of this report"):
        features.maps(features_table().query("name == 'opacity'"))


def test_an_embedding_is_split_by_scene():
    umap = Mock()
    umap.UMAP.return_value.fit_transform = lambda values: values[:, :2]
    with patch.dict(sys.modules, {"umap": umap}):
        (anchors,) = features.maps(features_table())
    (panel,) = kinds.feature_maps([anchors]).panels
    first = np.reshape(features_table()["values"].iloc[1], (-1, 4))[:, :2]
    assert np.array_equal(anchors.scenes["a"], first)
    assert [scene.title for scene in panel.series] == ["a", "b"]
    assert panel.series[0].x == first[:, 0].tolist()


# --------------------------------------------------------------------------- sections


def test_sections_of_a_normal_store(maker):
    """One rate, no parts of the loss, no times of parts, one seed and number of views."""
    fill(maker, "normal")
    assert list(sections(maker.tables())) == [
        "confidence", "anytime", "convergence", "ledger"
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
    panels = training.anytime(report.tables["curve"], report.results, "psnr")
    (panel, *_) = kinds.lines(panels, "", "", report.models).panels
    assert texts(panel) == {"3DGS (1 of 2 scenes)", "ECoNGS-R"}
