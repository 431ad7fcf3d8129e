"""Tables in the paper's layout, and its claims held against them."""

from __future__ import annotations

import json
import re

import numpy as np
import pandas as pd
import pytest

from econgs_bench.reports.comparability import replaced
from econgs_bench.reports.schema import frame
from econgs_bench.reports.sections.paper import tables
from econgs_bench.reports.sections.paper.documents import to_html, to_latex, to_markdown, to_text
from econgs_bench.reports.sections.paper.layouts import layouts, reference_rows
from econgs_bench.reports.sections.paper.marks import SEEDS_NOTE
from econgs_bench.reports.statistics import Views

SCENES = ("TF01", "TF02", "TF03", "TF04")


def row(method="econgs", scene="TF01", psnr=36.0, **changed):
    values = {
        "dataset": "vortex_views", "scene": scene, "kind": "basic", "method": method, "variant": "",
        "preset": "paper", "split": "test", "seed": 0, "status": "ok", "psnr": psnr, "fps": 100.0,
        "size_bytes": 2**19, "train_seconds": 120.0, "primitives": 1000, "group": "g", "train_views": 92,
        "requested_views": 92, "width": 200, "height": 200, "machine": "x",
    }  # fmt: skip
    values |= changed
    return {"job": f"{method}-{values['variant']}-{scene}-{values['seed']}"} | values


def results(*rows):
    return frame("results", rows)


def four(method, psnr, **changed):
    return [row(method, scene, psnr + i, **changed) for i, scene in enumerate(SCENES)]


def paper_tables(rows, views=None, **others):
    return tables.paper_tables({"results": rows, **others}, Views(views))


def table(tables, name):
    return next(one for one in tables if one.name == name)


def blocks(rows, name="univariate", views=None, **others):
    """The blocks of a table."""
    return table(paper_tables(rows, views, **others), name).blocks


def line(block, label):
    return next(one for one in block.rows if one.label == label)


def test_measured_values_stand_beside_the_published_ones_in_their_units():
    papers = paper_tables(results(*four("econgs", 35.0), *four("3dgs", 34.0, fps=300.0)))
    block = table(papers, "univariate").blocks[0]
    assert (block.dataset, block.published, block.same) == ("vortex_views", "vortex", True)
    ours = line(block, "ECoNGS-R").values
    assert ours["psnr"].mean == pytest.approx(36.5)
    assert ours["psnr"].published == 36.74
    assert ours["train_seconds"].mean == pytest.approx(8.0)  # minutes of all scenes together
    assert ours["train_seconds"].published == 9.32
    assert ours["size_bytes"].mean == pytest.approx(2.0)  # MiB, sum
    assert line(block, "HAC").values["psnr"].mean is None
    assert line(block, "HAC").values["psnr"].published == 26.74
    text = to_text(table(papers, "univariate"))
    assert "36.74 (-0.24)" in text


def test_seeds_give_a_spread_and_an_incomplete_seed_is_named():
    rows = [*four("econgs", 35.0), *four("econgs", 36.0, seed=1), *four("econgs", 50.0, seed=2)[:3]]
    block = blocks(results(*rows))[0]
    ours = line(block, "ECoNGS-R")
    assert ours.values["psnr"].mean == pytest.approx(37.0)
    assert ours.values["psnr"].spread == pytest.approx(0.5**0.5)
    assert ours.note == "seed 2: TF04 not run"
    assert set(ours.jobs) == {one["job"] for one in rows[:8]}
    assert "37.00 ± 0.71" in to_markdown(table(paper_tables(results(*rows)), "univariate"))


