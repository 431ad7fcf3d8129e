"""What models spend on scenes: needs for a quality, the worth of a KiB, what could go, and their section."""

import pytest

from econgs_bench.reports.curves import Curve, Point
from econgs_bench.reports.report import Report
from econgs_bench.reports.schema import PRUNED
from econgs_bench.reports.sections.economy import conclusion as economy
from econgs_bench.reports.style import MISSING, Model
from tests.reports.page.test_page import page


def curve(*points):
    """A curve of (bytes, PSNR, primitives)."""
    rows = tuple(Point("", size, psnr, {"primitives": count}) for size, psnr, count in points)
    return Curve("d", Model("m"), rows)


SLOPE = curve((1000.0, 30.0, 100), (4000.0, 34.0, 400), (16000.0, 35.0, 400))


@pytest.mark.parametrize(
    ("level", "need"),
    [
        (32.0, (2000.0, 200.0, False)),  # in the middle of the logarithms
        (34.0, (4000.0, 400.0, False)),
        (34.5, (8000.0, 400.0, False)),
        (30.0, (1000.0, 100.0, False)),
        (29.0, (1000.0, 100.0, True)),
    ],
)
def test_needs_are_interpolated_between_neighbours(level, need):
    found = economy.need(SLOPE, level)
    assert (found.bytes, found.primitives) == pytest.approx(need[:2])
    assert found.bound is need[2]


def test_a_quality_beyond_the_curve_has_no_need():
    assert economy.need(SLOPE, 35.01) is None
    assert economy.need(curve((1000.0, 30.0, 100)), 31.0) is None


def test_the_first_model_that_reaches_a_quality_counts_on_a_curve_that_bends_back():
    found = economy.need(
        curve((1000.0, 30.0, 1), (2000.0, 36.0, 1), (4000.0, 32.0, 1), (8000.0, 38.0, 1)), 33.0
    )
    assert found.bytes == pytest.approx(1000.0 * 2.0**0.5)


def test_the_worth_of_a_kib_is_the_slope_between_neighbours():
    found = economy.gains(curve((1024.0, 30.0, 1), (2048.0, 33.0, 1), (2048.0, 34.0, 1), (6144.0, 32.0, 1)))
    assert found == pytest.approx((3.0, -0.5))


@pytest.fixture
def spent(maker):
    """Two methods on three scenes of volumes that take 10, 100 and 1000 KiB, and on one that has none."""
    for power, name in enumerate(("a", "b", "c"), 1):
        kib = 1024 * 10**power
        for weight, psnr, times in (("", 36.0, 4), ("rate_weight=0.1", 34.0, 1)):
            shares = dict.fromkeys(PRUNED, 0.25) if weight == "" else {}
            maker.run(name, "tf", "hac", weight, psnr=psnr, size=kib * times // 8,
                      gaussians=1000 if shares else None, **shares)  # fmt: skip
        maker.run(name, "tf", "3dgs", psnr=45.0, size=kib, gaussians=2000, **dict.fromkeys(PRUNED, 0.5))
        maker.rows["complexity"].append({"job": f"c-{name}", "dataset": name, "scene": "tf", "voxels": 8,
                                         "lossless_bytes": kib, "coder": "none"})  # fmt: skip
    maker.run("views", "tf", "hac", psnr=33.0, size=1024)
    maker.rows["complexity"].append({"job": "c-views", "dataset": "views", "scene": "tf", "voxels": 8})
    return maker.tables()


def test_economies_of_scenes(spent):
    rows = {(one.scene, one.model.title): one for one in economy.of_report(Report(spent))}
    hac = rows["b/tf", "HAC"]
    assert hac.volume == 102_400
    assert hac.needs[35.0].bytes == pytest.approx(102_400 / 4)  # between an eighth and a half
    assert hac.ratio(35.0) == pytest.approx(0.25)
    assert hac.bytes_text(35.0) == "25.0 (0.25 \N{MULTIPLICATION SIGN})"
    assert hac.bytes_text(30.0) == "\N{LESS-THAN OR EQUAL TO} 12.5 (0.12 \N{MULTIPLICATION SIGN})"
    assert (hac.bytes_text(40.0), hac.primitives_text(40.0)) == (MISSING, MISSING)
    assert hac.gains_text() == "0.053"  # 2 dB in 37.5 KiB
    assert (hac.gaussians, hac.prunable_text("prunable_010")) == (1000, "25.0")
    pictures = rows["views/tf", "HAC"]
    assert (pictures.volume, pictures.ratio(30.0), pictures.gaussians) == (None, None, None)
    assert pictures.bytes_text(30.0) == "\N{LESS-THAN OR EQUAL TO} 1.0"
    assert (pictures.gains_text(), pictures.prunable_text("prunable_010")) == (MISSING, MISSING)


def test_the_conclusion_names_who_is_cheapest_who_grows_and_who_has_to_spare(spent):
    assert economy.conclusion(economy.of_report(Report(spent))) == (
        "Fewest bytes for 35 dB, of the sizes measured, on 3 scenes that several methods reach it on: HAC on "
        "3. Where the volume takes ten times the bytes, models for 35 dB take so many times: HAC 10. Share "
        "of Gaussians that could go at 0.1 dB, mean over 3 scenes: 3DGS 50 %, HAC 25 %."
    )


def test_growth_is_not_told_of_volumes_within_a_factor_of_ten(spent):
    spent["complexity"]["lossless_bytes"] **= 0.45  # two decades become 0.9
    assert "ten times the bytes" not in economy.conclusion(economy.of_report(Report(spent)))


def test_the_page_has_them(spent, maker):
    source, _ = page(maker, tables=spent)
    section = source[source.index('id="economy"') :]
    assert "25.0 (0.25 \N{MULTIPLICATION SIGN})" in section


def test_without_the_facts_there_is_no_section(maker):
    maker.run("a", "tf", "hac", psnr=34.0)
    tables = maker.tables()
    tables.pop("complexity")
    tables["results"] = tables["results"].drop(columns=["gaussians", *PRUNED])
    assert 'id="economy"' not in page(maker, tables=tables)[0]
