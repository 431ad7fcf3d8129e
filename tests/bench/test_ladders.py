"""Ladders: which jobs a rung adds, what stress reaches a method, and what the tables say."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from econgs_bench.bench.jobs import scene_views
from econgs_bench.bench.jobs.scenes import scene_inputs
from econgs_bench.bench.jobs.truth import Truth
from econgs_bench.bench.results.bundle import verify_bundle, write_bundle
from econgs_bench.bench.results.rungs import rungs_of
from econgs_bench.bench.store.records import Request
from econgs_bench.bench.suites.stress import KINDS, part_of, stress_of
from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.errors import DataError, UnknownName

from .conftest import plan

LADDERS = """
ladders = [
    { name = "noise", title = "noise", rungs = ["", "noise=8", "noise=32"] },
    { name = "zoom", title = "zoom", rungs = ["", "zoom=2"] },
    { name = "opacity", title = "opacity", rungs = ["", "opacity=0.1"] },
]
"""
OPTIONS = """
ladders = [
    { name = "pace", title = "pace", rungs = ["", { options = { fake = { pace = 0.01 } } }] },
    { name = "others", title = "of another method", rungs = ["", { options = { hac = { features = 5 } } }] },
]
"""
SCENES = """
ladders = [
    { name = "scenes", title = "scenes", rungs = [
        { scene = "argon_bubble_like@32/shock" },
        { scene = "vortices@16/cores", stress = "points=100 start=random" },
    ] },
]
"""


def by_stress(jobs, kind):
    return {job.stress: job for job in jobs if job.kind == kind and job.subject == "shock"}


def test_stress_has_one_spelling_and_four_parts() -> None:
    assert part_of("noise=8.0  opacity=0.5") == "opacity=0.5 noise=8"
    assert stress_of("") == {}
    text = "zoom=2 budget=0.1 views=6 width=0.1"
    assert [part_of(text, part) for part in ("truth", "input", "fit", "test")] == [
        "width=0.1", "views=6", "budget=0.1", "zoom=2",
    ]  # fmt: skip
    assert all(kind.doc for kind in KINDS.values())


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("noyse=3", UnknownName, "Did you mean noise"),
        ("noise", DataError, "kind=value"),
        ("noise=-1", DataError, "not possible"),
        ("views=2.5", DataError, "not possible"),
        ("units=nan", DataError, "not possible"),
        ("cameras=left", DataError, "hemisphere"),
        ("noise=1 noise=2", DataError, "twice"),
        ("opacity=x", DataError, "no factor"),
    ],
)
def test_unusable_stress_is_named(text, error, words) -> None:
    with pytest.raises(error, match=words):
        stress_of(text)


def test_a_rung_adds_only_the_jobs_that_it_decides(suite) -> None:
    usual, jobs = ({job.id: job for job in plan(suite(more))} for more in ("", LADDERS))
    assert usual.items() <= jobs.items()  # names and all of the usual jobs stay
    added = [job for name, job in jobs.items() if name not in usual]
    kinds = {s: sorted(job.kind for job in added if job.stress == s) for s in {job.stress for job in added}}
    fitted = ["encode", "encode", "fit", "fit", "measure", "measure"]
    assert kinds == {
        "noise=8": fitted,
        "noise=32": fitted,
        "zoom=2": ["measure", "measure", "views", "views"],
        "opacity=0.1": [*fitted, "views", "views"],
    }
    views, fits, measures = (by_stress(jobs.values(), kind) for kind in ("views", "fit", "measure"))
    assert fits["noise=8"].needs == fits[""].needs == (views[""].id,)
    assert fits["opacity=0.1"].needs == (views["opacity=0.1"].id,)
    assert set(measures["zoom=2"].needs) == {views["zoom=2"].id, *measures[""].needs} - {views[""].id}
    assert views["opacity=0.1"].id in measures["opacity=0.1"].needs


def test_a_dataset_of_a_ladder_runs_on_ladders_alone(suite) -> None:
    named = """ladders = [
        { name = "noise", title = "", datasets = ["argon_bubble_like@32"], rungs = ["", "noise=8"] },
        { name = "rate", title = "", datasets = ["argon_bubble_like@32"], rungs = [
            "", { options = { fake-joint = { pace = 0.01 } } },
        ] },
    ]"""
    alone = "ladders = [" + named[named.index('{ name = "rate"') :]
    methods = ("fake", "fake-joint")
    # The fake has no rung of rates, and nothing else asks for its usual run.
    assert {job.method for job in plan(suite(alone), methods=methods) if job.kind != "views"} == {
        "fake-joint"
    }
    jobs = plan(suite(named), methods=methods)
    assert {(job.method, job.stress) for job in jobs if job.kind == "fit" and job.method == "fake"} == {
        ("fake", ""),
        ("fake", "noise=8"),
    }
    # A dataset of the command line, which the suite does not know, climbs too.
    other = plan(suite(named), datasets=("vortices@16",))
    assert {job.stress for job in other if job.kind == "fit"} == {"", "noise=8"}


def test_rungs_of_two_ladders_with_the_same_options_stay_apart(suite) -> None:
    rungs = 'rungs = ["", { options = { fake = { pace = 0.01 } } }]'
    text = suite(f"""ladders = [
        {{ name = "here", title = "", datasets = ["argon_bubble_like@32"], {rungs} }},
        {{ name = "there", title = "", datasets = ["vortices@16"], {rungs} }},
        {{ name = "scenes", title = "", rungs = [
            {{ scene = "argon_bubble_like@32/shock" }}, {{ scene = "vortices@16/cores" }},
            {{ scene = "extremes@16/nothing", stress = "start=random" }},
        ] }},
        {{ name = "start", title = "", datasets = ["vortices@16"], rungs = ["", "start=random"] }},
    ]""")
    text_of = Path(text).read_text().replace("[datasets]", '[datasets]\n"vortices@16" = ["cores"]')
    Path(text).write_text(text_of)
    ladders = load_suite(text).ladders
    places = {
        (job.dataset, job.subject, row["ladder"], row["rung"])
        for job in plan(text)
        for row in rungs_of(job, ladders)
    }
    assert places == {
        ("argon_bubble_like@32", scene, "here", rung)
        for scene in ("shock", "bubble")
        for rung in ("as usual", "pace=0.01")
    } | {("vortices@16", "cores", "there", rung) for rung in ("as usual", "pace=0.01")} | {
        ("argon_bubble_like@32", "shock", "scenes", "argon_bubble_like@32/shock"),
        ("vortices@16", "cores", "scenes", "vortices@16/cores"),
        ("extremes@16", "nothing", "scenes", "extremes@16/nothing start=random"),
        ("vortices@16", "cores", "start", "as usual"),
        ("vortices@16", "cores", "start", "start=random"),
    }  # fmt: skip


def test_budget_and_joint_methods(suite) -> None:
    jobs = plan(
        suite('ladders = [{ name = "b", title = "", rungs = ["", "budget=0.1"] }]'), methods=("fake-joint",)
    )
    partitions = {job.stress: job for job in jobs if job.kind == "partition"}
    assert {text: job.iterations for text, job in partitions.items()} == {"": 20, "budget=0.1": 2}


def test_rungs_of_options_and_of_scenes(suite) -> None:
    jobs = plan(suite(OPTIONS))
    assert {job.variant for job in jobs if job.kind == "fit"} == {"", "pace=0.01"}
    jobs = plan(suite(SCENES))
    assert {(job.dataset_name, job.subject, job.stress) for job in jobs if job.kind == "fit"} == {
        ("argon_bubble_like@32", "shock", ""),
        ("argon_bubble_like@32", "bubble", ""),
        ("vortices@16", "cores", "start=random points=100"),
    }
    few = plan(suite(SCENES), datasets=("argon_bubble_like@32",))
    assert {job.dataset_name for job in few} == {"argon_bubble_like@32"}


def test_pre_rendered_views_have_other_training_input_but_no_other_truth(suite, dataset) -> None:
    jobs = plan(suite(LADDERS), datasets=(str(dataset),))
    assert {job.stress for job in jobs} == {"", "noise=8", "noise=32"}


@pytest.mark.parametrize(
    ("ladder", "error", "words"),
    [
        ('rungs = ["noise=8", "noise=32"]', DataError, "first rung"),
        ('rungs = [""]', DataError, "1 rungs"),
        ('rungs = ["", { scene = "a/b" }]', DataError, "mixes"),
        ('rungs = [{ scene = "a/b" }, { scene = "ab" }]', DataError, "no scene"),
        ('rungs = ["", { stres = "noise=8" }]', UnknownName, "Did you mean stress"),
        ('rungs = ["", "noise=8"], datasets = ["vortices"]', UnknownName, "vortices"),
        ('rungs = ["", "noise=8"], steps = 3', UnknownName, "steps"),
        ("rungs = 5", DataError, "ladders: TypeError"),
    ],
)
def test_bad_ladders_are_refused_by_name(suite, ladder, error, words) -> None:
    with pytest.raises(error, match=words):
        plan(suite(f'ladders = [{{ name = "a", title = "", {ladder} }}]'))


# --------------------------------------------------------------------------- what a method gets


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Truth:
    """Ground truth of a small scene, as a views job stores it."""
    from econgs_bench.bench.jobs.truth import write_truth
    from econgs_bench.datasets.cloud import cloud_source

    data = open_dataset("argon_bubble_like@32")
    request = Request(train_views=42, test_views=4, width=16, height=16)
    folder = tmp_path_factory.mktemp("truth")
    sets = {split: scene_views.views(data, "shock", request, split) for split in ("trainval", "test")}
    write_truth(folder, sets, data.scene("shock"), cloud_source(data, data.scene("shock")))
    return Truth(folder)


def given(truth: Truth, stress: str, needs_volume: bool = False):
    job = SimpleNamespace(
        stress=stress, scenes=("shock",), dataset="argon_bubble_like@32", dataset_name="a", seed=0,
        split="test", cloud_points=500, method="m",
    )  # fmt: skip
    spec = SimpleNamespace(needs_volume=needs_volume)
    (scene,) = scene_inputs(job, SimpleNamespace(job=job, spec=spec, truth=lambda name: truth))
    return scene


def test_what_a_method_gets(truth) -> None:
    usual = given(truth, "")
    assert (len(usual.train), len(usual.cloud)) == (42, 500)
    assert len(given(truth, "views=6").train) == 6
    assert len(given(truth, "views=3 cameras=hemisphere").train) == 3
    assert len(given(truth, "points=100").cloud) == 100
    assert len(given(truth, "points=50 start=random").cloud) == 50
    noise = given(truth, "noise=8")
    assert (noise.train.images != usual.train.images).any()
    assert (noise.train.images == given(truth, "noise=8").train.images).all()
    assert (noise.cloud.points == usual.cloud.points).all()
    poses = given(truth, "poses=1")
    assert not np.allclose(poses.train.cameras[0].camera_to_world, usual.train.cameras[0].camera_to_world)
    assert poses.extent == usual.extent
    large = given(truth, "units=1000")
    assert large.extent == pytest.approx(1000 * usual.extent)
    assert np.allclose(large.cloud.points, 1000 * usual.cloud.points)
    assert (large.train.images == usual.train.images).all()
    with pytest.raises(Exception, match="reads the volume"):
        given(truth, "units=1000", needs_volume=True)


def test_truth_and_test_views_under_stress(truth) -> None:
    data = open_dataset("argon_bubble_like@32")
    request = Request(train_views=12, test_views=2, width=16, height=16)
    usual = scene_views.views(data, "shock", request, "test")
    thin = scene_views.views(
        scene_views.stressed(data, "shock", "opacity=0.1 noise=3"), "shock", request, "test"
    )
    assert 0.0 < thin.images[..., 3].sum() < 0.5 * usual.images[..., 3].sum()
    assert scene_views.stressed(data, "shock", "noise=3 zoom=2") is data
    close, far, fine = (
        scene_views.views(data, "shock", request, "test", stress=text)
        for text in ("distance=0.3", "distance=3", "zoom=2")
    )
    ratio = np.linalg.norm(far.cameras[0].position) / np.linalg.norm(close.cameras[0].position)
    assert ratio == pytest.approx(10.0)
    seen = [views.images[..., 3].mean() for views in (close, usual, far)]
    assert seen == sorted(seen, reverse=True)
    assert fine.images.shape[1:3] == (32, 32)
    assert fine.images[..., 3].mean() == pytest.approx(seen[1], rel=0.1)


# --------------------------------------------------------------------------- a run


def test_a_run_with_ladders(bench, suite, tmp_path) -> None:
    done = bench.run_suite(
        suite(LADDERS.replace('"noise=32"', '"noise=32", "units=1000"')), "--scene", "shock", report=True
    )
    assert re.search(r"^fake +holds [0-5] of 5 rungs", done.stdout, re.M)
    tables = bench.tables()
    assert list(tables["results"]["kind"]) == ["basic"] * len(
        tables["results"]
    )  # stress is in no other table
    assert set(tables["views"]["job"]) == set(tables["results"]["job"])
    rungs = tables["rungs"]
    first = rungs[rungs["seed"] == 0].set_index(["ladder", "place"])["rung"].to_dict()
    assert first == {
        ("noise", 0): "as usual", ("noise", 1): "noise=8", ("noise", 2): "noise=32",
        ("noise", 3): "units=1000", ("zoom", 0): "as usual", ("zoom", 1): "zoom=2",
        ("opacity", 0): "as usual", ("opacity", 1): "opacity=0.1",
    }  # fmt: skip
    assert set(rungs["status"]) == {"ok"}
    assert list(dict.fromkeys(rungs["ladder"])) == ["noise", "zoom", "opacity"]  # as in the suite
    assert set(tables["rung_views"]["job"]) == set(rungs["job"])
    assert all((bench.store / file).is_file() for file in tables["rung_views"]["render_file"])
    plain = rungs[rungs["ladder"] == "noise"].set_index("place")
    assert plain["psnr"][2] < plain["psnr"][1] < plain["psnr"][0]
    assert plain["psnr"][3] == pytest.approx(plain["psnr"][0], abs=0.5)
    ladders = json.loads((bench.store / "ladders.json").read_text())
    assert [ladder["name"] for ladder in ladders] == ["noise", "zoom", "opacity"]


@pytest.mark.slow
def test_a_rung_that_breaks_is_repeated(bench, suite) -> None:
    text = suite(
        'repeats = [1, 2]\nladders = [{ name = "b", title = "", rungs = '
        '["", "noise=1", { options = { fake = { behaviour = "diverge" } } }] }]'
    )
    bench.run_suite(text, "--scene", "shock", code=1)
    rungs = bench.tables()["rungs"]
    seeds = {place: sorted(rows["seed"]) for place, rows in rungs.groupby("place")}
    assert seeds == {0: [0, 1, 2], 1: [0], 2: [0, 1, 2]}
    assert set(rungs["failed_step"][rungs["place"] == 2]) == {"fit"}
    again = bench.run_suite(text, "--scene", "shock", code=1)
    assert "nothing to run" in again.stderr


@pytest.mark.slow
def test_a_bundle_keeps_its_ladders(bench, suite, tmp_path) -> None:
    from econgs_bench.bench.results.rungs import FILE
    from econgs_bench.bench.store.store import Store

    bench.run_suite(
        suite('ladders = [{ name = "b", title = "", rungs = ["", "noise=9"] }]'), "--scene", "shock"
    )
    path = tmp_path / "a.zip"
    write_bundle(Store(bench.store), path)
    assert verify_bundle(path) == []
    merged = tmp_path / "merged"
    bench("merge", str(path), "--out", str(merged))
    assert (merged / FILE).read_text() == (bench.store / FILE).read_text()