def test_rows_of_a_method_are_of_the_seeds_that_all_of_them_have():
    ours = [one for seed, psnr in ((0, 33.0), (1, 30.0)) for one in four("econgs", psnr, seed=seed)]
    plain = four("econgs", 32.0, variant="view_direction=true")
    others = four("3dgs", 31.0, seed=1)
    tables = paper_tables(results(*ours, *plain, *others))
    design, univariate = table(tables, "design").blocks[0], table(tables, "univariate").blocks[0]
    assert [r.values["psnr"].mean for r in design.rows if r.jobs] == [33.5, 34.5]
    (remark,) = (remark for remark in design.remarks if "seed 0" in remark)
    assert "full ECoNGS-R, w/o view direction" in remark
    assert "w/o joint learning" not in remark, "it was not measured"
    assert line(univariate, "ECoNGS-R").values["psnr"].seeds == (34.5, 31.5)
    assert any("seeds differ: ECoNGS-R: 0, 1; 3DGS: 1" in remark for remark in univariate.remarks)
    apart = paper_tables(
        results(*ours[:4], *(one | {"seed": 1, "job": one["job"][:-1] + "1"} for one in plain))
    )
    block = table(apart, "design").blocks[0]
    assert [r.values["psnr"].mean for r in block.rows if r.jobs] == [33.5, 34.5]
    assert any("seeds differ: ECoNGS-R" in remark for remark in block.remarks)
    # Where methods are compared each keeps its seeds.
    literal = four("econgs", 32.0, variant="configuration=paper")
    block = blocks(results(*ours, *literal, *others))[0]
    assert line(block, "ECoNGS-R").values["psnr"].seeds == (34.5, 31.5)
    assert any("ECoNGS-R: 0, 1; ECoNGS (published): 0" in remark for remark in block.remarks)


def test_a_failed_scene_leaves_the_cells_empty():
    rows = [*four("econgs", 35.0)[:3], row(scene="TF04", psnr=None, status="failed"), *four("3dgs", 30.0)]
    block = blocks(results(*rows))[0]
    assert line(block, "ECoNGS-R").values["psnr"].mean is None
    assert line(block, "3DGS").values["psnr"].mean is not None


def test_other_data_than_the_papers_are_compared_with_no_published_difference():
    rows = [row(dataset="jet_flame", scene=f"mf_{i}") for i in range(9)]
    rows += [row(dataset="jet_flame", scene=f"mf_{i}", variant="joint=false", psnr=37.0) for i in range(9)]
    papers = paper_tables(results(*rows))
    block = table(papers, "joint-gain").blocks[0]
    assert (block.published, block.same) == ("combustion (MF)", False)
    assert "98,174 (" not in to_text(table(papers, "joint-gain"))
    assert "98,174" in to_text(table(papers, "joint-gain"))
    assert "design" in {one.name for one in papers}, "unknown data: beside the paper's only dataset"
    # A part of a dataset is not the dataset.
    assert not [one for one in paper_tables(results(*rows[:5])) if one.name == "univariate"]


def test_one_row_without_published_values_is_no_table():
    assert paper_tables(results(row(dataset="nucleon"))) == []
    assert paper_tables(results()) == []


def test_tables_of_other_questions_are_not_filled_with_what_happens_to_fit():
    rows = [one for m in ("econgs", "ivr-gs") for one in four(m, 35.0)]
    assert {one.name for one in paper_tables(results(*rows))} == {"univariate", "clustering"}
    fewer = [one for m in ("econgs", "ivr-gs") for one in four(m, 30.0, train_views=12, requested_views=12)]
    few = [one | {"dataset": "argon_bubble_like"} for one in [*rows, *fewer] if one["scene"] in SCENES[:2]]
    assert {one.name for one in paper_tables(results(*few))} == {"limited-views"}
    ours = [one | {"dataset": "cth_impact"} for one in rows]
    assert {one.name for one in paper_tables(results(*ours))} == {"multivariate"}
    for other in ("vis_male", "shells", "csafe_heptane", "mine.nrrd"):
        assert paper_tables(results(*(one | {"dataset": other} for one in rows))) == []
    part = [one for one in rows if one["scene"] in SCENES[:2]]
    assert paper_tables(results(*part)) == [], "two of vortex' four scenes are not vortex"


def test_scenes_and_their_composition_have_lines_of_their_own():
    rows = [
        row(dataset="vortices_fuzzy", scene="blue_fog", psnr=40.0),
        row(dataset="vortices_fuzzy", scene="red_fog", psnr=42.0),
        row(dataset="vortices_fuzzy", scene="all", kind="composed", psnr=39.0),
    ]
    (fuzzy,) = paper_tables(results(*rows))
    assert fuzzy.name == "fuzzy"
    values = {one.label: one.values["psnr"] for one in fuzzy.blocks[0].rows}
    assert {label: (one.mean, one.published) for label, one in values.items()} == {
        "blue": (40.0, 47.12), "red": (42.0, 50.77), "composed": (39.0, 45.84),
    }  # fmt: skip
    meshes = [row(m, f"s{i}", dataset="mesh_fire_ug") for m in ("econgs", "3dgs") for i in range(8)]
    (block,) = table(paper_tables(results(*meshes)), "unstructured").blocks
    assert (block.published, block.same) == ("RPCOM", False)


