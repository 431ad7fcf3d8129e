"""Unseen transfer functions: targets, bands, and their section of the page."""

from __future__ import annotations

import pytest

from econgs_bench.reports.report import Report
from econgs_bench.reports.sections.order import charts, family
from econgs_bench.reports.sections.section import Page
from econgs_bench.reports.sections.unseen import conclusion as unseen
from econgs_bench.reports.sections.unseen.section import section
from tests.reports.page.test_page import page


@pytest.fixture
def moved(maker):
    """A method that follows a bump and one that does not, on one dataset; another dataset has other edits."""

    def run(method, scene, edit, distance, psnr, **more):
        maker.run(
            scene=f"{scene} {edit}".strip(),
            kind="edited" if edit else "basic",
            edit=edit,
            distance=distance,
            method=method,
            psnr=psnr,
            **more,
        )

    for seed in (0, 1):
        for scene in ("a", "b"):
            run("3dgs", scene, "", None, 40.0 + seed, seed=seed)
            run("veg", scene, "", None, 35.0 + seed, seed=seed)
            for edit, distance, loss in (
                ("shift=0.1", 0.2, 6.0),
                ("width=2", 0.5, 9.0),
                ("shift=2", 1.0, 15.0),
            ):
                run("3dgs", scene, edit, distance, 40.0 + seed - loss, seed=seed)
                run("veg", scene, edit, distance, 34.0 + seed, seed=seed)
            run("3dgs", scene, "light=1,0,0", None, 0.0, seed=seed, status="refused", reason="no light")
    run("3dgs", "a", "opacity=2", 0.4, 30.0, dataset="other")
    run("3dgs", "a", "", None, 30.0, dataset="other")
    return maker


def test_targets_are_means_over_seeds_of_datasets_with_moved_bumps(moved):
    found = unseen.targets(Report(moved.tables()).results)
    assert {one.panel for one in found} == {"vortex"}
    assert len(found) == 2 * 2 * 4
    first = next(one for one in found if one.name == "a shift=0.1" and one.model.method == "3dgs")
    assert (first.psnr, first.distance, first.band) == (34.5, 0.2, unseen.BANDS[1][1])
    assert next(one for one in found if one.name == "a").band == "trained"


def test_bands_are_means_over_what_all_methods_have(moved):
    moved.run(scene="a shift=9", kind="edited", edit="shift=9", distance=0.25, method="3dgs", psnr=1.0)
    found = unseen.targets(Report(moved.tables()).results)
    means = {one.method: own for one, own in unseen.band_means(found, "vortex").items()}
    assert [own[1] for own in means["3dgs"].values()] == [40.5, 34.5, 31.5, 25.5]
    assert [own[1] for own in means["veg"].values()] == [35.5, 34.5, 34.5, 34.5]


def test_the_conclusion_names_a_leader_by_distance(moved):
    text = unseen.conclusion(unseen.targets(Report(moved.tables()).results))
    assert text.startswith(
        "vortex, highest mean PSNR by distance of the transfer function: on trained ones 3DGS (40.5 dB"
    )
    assert "3DGS and " in text  # level in the second band
    assert "beyond" in text.split(";")[-1]
    assert "34.5 dB, 3DGS 25.5" in text.split(";")[-1]


def test_the_page_has_the_section_where_bumps_were_moved(moved):
    source, _ = page(moved)
    html = source[source.index('id="unseen"') :]
    assert "Unseen transfer functions" in html
    assert "unseen-psnr" in dict(charts(moved.report()))


def test_other_edits_make_no_section(maker):
    maker.run(scene="a opacity=2", kind="edited", edit="opacity=2", distance=0.4)
    maker.run(scene="a")
    report = Report(maker.tables())
    assert section(Page(report, family(report))) is None


def test_means_are_of_the_seeds_that_all_models_have(moved):
    for edit, distance in (("", None), ("shift=0.1", 0.2)):
        moved.run(scene=f"a {edit}".strip(), kind="edited" if edit else "basic", edit=edit, distance=distance,
                  method="veg", psnr=1.0, seed=2)  # fmt: skip
    found = unseen.targets(Report(moved.tables()).results)
    assert [one.psnr for one in found if one.name == "a shift=0.1"] == [34.5, 34.5]
