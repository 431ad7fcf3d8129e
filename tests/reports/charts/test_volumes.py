"""Models beside the compressed volume: bytes at equal PSNR, where curves cross, and the section."""

from __future__ import annotations

import numpy as np
import pytest

from econgs_bench.reports.charts import data, kinds, training
from econgs_bench.reports.charts.report import Report
from econgs_bench.reports.charts.volumes import volumes_chart, volumes_section
from econgs_bench.reports.conclusions.volumes import verdicts
from econgs_bench.reports.curves import Curve, Point
from econgs_bench.reports.style import MIB, Model


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
        (1e4, 95.0, 1e5, "above", True),
    ],
)
def test_bytes_of_the_volume_at_the_psnr_of_a_model(size, psnr, needed, bound, pays):
    (one,) = verdicts({"d": [VOLUME, curve("3dgs", [size], [psnr])]})
    assert one.needed == pytest.approx(needed)
    assert (one.bound, one.pays, one.meeting) == (bound, pays, None)


def test_a_volume_is_judged_in_the_drawing_nearest_the_truth():
    """A ray through the centre of a pixel cannot reach a truth of means, however many bytes it has."""
    points = curve("sz3", [1e3, 1e4, 1e5], [20.0, 29.0, 29.0])
    means = curve("sz3", [1e3, 1e4, 1e5], [20.0, 40.0, 55.0], "samples=16")
    for volumes in ([points, means], [means, points]):
        (one,) = verdicts({"d": [*volumes, curve("3dgs", [1e4], [30.0])]})
        assert one.volume is means
        assert one.needed == pytest.approx(10**3.5)
        assert not one.pays


def test_curves_meet_where_dense_samples_of_them_do():
    model = curve("hac", [2e3, 8e3, 6e4], [36.0, 39.0, 41.0])
    (one,) = verdicts({"d": [VOLUME, model]})
    sizes = np.geomspace(2e3, 6e4, 100_001)
    v, m = (
        np.interp(np.log(sizes), np.log([p.bytes for p in c.points]), [p.psnr for p in c.points])
        for c in (VOLUME, model)
    )
    first = int(np.argmax(v >= m))
    assert 0 < first < len(sizes) - 1
    assert one.meeting == pytest.approx((sizes[first], v[first]), rel=1e-3)
    (never,) = verdicts({"d": [VOLUME, curve("hac", [2e3, 8e3], [36.0, 39.5])]})
    assert never.meeting is None


def test_two_volumes_or_two_models_alone_are_no_question(maker):
    assert verdicts({"d": [VOLUME, curve("zfp", [1e4], [30.0])]}) == []
    maker.run(method="3dgs", views=0)
    maker.run(method="econgs", views=0)
    assert volumes_section(Report(maker.tables())) is None


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
    section = volumes_section(report)
    assert "vortex: ECoNGS-R smaller than the SZ3 volume at equal PSNR." in section.html
    quality, costs = section.charts["volumes"].panels
    lines = {series.title: series for series in quality.series}
    assert max(lines["SZ3 volume"].y) == 97.0  # whole: not cut above the best model
    assert quality.y.high > 97.0
    assert quality.y.share(31.0) - quality.y.share(30.0) > 0.08  # and the models are apart, not by 0.01
    assert lines["3DGS"].x == [1.0]
    marks = {series.title: series for series in costs.series}
    assert marks["SZ3 volume"].y == pytest.approx([20.0, 25.0, 50.0])
    assert marks["3DGS"].x == pytest.approx([(700 << 20) / MIB])
    for cell in ("0.50", "2", "5.0"):  # MiB at 30 dB, ratio, ms
        assert f">{cell}<" in section.html


def test_crossings_are_marked():
    model = curve("hac", [2e3, 8e3, 6e4], [36.0, 39.0, 41.0])
    curves = {"d": [VOLUME, model]}
    found = verdicts(curves)
    (panel,) = volumes_chart(curves, found, [Model("sz3"), Model("hac")]).panels
    (cross,) = [series for series in panel.series if "passes" in series.title]
    assert cross.title == "SZ3 volume passes HAC"
    assert cross.x == [found[0].meeting[0] / MIB]


def test_every_chart_of_quality_keeps_models_apart_beside_the_volume(maker):
    """Of models of 30 and 31 dB and codecs of 25 to 97 dB: no chart has the models within a hundredth."""
    for rate, psnr in ((0.1, 25.0), (0.01, 45.0), (1e-4, 97.0)):
        for codec in ("sz3", "zfp"):
            maker.run(method=codec, rate=rate, psnr=psnr, size=int(1e5 / psnr), views=0)
    for method in ("3dgs", "hac"):
        for rate, psnr in ((1, 30.0), (2, 31.0)):
            maker.run(method=method, rate=rate, psnr=psnr, size=rate << 20, views=0)
    report = Report(maker.tables())
    size = data.tradeoff(report.at_shared_seeds, "size_bytes")
    lines = [
        training.Curve(curve.model, curve.title, curve.mebibytes, [point.psnr for point in curve.points])
        for curve in report.curves["vortex"]
    ]
    charts = [
        kinds.tradeoff(size, "size_bytes", report.models),
        kinds.rate_curves(data.rate_panels(report.curves), report.models),
        kinds.lines({"vortex": lines}, "views", "PSNR [dB]", report.models),
        volumes_chart(report.curves, verdicts(report.curves), report.models),
    ]
    for chart in charts:
        axis = chart.panels[0].y
        drawn = [value for series in chart.panels[0].series if series.title for value in series.y]
        assert (min(drawn), max(drawn)) == (25.0, 97.0)
        assert all(0 < axis.share(value) < 1 for value in drawn)
        assert axis.share(31.0) - axis.share(30.0) > 0.08
