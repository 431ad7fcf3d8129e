"""Scenes measured together: which jobs are planned, what their rows say, and whole runs."""

from __future__ import annotations

import re

import pytest

from econgs_bench.bench.jobs.encode import EncodeResult
from econgs_bench.bench.jobs.fit import FitResult
from econgs_bench.bench.jobs.partition import PartitionResult
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.results.tables import stored_tables
from econgs_bench.bench.store.records import Record, ViewResult
from econgs_bench.bench.store.store import Store
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.datasets.png import read_png
from econgs_bench.reports.schema import joined

from .conftest import measured, plan


def subjects(jobs) -> list[str]:
    return [job.subject for job in jobs if job.kind == "measure"]


def test_compositions_are_measured_only_where_they_are_wanted(suite) -> None:
    assert subjects(plan(suite())) == ["shock", "bubble"]
    assert subjects(plan(suite(), composed=True)) == ["shock", "bubble", "all"]
    assert subjects(plan(suite('compositions = "all"'))) == ["shock", "bubble", "all"]
    assert subjects(plan(suite('compositions = ["all"]'))) == ["shock", "bubble", "all"]
    assert subjects(plan(suite(), scenes=("all",))) == ["shock", "bubble", "all"]
    # Only those whose scenes are all there.
    assert subjects(plan(suite('compositions = "all"'), scenes=("shock",))) == ["shock"]
    with pytest.raises(UnknownName, match="composition 'al'"):
        plan(suite('compositions = ["al"]'))
    with pytest.raises(UnknownName, match="scene 'shok'"):
        plan(suite(), scenes=("shok", "all"))
    with pytest.raises(DataError, match='Write "all", or a list of names'):
        plan(suite('compositions = "shock"'))


def test_a_composition_needs_its_views_and_every_model_that_holds_its_scenes(suite) -> None:
    jobs = {job.id: job for job in plan(suite(), composed=True)}
    (composed,) = [job for job in jobs.values() if job.kind == "measure" and job.composition]
    views, *encodes = (jobs[need] for need in composed.needs)
    assert (views.kind, views.subject, views.scenes) == ("views", "all", ("shock", "bubble"))
    assert [encode.scenes for encode in encodes] == [("shock",), ("bubble",)]
    assert composed.group == "shock,bubble"
    # Jobs come after those they need, and what a basic scene is measured by does not change.
    order = list(jobs)
    assert all(order.index(need) < order.index(job.id) for job in jobs.values() for need in job.needs)
    assert {job.id for job in plan(suite())} < set(jobs)


def test_other_models_make_another_measurement(suite) -> None:
    ids = [
        {
            job.id
            for job in plan(suite(), composed=True, seeds=(seed,))
            if job.composition and job.kind != "views"
        }
        for seed in (0, 1)
    ]
    assert len(ids[0]) == 1
    assert not ids[0] & ids[1]


def _records(suite, tmp_path) -> list[Record]:
    """Finished records of all jobs of a joint method, whose groups are `groups`."""
    store = Store(tmp_path / "runs", create=True)
    made: dict[str, Record] = {}
    while True:
        jobs = plan(suite, store, composed=True, methods=("fake-joint",))
        todo = [job for job in jobs if job.id not in made]
        if not todo:
            return list(made.values())
        for job in todo:
            made[job.id] = Record(
                job=job, status="ok", started="", finished="", wall_seconds=1.0, **_result(job)
            )
            store.finish(made[job.id])


def _result(job) -> dict:
    if job.kind == "views":
        return {"views": ViewsResult(view_keys={}, background=(1.0, 0.5, 0.0), truth={}, render_seconds=1.0)}
    if job.kind == "partition":
        return {"partition": PartitionResult(groups=[[scene] for scene in job.scenes], seconds=4.0)}
    if job.kind == "fit":
        seconds = {"shock": 10.0, "bubble": 20.0}[job.group]
        fit = FitResult(seconds=seconds, cpu_seconds=2.0 * seconds, iterations=1, primitives={},
                        cloud_points={job.group: int(50 * seconds)}, train_views=12, curve=[],
                        resumed=0, reference_seconds=None)  # fmt: skip
        return {"fit": fit}
    if job.kind == "encode":
        own = {"shock": 100, "bubble": 200}[job.group]
        return {"encode": EncodeResult(seconds=1.0, total_bytes=own + 7,
                                       ledger={job.group: {"own": own}, "": {"net": 7}})}  # fmt: skip
    view = ViewResult(view="0", metrics={"psnr": 30.0}, identical=False, truth_file="t", render_file="r")
    return {"measure": measured(30.0, 5 * len(job.scenes), (view,))}


def test_costs_of_a_composition_are_those_of_its_scenes(suite, tmp_path) -> None:
    tables = joined(stored_tables(_records(suite(), tmp_path)))
    found = tables["results"].set_index("scene", drop=False).to_dict("index")
    assert list(tables["results"]["kind"]) == ["basic", "basic", "composed"]
    a, b, both = found["shock"], found["bubble"], found["all"]
    for name in ("size_bytes", "train_seconds", "standalone_bytes", "primitives", "group_bytes",
                 "group_seconds", "cpu_seconds", "start_points"):  # fmt: skip
        assert both[name] == a[name] + b[name], name
    assert (a["start_points"], b["start_points"]) == (500, 1000)
    assert both["size_bytes"] == 314
    assert both["train_seconds"] == 10.0 + 20.0 + 2 * 1.0 + 4.0
    assert set(tables["views"]["background"]) == {"#ff8000"}
    assert set(tables["timing"]["scene"]) == {"shock", "bubble", "all"}