def test_meshes_have_triangles_and_rendering_has_memory_of_its_own():
    """The paper's meshes are whole and plain; triangles are no anchors."""
    shared = {"dataset": "jet_flame_iso", "render_host_bytes": 2**29, "peak_host_bytes": 2**31}
    scenes = (("low", "basic", 1), ("middle", "basic", 1), ("high", "basic", 1), ("all", "composed", 2))
    models = (("mesh", "configuration=paper", 4_000_000), ("mesh", "", 2_000_000), ("econgs", "", 700))
    rows = [
        row(method, scene, variant=variant, primitives=count * times, kind=kind, **shared)
        for scene, kind, times in scenes
        for method, variant, count in models
    ]
    (block,) = blocks(results(*rows), "isosurface")
    assert block.published == "combustion (MF), isosurfaces"
    kinds = ("triangle mesh", "triangle mesh, reduced and coded", "ECoNGS-R")
    low, composed = ([line(block, f"{of}, {kind}").values for kind in kinds] for of in ("low", "composed"))
    assert [one["triangles"].mean for one in low] == [4.0, 2.0, None]
    assert [one["triangles"].published for one in low] == [17.1, None, None]
    assert [one["triangles"].mean for one in composed] == [8.0, 4.0, None]
    assert [one["triangles"].published for one in composed] == [53.9, None, None]
    assert not any("Triangles" in remark for remark in block.remarks)
    assert [one["render_host_bytes"].mean for one in low] == [0.5] * 3
    assert [one["render_host_bytes"].published for one in composed] == [4.92, None, 7.63]
    assert low[2]["render_host_bytes"].published == 7.61
    assert low[2]["render_device_bytes"].mean is None
    assert composed[0]["size_bytes"].published == 1002.9


def test_basic_scenes_and_compositions_of_veg():
    scenes = [f"t_{i}" for i in range(1, 5)]
    rows = [
        row(
            method, scene, psnr - loss, dataset="ionisation_like", kind=kind, fitted_scenes=json.dumps(scenes)
        )
        for method, psnr in (("econgs", 34.0), ("veg", 30.0))
        for scene, kind, loss in [*((one, "basic", 0.0) for one in scenes), ("t", "composed", 1.0)]
    ]
    (block,) = blocks(results(*rows), "veg")
    assert (block.published, block.same, block.count) == ("ionization (T)", False, 4)
    values = {one.label: one.values["psnr"] for one in block.rows}
    assert {label: (one.mean, one.published) for label, one in values.items()} == {
        "basic, VEG": (30.0, 30.38), "basic, ECoNGS-R": (34.0, 34.34),
        "composed, VEG": (29.0, 28.94), "composed, ECoNGS-R": (33.0, 33.45),
    }  # fmt: skip
    alone = [one for one in rows if one["method"] == "econgs"]
    assert not [one for one in paper_tables(results(*alone)) if one.name == "veg"]


def test_scenes_of_unrelated_datasets_have_rows_by_dataset():
    of = {"dataset": "beetle_like+argon_bubble_like"}
    levels = {"beetle_like.shell": 36.0, "argon_bubble_like.shock": 31.0, "argon_bubble_like.bubble": 33.0}
    rows = [
        row(scene=scene, psnr=psnr - loss, variant=variant, **of)
        for scene, psnr in levels.items()
        for variant, loss in (("joint=false", 0.0), ("threshold=1000", 2.0), ("", 0.1))
    ]
    (block,) = blocks(results(*rows), "cross-dataset")
    assert (block.published, block.same) == ("beetle + argon bubble", False)
    alone, joint = line(block, "argon bubble, alone").values, line(block, "argon bubble, joint").values
    assert (alone["psnr"].mean, alone["psnr"].published) == (32.0, 31.76)
    assert (joint["psnr"].mean, joint["psnr"].published) == (30.0, 16.82)
    assert line(block, "beetle, groups by distance").values["psnr"].mean == pytest.approx(35.9)
    whole = line(block, "all, joint").values["train_seconds"]
    assert (whole.mean, whole.published) == (6.0, 5.2)  # minutes of all scenes


