"""What is told of failures, seeds and few views, and of scenes of known complexity."""

import pytest

from econgs_bench.reports.sections.order import charts
from econgs_bench.reports.sections.stability import table as stability
from econgs_bench.reports.tables.means import summary
from econgs_bench.reports.tables.protocols import by_training_views
from tests.reports.page.test_page import page


@pytest.fixture
def few(maker):
    """Two methods from 6 and 42 views; one fails once from 6."""
    for views, seed, psnr in ((6, 0, 20.0), (6, 1, 22.0), (42, 0, 30.0), (42, 1, 31.0)):
        status = "diverged" if (views, seed) == (6, 1) else "ok"
        maker.run("bubble", seed=seed, psnr=psnr, requested_views=views)
        maker.run("bubble", method="hac", seed=seed, psnr=psnr + 1, requested_views=views, status=status)
    maker.run(dataset="vortex", psnr=33.0)
    return maker.tables()


def test_fits_from_other_numbers_of_views_are_not_averaged(few) -> None:
    mixed = few["results"]
    apart = by_training_views(few)
    datasets = ["bubble, 6 views", "bubble, 42 views", "vortex"]
    assert list(dict.fromkeys(apart["results"]["dataset"])) == datasets
    assert list(dict.fromkeys(mixed["dataset"])) == ["bubble", "vortex"]  # what was given stays
    rows = summary(apart["results"])
    means = {row.dataset: row.psnr for row in rows[rows["method"] == "3dgs"].itertuples()}
    assert means == pytest.approx({"bubble, 6 views": 21.0, "bubble, 42 views": 30.5, "vortex": 33.0})
    for name in ("views", "ledger"):
        assert set(apart[name]["dataset"]) == set(apart["results"]["dataset"])
        assert len(apart[name]) == len(few[name])


@pytest.mark.parametrize("other", [{"dataset": "other"}, {"preset": "standard"}])
def test_datasets_with_one_number_of_views_per_preset_keep_their_names(maker, other) -> None:
    maker.run(requested_views=42)
    maker.run(requested_views=12, **other)
    tables = maker.tables()
    assert by_training_views(tables)["results"].equals(tables["results"])


def test_few_views_leave_out_what_failed(few) -> None:
    panels = stability.few_views(by_training_views(few)["results"])
    assert list(panels) == ["bubble"]
    lines = {line.title: (line.x, line.y) for line in panels["bubble"]}
    assert lines == {"3DGS": ([6.0, 42.0], [21.0, 30.5]), "HAC": ([42.0], [31.5])}


def test_few_views_compare_the_same_scenes(maker) -> None:
    for views, scene, psnr in ((6, "a", 20.0), (42, "a", 30.0), (42, "b", 10.0)):
        maker.run("bubble", scene, requested_views=views, psnr=psnr)
    (line,) = stability.few_views(by_training_views(maker.tables())["results"])["bubble"]
    assert (line.x, line.y) == ([6.0, 42.0], [20.0, 30.0])


def test_records_tell_failures_seeds_and_worst_views(few) -> None:
    apart = by_training_views(few)
    records = {(r.dataset, r.title): r for r in stability.records(apart["results"], apart["views"])}
    ours = records["vortex", "3DGS"]
    # views of the fixture: psnr + 2, + 1, 0, - 1, - 2
    assert (ours.rows, ours.failed, ours.seed_gap) == (1, {}, None)
    assert (ours.view_gap, ours.lowest) == (pytest.approx(2.0), pytest.approx(31.0))
    assert records["bubble, 6 views", "3DGS"].seed_gap == pytest.approx(2.0)
    assert records["bubble, 6 views", "HAC"].failed == {"diverged": 1}
    assert records["bubble, 6 views", "HAC"].seed_gap is None


def test_missing_and_excess_are_told_of_the_scene_that_is_worst_off(maker) -> None:
    for scene, missing in (("tf1", 0.004), ("tf2", 0.1432)):
        maker.run(scene=scene, missing=missing, excess=0.02)
    maker.run(method="hac")
    tables = maker.tables()
    ours, other = stability.records(tables["results"], tables["views"])
    assert (ours.missing, ours.excess) == (pytest.approx(0.1432), pytest.approx(0.02))
    assert (other.missing, other.excess) == (None, None)
    assert ">14.3<" in page(maker, tables=tables)[0]


def test_families_need_three_members_that_differ_in_a_number() -> None:
    names = ["blobs_1", "blobs_64", "blobs_8", "vortex_views", "vortex_views_400", "mri_1", "mri_2", "x_0"]
    assert stability.families(names) == {"blobs": {"blobs_1": 1, "blobs_64": 64, "blobs_8": 8}}


def test_what_is_spent_over_complexity(maker) -> None:
    for count, size in ((8, 2 << 20), (1, 1 << 20), (64, 4 << 20)):
        maker.run(dataset=f"blobs_{count}", size=size, psnr=30.0 + count)
        status = "failed" if count == 8 else "ok"
        maker.run(dataset=f"blobs_{count}", method="econgs", size=size // 4, status=status)
    results = maker.tables()["results"]
    sizes = {line.title: (line.x, line.y) for line in stability.by_complexity(results, "size_bytes")["blobs"]}
    assert sizes == {"3DGS": ([1.0, 8.0, 64.0], [1.0, 2.0, 4.0]), "ECoNGS-R": ([1.0, 64.0], [0.25, 1.0])}
    psnr = stability.by_complexity(results, "psnr")["blobs"]
    assert psnr[0].y == [31.0, 38.0, 94.0]


def test_other_rates_are_no_lines_over_complexity(maker) -> None:
    for count in (1, 8, 64):
        maker.run(dataset=f"blobs_{count}", method="veg")
        maker.run(dataset=f"blobs_{count}", method="veg", rate=16.0)
        maker.run(dataset=f"blobs_{count}", method="hac")
        maker.run(dataset=f"blobs_{count}", method="hac", variant="rate_weight=0.5")
        maker.run(dataset=f"blobs_{count}", method="ivr-gs", rate=16.0)
    lines = stability.by_complexity(maker.tables()["results"], "psnr")["blobs"]
    assert [line.title for line in lines] == ["VEG", "HAC", "iVR-GS @ 16"]


def test_page_and_files_show_both(few, maker, tmp_path) -> None:
    for count in (1, 8, 64):
        maker.run(dataset=f"blobs_{count}")
    source, _ = page(maker)
    assert 'id="stability"' in source
    assert 'id="complexity"' in source
    assert "1 of 2: diverged 1" in source
    drawn = dict(charts(maker.report()))
    assert {"few-views", "complexity-size", "complexity-primitives", "complexity-psnr"} <= drawn.keys()
    # the table to take away stays as it was measured
    assert "bubble, 6 views" not in (tmp_path / "results.csv").read_text(encoding="utf-8")
    assert "bubble, 6 views" in (tmp_path / "results.md").read_text(encoding="utf-8")


def test_a_model_of_nothing_has_no_place_on_a_logarithmic_axis(maker) -> None:
    for count in (1, 8, 64):
        maker.run(dataset=f"blobs_{count}", size=0 if count == 8 else 1 << 20)
    lines = stability.by_complexity(maker.tables()["results"], "size_bytes")["blobs"]
    assert lines[0].x == [1.0, 64.0]
    assert page(maker)