def test_a_composition_of_part_of_a_group(suite, tmp_path) -> None:
    """Shares count once for each scene, what the group shares once for each group."""
    records = _records(suite(), tmp_path)
    by_kind = {record.job.kind: record for record in records if record.job.axes()["group"] != "bubble"}
    scenes = ("shock", "bubble", "third")
    encode = by_kind["encode"]
    ledger = {"": {"net": 10}, "shock": {"own": 100}, "bubble": {"own": 200}, "third": {"own": 400}}
    group = encode.model_copy(update={
        "job": encode.job.model_copy(update={"scenes": scenes}),
        "result": EncodeResult(seconds=3.0, total_bytes=710, ledger=ledger),
    })  # fmt: skip
    (composed,) = [r for r in records if r.job.kind == "measure" and r.job.composition]
    needs = tuple(n for n in composed.job.needs if not n.startswith("encode-") or n == encode.job.id)
    composed = composed.model_copy(update={"job": composed.job.model_copy(update={"needs": needs})})
    tables = stored_tables([composed, group, by_kind["fit"], by_kind["partition"]])
    (row,) = tables["results"].to_dict("records")
    assert (row["size_bytes"], row["standalone_bytes"], row["group_bytes"]) == (307, 310, 710)
    seconds = 10.0 + 3.0 + 4.0 * 3 / 2
    assert (row["group_seconds"], row["train_seconds"]) == (seconds, pytest.approx(seconds * 2 / 3))


def test_scenes_are_composed_measured_and_refused(bench, inside, suite) -> None:
    """A whole run: a method that composes, and one whose groups cannot be rendered together."""
    for method in ("fake", "fake-joint"):
        done = bench.run_suite(suite(), "--composed", "--method", method)
    assert "fake-joint: refused: fake-joint cannot render models of several groups together" in done.stderr
    tables = bench.tables()
    results = tables["results"].set_index(["method", "scene"])
    assert list(results["kind"]) == ["basic"] * 4 + ["composed"] * 2
    assert results.loc[("fake", "all"), "status"] == "ok"
    assert results.loc[("fake", "all"), "psnr"] > 5
    assert results.loc[("fake-joint", "all"), "status"] == "refused"
    shown = tables["views"][tables["views"]["scene"] == "all"]
    assert len(shown) == 4
    assert all((bench.store / file).is_file() for file in [*shown["truth_file"], *shown["render_file"]])
    (views,) = [r for r in bench.of_kind("views") if r.job.composition]
    assert views.result.cost["test"]["peak_host_bytes"] > 2**20
    again = bench.run_suite(suite(), "--composed", "--method", "fake")
    assert "nothing to run" in again.stderr

    render = ("render", "argon_bubble_like@32", "--plugins", bench.plugins, "--runs", bench.store)
    render += ("--size", "16", "--views", "4", "--model", results.loc[("fake", "all"), "job"])
    plain = bench(*render, "--truth", "--out", bench.store.parent / "plain")
    # The same views as were measured, both scenes together.
    told = float(re.search(r"PSNR (\S+) dB", plain.stdout)[1])
    assert told == pytest.approx(results.loc[("fake", "all"), "psnr"], abs=0.01)
    edit = ("--edit", "shock.palette=#ff0000", "--edit", "bubble.palette=#ff0000")
    bench(*render, *edit, "--truth", "--out", bench.store.parent / "red")
    picture = bench.store.parent / "red" / "argon_bubble_like@32" / "all" / "0000.png"
    assert (read_png(picture)[..., :3] == [1.0, 0.0, 0.0]).all()
    before, after = (
        read_png(bench.store.parent / name / "argon_bubble_like@32" / "all" / "truth" / "0000.png")
        for name in ("plain", "red")
    )
    assert after[..., 1:3].sum() < 0.9 * before[..., 1:3].sum()  # the truth is edited too


@pytest.mark.slow
def test_3dgs_is_composed_and_edited(bench, suite) -> None:
    bench.run_suite(suite(), "--composed", "--method", "3dgs")
    results = bench.tables()["results"].set_index("scene")
    assert results.loc["all", "kind"] == "composed"
    assert results.loc["all", "psnr"] > 15
    assert results.loc["all", "primitives"] == results.loc[["shock", "bubble"], "primitives"].sum()
    render = ("render", "argon_bubble_like@32", "--runs", bench.store, "--size", "16", "--views", "4")
    render += ("--model", results.loc["all", "job"], "--out", bench.store.parent / "out")
    psnr = [
        float(re.search(r"PSNR (\S+) dB", bench(*render, "--truth", *edit).stdout)[1])
        for edit in ((), ("--edit", "shock.opacity=0"))
    ]
    assert psnr[1] > 15  # the other scene alone against its own truth
    assert psnr[0] != psnr[1]
    refused = bench(*render, "--edit", "bubble.palette=#00ff00", code=2)
    assert "3dgs cannot edit palette of scene 'bubble': only opacity" in refused.stderr