def test_initial_files_have_the_bytes_of_the_points_that_are_used():
    def bytes_of(label, name="init-points", points=10_000, **options):
        variant = ",".join(f"{key}={value}" for key, value in options.items())
        rows = [
            row(dataset="beetle", scene="shell", variant=one, options=json.dumps(given), start_points=points)
            for one, given in {"": {}, variant: options}.items()
        ]
        return line(blocks(results(*rows), name)[0], label).values["init_bytes"]

    ours = bytes_of("10,000 of the cloud")
    assert (ours.mean, ours.published) == (pytest.approx(150_000 / 2**20), 0.15)
    assert bytes_of("1,000 of the cloud", cloud_points=1000).mean == pytest.approx(15_000 / 2**20)
    # A cloud has no more points than its volume.
    few = bytes_of("500,000 of the cloud", points=276_784, cloud_points=500_000)
    assert (few.mean, few.published) == (pytest.approx(276_784 * 15 / 2**20), 7.2)
    assert bytes_of("500,000 random", random_points=500_000, start="random").mean == 0.0
    assert bytes_of("+ position", "init-attributes", start="positions").mean == pytest.approx(
        0.1144, abs=1e-4
    )
    assert bytes_of("10,000 of the cloud", points=None).mean is None, "older records do not tell"


def test_the_table_of_times_has_the_gaussians_that_are_drawn():
    rows = results(*four("econgs", 35.0, drawn=500.5), *four("3dgs", 34.0, drawn=1200.0))
    timing = pd.DataFrame([{"job": job, "part": "frame", "seconds": 0.01} for job in rows["job"]])
    block = blocks(rows, "timing", timing=timing)[0]
    values = {label: line(block, label).values["drawn"] for label in ("ECoNGS-R", "3DGS")}
    assert {label: (one.mean, one.published) for label, one in values.items()} == {
        "ECoNGS-R": (500.5, 70905), "3DGS": (1200.0, 134156),
    }  # fmt: skip


def test_a_stand_in_may_have_another_resolution():
    rows = [row(dataset="beetle_like@255", scene="shell", variant=one) for one in ("", "start=random")]
    (block,) = blocks(results(*rows), "init-attributes")
    assert (block.dataset, block.published) == ("beetle_like@255", "beetle")


def test_scenes_learned_with_others_are_not_those_of_a_smaller_dataset():
    t = [f"t_{i}" for i in range(1, 5)]
    h = [f"h_{i}" for i in range(20)]
    of = {"dataset": "ionisation_like"}
    alone = [row("ivr-gs", scene, fitted_scenes=json.dumps([scene]), **of) for scene in t + h]
    mixed = [row("econgs", scene, 30.0, fitted_scenes=json.dumps(["t_1", "h_1"]), **of) for scene in t + h]
    small = [row("econgs", scene, 33.0, scenes_together=4, fitted_scenes=json.dumps(["t_1", "t_2"]),
                 job=f"small-{scene}", **of) for scene in t]  # fmt: skip
    both = paper_tables(results(*alone, *mixed, *small))
    (univariate,) = table(both, "univariate").blocks
    assert (univariate.published, univariate.dataset) == ("ionization (T)", "ionisation_like")
    assert line(univariate, "ECoNGS-R").values["psnr"].mean == 33.0
    assert line(univariate, "iVR-GS").values["psnr"].mean == 36.0
    (multivariate,) = table(both, "multivariate").blocks
    assert line(multivariate, "ECoNGS-R").values["psnr"].mean == 30.0
    without = paper_tables(results(*alone, *mixed))
    assert "univariate" not in {one.name for one in without}, "nothing to set iVR-GS against"


def seen(rows, noise):
    """Views of each finished job: its PSNR and ``noise`` (job -> 40 values)."""
    finished = rows.loc[rows["status"] == "ok", ["job", "scene", "seed", "psnr"]]
    views = [
        {"job": job, "scene": scene, "seed": seed, "view": f"v{i}", "psnr": psnr + value}
        for job, scene, seed, psnr in finished.itertuples(index=False)
        for i, value in enumerate(noise(job))
    ]
    return pd.DataFrame(views)


