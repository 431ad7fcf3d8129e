"""Models beside the compressed volume: bytes at equal PSNR, where curves cross, and the section."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from econgs_bench.reports.charts.lines import Line, lines
from econgs_bench.reports.charts.tradeoff import tradeoff_chart
from econgs_bench.reports.curves import Curve, Point
from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.order import family
from econgs_bench.reports.sections.section import Page, to_html
from econgs_bench.reports.sections.tradeoffs.table import tradeoffs
from econgs_bench.reports.sections.volumes.conclusion import conclusion, over_grids, payoffs
from econgs_bench.reports.sections.volumes.section import section
from econgs_bench.reports.style import Model


def curve(method, size, psnr, options=""):
    points = (Point("", b, q, {}) for b, q in zip(size, psnr, strict=True))
    return Curve("d", Model(method, options), tuple(points))


VOLUME = curve("sz3", [1e3, 1e4, 1e5], [20.0, 40.0, 90.0])


@pytest.mark.parametrize(
    ("size", "psnr", "needed", "bound", "pays"),
    [
        (1e4, 30.0, 10**3.5, "", False),
        (1e3, 30.0, 10**3.5, "", True),
        (1e6, 65.0, 10**4.5, "", False),
        (5e2, 15.0, 1e3, "below", False),  # a smaller volume may do
        (5e2, 20.0, 1e3, "", True),
        (1e4, 95.0, 1e5, "above", True),
    ],
)
def test_bytes_of_the_volume_at_the_psnr_of_a_model(size, psnr, needed, bound, pays):
    (one,) = payoffs({"d": [VOLUME, curve("3dgs", [size], [psnr])]})
    assert one.needed == pytest.approx(needed)
    assert (one.bound, one.pays, one.meeting) == (bound, pays, None)


def test_a_volume_is_judged_in_the_drawing_nearest_the_truth():
    """A ray through the centre of a pixel cannot reach a truth of means, however many bytes it has."""
    points = curve("sz3", [1e3, 1e4, 1e5], [20.0, 29.0, 29.0])
    means = curve("sz3", [1e3, 1e4, 1e5], [20.0, 40.0, 55.0], "samples=16")
    for volumes in ([points, means], [means, points]):
        (one,) = payoffs({"d": [*volumes, curve("3dgs", [1e4], [30.0])]})
        assert one.volume is means
        assert one.needed == pytest.approx(10**3.5)
        assert not one.pays


def test_curves_meet_where_dense_samples_of_them_do():
    model = curve("hac", [2e3, 8e3, 6e4], [36.0, 39.0, 41.0])
    (one,) = payoffs({"d": [VOLUME, model]})
    sizes = np.geomspace(2e3, 6e4, 100_001)
    v, m = (
        np.interp(np.log(sizes), np.log([p.bytes for p in c.points]), [p.psnr for p in c.points])
        for c in (VOLUME, model)
    )
    first = int(np.argmax(v >= m))
    assert 0 < first < len(sizes) - 1
    assert one.meeting == pytest.approx((sizes[first], v[first]), rel=1e-3)
    (never,) = payoffs({"d": [VOLUME, curve("hac", [2e3, 8e3], [36.0, 39.5])]})
    assert never.meeting is None


def test_two_volumes_or_two_models_alone_are_no_question(maker):
    assert payoffs({"d": [VOLUME, curve("zfp", [1e4], [30.0])]}) == []
    maker.run(method="3dgs", views=0)
    maker.run(method="econgs", views=0)
    report = Report(maker.tables())
    assert section(Page(report, family(report))) is None


def test_the_section_of_a_page(maker):
    for rate, psnr, size, fps in (
        (0.1, 25.0, 1 << 18, 50.0),
        (0.01, 35.0, 1 << 20, 40.0),
        (1e-4, 97.0, 4 << 20, 20.0),
    ):
        maker.run(method="sz3", rate=rate, psnr=psnr, size=size, fps=fps, views=0)
    maker.run(method="3dgs", psnr=30.0, size=1 << 20, fps=200.0, views=0)
    maker.run(method="econgs", psnr=31.0, size=1 << 16, fps=100.0, views=0)
    report = Report(maker.tables())
    found = section(Page(report, family(report)))
    assert found.answer == ["vortex: ECoNGS-R smaller than the SZ3 volume at equal PSNR."]
    html = to_html(found)
    for cell in ("0.50", "2", "5.0"):  # MiB at 30 dB, ratio, ms
        assert f">{cell}<" in html


def test_every_chart_of_quality_keeps_models_apart_beside_the_volume(maker):
    """Of models of 30 and 31 dB and codecs of 25 to 97 dB: no chart has the models within a hundredth."""
    for rate, psnr in ((0.1, 25.0), (0.01, 45.0), (1e-4, 97.0)):
        for codec in ("sz3", "zfp"):
            maker.run(method=codec, rate=rate, psnr=psnr, size=int(1e5 / psnr), views=0)
    for method in ("3dgs", "hac"):
        for rate, psnr in ((1, 30.0), (2, 31.0)):
            maker.run(method=method, rate=rate, psnr=psnr, size=rate << 20, views=0)
    report = Report(maker.tables())
    size = tradeoffs(report.at_shared_seeds, "size_bytes")
    curves = [
        Line(
            curve.model,
            curve.title,
            [size / 2**20 for size, _ in curve.spots],
            [psnr for _, psnr in curve.spots],
        )
        for curve in report.curves["vortex"]
    ]
    charts = [
        tradeoff_chart(size, report.models),
        lines({"vortex": curves}, "views", "PSNR [dB]", report.models),
    ]
    for chart in charts:
        axis = chart.panels[0].y
        drawn = [value for series in chart.panels[0].series if series.title for value in series.y]
        assert (min(drawn), max(drawn)) == (25.0, 97.0)
        assert all(0 < axis.share(value) < 1 for value in drawn)
        assert axis.share(31.0) - axis.share(30.0) > 0.08


def grids(method, ratios):
    """A model of 30 dB on each grid, whose bytes are so many times those of the volume."""
    return {
        f"field@{n}": [
            replace(VOLUME, dataset=f"field@{n}"),
            replace(curve(method, [ratio * 10**3.5], [30.0]), dataset=f"field@{n}"),
        ]
        for n, ratio in ratios.items()
    }


@pytest.mark.parametrize(
    ("ratios", "says"),
    [
        ({64: 4.0, 128: 0.25}, "3DGS from about 91³ on"),
        ({64: 0.5, 128: 2.0, 256: 0.5}, "3DGS from about 181³ on"),
        ({64: 0.5, 128: 0.25}, "3DGS on all"),
        ({64: 8.0, 128: 2.0}, "3DGS on none"),
    ],
)
def test_from_which_grid_on_a_model_is_smaller_than_the_volume(ratios, says):
    (sentence,) = conclusion(payoffs(grids("3dgs", ratios)))
    assert says in sentence
    least, most = min(ratios), max(ratios)
    assert f"field, SZ3 volume: smaller at equal PSNR, of grids from {least}³ to {most}³" in sentence
    share = 1 / ratios[most]
    weighs = f"as much as {share:.1f} models" if share > 1 else "less than one model"
    assert f"the volume weighs {weighs} of 3DGS." in sentence
    ((title, [line]),) = over_grids(payoffs(grids("3dgs", ratios))).items()
    assert (title, line.x, line.y) == ("field, SZ3 volume", sorted(ratios), pytest.approx([*ratios.values()]))


def beyond(method, sizes, psnr=15.0):
    """A model on each grid that the smallest volume measured surpasses (at 95 dB: that none reaches)."""
    return {
        f"field@{n}": [replace(curve(method, [size], [psnr]), dataset=f"field@{n}")]
        for n, size in sizes.items()
    }


@pytest.mark.parametrize(
    ("sizes", "psnr", "says"),
    [
        ({64: 2e3, 128: 4e3}, 15.0, "3DGS on none. On the largest grid the volume "
         "weighs less than one model of 3DGS"),
        ({64: 2e5, 128: 1e4}, 95.0, None),  # the volume would have to be larger: by how much is open
        ({64: 2e4, 128: 1e4}, 95.0, "3DGS on all. On the largest grid the volume "
         "weighs as much as at least 10.0 models of 3DGS"),
        ({64: 5e2, 128: 4e3}, 15.0, None),
    ],
)  # fmt: skip
def test_a_model_that_the_volume_surpasses_at_every_size_is_known_not_to_pay(sizes, psnr, says):
    rows = {name: [replace(VOLUME, dataset=name), *own] for name, own in beyond("3dgs", sizes, psnr).items()}
    sentences = conclusion(payoffs(rows))
    if says is None:
        assert not any("grids" in one for one in sentences)
    else:
        (sentence,) = sentences
        assert says in sentence


def test_models_of_one_answer_are_named_together():
    rows = grids("econgs", {64: 4.0, 128: 0.25})
    for name, own in beyond("3dgs", {64: 2e3, 128: 2e3}).items():
        rows[name] += own
    for name, own in beyond("hac", {64: 2e3, 128: 2e3}).items():
        rows[name] += own
    (sentence,) = conclusion(payoffs(rows))
    assert "ECoNGS-R from about 91³ on; 3DGS, HAC on none" in sentence


def test_a_grid_whose_name_says_none_has_that_of_the_volume():
    """The smallest grid of a formula is often its usual one, "field" and not "field@64"."""
    own = grids("3dgs", {64: 4.0, 128: 0.25})
    own["field"] = [replace(one, dataset="field") for one in own.pop("field@64")]
    assert over_grids(payoffs(own)) == {}
    ((title, [line]),) = over_grids(payoffs(own, {"field": 64.0})).items()
    assert (title, line.x) == ("field, SZ3 volume", [64.0, 128.0])
    rest = {"field, 6 views": own["field"], "field@128, 6 views": own["field@128"]}
    assert [*over_grids(payoffs(rest, {"field": 64.0}))] == ["field, 6 views, SZ3 volume"]


def test_a_grid_alone_and_what_the_curve_does_not_reach_make_no_line():
    assert over_grids(payoffs(grids("3dgs", {64: 2.0}))) == {}
    far = grids("3dgs", {64: 2.0, 128: 1.0})
    far["field@128"][1] = replace(curve("3dgs", [1e3], [95.0]), dataset="field@128")
    assert over_grids(payoffs(far)) == {}