def waves(size):
    """Noise of views, other noise for each method, and no seed or scene without it."""
    rng = np.random.default_rng(0)
    noises = {}
    return lambda job: noises.setdefault(job.split("-")[0], size * rng.normal(size=40))


def places(block, column="psnr"):
    return {block.rows[i].label: place for (i, name), place in block.marks.items() if name == column}


GOOD = [*four("econgs", 35.1), *four("3dgs", 35.0)]
FAILED = [one | {"status": "failed", "psnr": None} for one in four("3dgs", 35.0, seed=1)]


@pytest.mark.parametrize(
    ("rows", "noise", "expected"),
    [
        (GOOD, 0.0, (1, 2)),
        (GOOD, 3.0, (3, 3)),  # views cannot tell
        ([*GOOD, *FAILED], 3.0, (3, 3)),  # nor a seed that failed
        # An incomplete seed does not hide a clear difference.
        ([*four("econgs", 38.0), *GOOD[4:], *four("econgs", 20.0, seed=1)[:3]], 0.5, (1, 2)),
    ],
)
def test_quality_is_ranked_where_complete_seeds_and_their_views_can_tell(rows, noise, expected):
    rows = results(*rows)
    (univariate,) = (one for one in paper_tables(rows, seen(rows, waves(noise))) if one.name == "univariate")
    assert places(univariate.blocks[0]) == dict(zip(("ECoNGS-R", "3DGS"), expected, strict=True))
    assert ("\N{ALMOST EQUAL TO}" in to_text(univariate)) == (expected == (3, 3))


def test_the_leader_must_be_ahead_on_the_views_too():
    """Means and paired views can disagree, where a table of views is not the whole of them."""
    rows = results(*four("econgs", 35.0), *four("3dgs", 34.0))
    views = seen(rows, waves(0.1))
    views.loc[views["job"].str.startswith("3dgs"), "psnr"] += 3.0
    assert places(blocks(rows, views=views)[0]) == {"ECoNGS-R": 3, "3DGS": 3}


def test_a_ranking_without_views_has_a_remark_with_the_rows_that_lack_them():
    rows = results(*four("econgs", 38.0), *four("3dgs", 35.0), *four("ivr-gs", 30.0))

    def remark(views):
        remarks = blocks(rows, views=views)[0].remarks
        return [text for text in remarks if text.startswith("PSNR [dB]: ")]

    (every,) = remark(None)
    views = seen(rows, waves(0.5))
    views = views[~views["job"].str.startswith("ivr-gs")]
    (one,) = remark(views)
    assert one == every.replace("pair.", "pair (iVR-GS).") != every
    assert remark(seen(rows, waves(0.5))) == []


def test_speed_and_time_are_ranked_in_one_place_and_where_seeds_agree():
    def block_of(*fps, **changed):
        rows = [*four("econgs", 38.0, fps=fps[0]), *four("econgs", 38.0, fps=fps[1], seed=1)]
        rows += [*four("3dgs", 35.0, fps=fps[2], **changed)]
        rows += [*four("3dgs", 35.0, fps=fps[3], seed=1, **changed)]
        return blocks(results(*rows))[0]

    assert places(block_of(90.0, 100.0, 110.0, 120.0), "fps") == {"3DGS": 1, "ECoNGS-R": 2}
    near = block_of(90.0, 112.0, 110.0, 120.0)
    assert places(near, "fps") == {"3DGS": 3, "ECoNGS-R": 3}
    assert SEEDS_NOTE in near.remarks
    apart = block_of(90.0, 100.0, 110.0, 120.0, threads=1)
    assert places(apart, "fps") == {}
    assert [line(apart, name).values["fps"].mean for name in ("ECoNGS-R", "3DGS")].count(None) == 1
    assert any("FPS" in remark and "threads" in remark for remark in apart.remarks)


def test_an_empty_column_has_its_reason_and_its_rows():
    rows = [
        one | {"omissions": '{"flip": "slow", "lpips_vgg": "weights missing"}'}
        for one in four("econgs", 35.0)
    ]
    block = blocks(results(*rows, *four("3dgs", 34.0)))[0]
    (remark,) = (remark for remark in block.remarks if "LPIPS" in remark)
    assert "weights missing" in remark
    assert "slow" not in remark, "FLIP is no column of this table"
    assert "ECoNGS-R" not in remark, "all rows lack it"
    rows = results(*rows, *four("3dgs", 34.0, lpips_vgg=0.1))
    text = to_markdown(table(paper_tables(rows), "univariate"))
    assert re.search(r"LPIPS of ECoNGS-R\b.*weights missing", text)


def test_rows_of_several_versions_of_a_method_have_a_remark():
    without = {"variant": "view_direction=true", "method_version": "1"}
    rows = [*four("econgs", 35.0, method_version="2"), *four("econgs", 34.0, **without)]
    block = blocks(results(*rows), "design")[0]
    assert any("full ECoNGS-R; w/o view direction" in remark for remark in block.remarks)
    rows = [*four("econgs", 35.0, method_version="2"), *four("3dgs", 34.0, method_version="1")]
    (block,) = table(paper_tables(results(*rows)), "univariate").blocks
    assert not [remark for remark in block.remarks if "ECoNGS-R" in remark]


def test_rows_left_out_are_counted():
    superseded = results(*four("econgs", 30.0)[:3], row(dataset="other"))
    papers = paper_tables(results(*four("econgs", 35.0), *four("3dgs", 34.0)), superseded=superseded)
    note = replaced(superseded[superseded["dataset"] != "other"])
    assert "3 rows" in note
    for write in (to_markdown, to_html, to_latex, to_text):
        assert note in write(table(papers, "univariate"))


def test_times_of_a_frame_come_from_their_own_table():
    rows = results(*four("econgs", 35.0), *four("3dgs", 34.0))
    timing = pd.DataFrame(
        [
            {"job": job, "part": part, "seconds": seconds * (2.0 if job.startswith("3dgs") else 1.0)}
            for job in rows["job"]
            for part, seconds in (
                ("frame", 0.004),
                ("decode", 0.001),
                ("shade", 0.0005),
                ("rasterise", 0.0025),
            )
        ]
    )
    assert not [one for one in paper_tables(rows) if one.name == "timing"]
    block = table(paper_tables(rows, timing=timing), "timing").blocks[0]
    ours, theirs = line(block, "ECoNGS-R").values, line(block, "3DGS").values
    assert (ours["rasterise_ms"].mean, ours["rasterise_ms"].published) == (pytest.approx(3.0), 0.69)
    assert theirs["frame_ms"].mean == pytest.approx(8.0)


def test_documents_hold_every_row_and_escape_what_they_must():
    tables = paper_tables(
        results(*four("econgs", 35.0), *four("econgs", 34.0, variant="view_direction=true"))
    )
    design = table(tables, "design")
    for write in (to_markdown, to_html, to_latex, to_text):
        text = write(design)
        for label in ("full ECoNGS-R", "w/o view direction", "w/o joint learning"):
            assert label in text
    assert r"\textbf{36.50}" in to_latex(design)


def test_every_layout_row_with_a_published_one_finds_it():
    for name, values in layouts()["tables"].items():
        for one in values["rows"]:
            match = one.get("match")
            assert not match or any(all(r[k] == v for k, v in match.items()) for r in reference_rows(name)), (
                one
            )


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (
            [row("econgs"), row("hac")],
            "Univariate datasets, of vortex_views: needs all 4 scenes of vortex_views (here 1).",
        ),
        ([row("plenoxels")], "needs all 4 scenes of vortex_views (here 1)."),
        (
            [row("plenoxels", dataset="vortices")],
            'all 4 scenes of vortices (here 1) and two of its 15 rows (here "Plenoxels").',
        ),
        (four("plenoxels", 30.0), ""),
        ([row("mine"), row("hac", dataset="own")], ""),
        ([], ""),
    ],
)
def test_a_part_of_a_table_is_told_what_it_lacks(rows, words):
    """One line where rows of a table were measured and there is none; the paper's own data need one row."""
    found = tables.lacking(results(*rows), ["univariate"])
    made = paper_tables(results(*rows))
    assert found.removeprefix("No table of the paper: ").endswith(words)
    assert bool(found) == bool(words)
    assert not (words and made)


def test_what_is_lacking_is_of_the_nearest_table():
    assert "Univariate datasets" in tables.lacking(results(row("econgs"), row("hac")))
