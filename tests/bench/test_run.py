"""Whole runs with real processes: what a user sees, and what the store holds afterwards."""

from __future__ import annotations

import json
import os
import re
import shutil
from subprocess import CompletedProcess

import pandas as pd
import pytest
from filelock import FileLock

from econgs_bench.bench.store.records import Record
from econgs_bench.datasets.png import read_png
from econgs_bench.reports.schema import TABLES, read_tables

from .conftest import Bench, suite_file


@pytest.mark.parametrize("executor", [(), ("--executor", "dask", "--workers", 1)], ids=["local", "dask"])
def test_a_wait_for_the_machine_is_printed(bench, executor) -> None:
    """Of a run with ``--split val``: every tenth view is left out of it."""
    locks = bench.store.parent / "locks"
    locks.mkdir()
    with FileLock(locks / "econgs-bench-timing.lock"):
        run = bench.start("--split", "val", *executor)
        text = ""
        while "waiting for another timed job on this machine" not in text:
            line = run.stdout.readline()
            assert line, text
            text += line
        assert "[2/4] fit" in text
    assert run.wait(bench.patience) == 0, run.stdout.read()
    (row,) = bench.tables()["results"].to_dict("records")
    assert row["split"] == "val"
    assert row["train_views"] == 11
    (measure,) = bench.of_kind("measure")
    assert [view.view for view in measure.result.views] == ["r_0009"]


def test_a_run_measures_reports_and_does_nothing_twice(bench, inside) -> None:
    first = bench.run(scenes=("a", "b"), report=True)
    assert (bench.store / "report.html").stat().st_size > 0
    assert str(bench.store / "report.html") in first.stdout
    records = bench.records()
    assert {r.job.kind: r.status for r in records.values()} == dict.fromkeys(
        ("views", "fit", "encode", "measure"), "ok"
    )
    stamps = {job: (bench.store / "jobs" / job / "record.json").stat().st_mtime_ns for job in records}

    again = bench.run(scenes=("a", "b"), report=True)
    assert "nothing to run, all 8 jobs are finished" in again.stderr
    assert "other source" not in again.stderr
    after = {job: (bench.store / "jobs" / job / "record.json").stat().st_mtime_ns for job in bench.records()}
    assert after == stamps

    tables = read_tables(bench.store / "tables")
    table = tables["results"]
    assert list(table.columns) == list(TABLES["results"].columns)
    assert list(table["scene"]) == ["a", "b"]
    assert table["psnr"].notna().all()
    assert (table["fps"] > 0).all()
    assert (table["train_views"] == 12).all()
    assert table["processor"].str.contains(f"{os.cpu_count()} cores").all()
    assert (table["fps_p05"] <= table["fps"]).all()
    assert (table["fps"] <= table["fps_p95"]).all()
    views = tables["views"]
    assert len(views) == 8
    for file in [*views["truth_file"], *views["render_file"]]:
        assert (bench.store / file).is_file()
    row = views.iloc[0]
    truth, render = (read_png(bench.store / row[f])[..., 3].sum() for f in ("truth_file", "render_file"))
    assert 1 - row["missing"] + row["excess"] == pytest.approx(render / truth)
    curve = tables["curve"].groupby("scene").last()
    # The four test views are those of the curve: what it ends at is what is measured.
    assert list(curve["psnr"]) == pytest.approx(list(table["psnr"]), abs=0.01)
    folder = next((bench.store / "jobs").glob("encode-*")) / "model"
    features = tables["features"]
    assert [len(values) for values in features["values"]] == [3 * width for width in features["width"]]
    assert set(features["scene"]) == {"a", "b"}
    sizes = sum(f.stat().st_size for f in folder.iterdir())
    assert sizes in set(table["group_bytes"])

    assert "4 jobs, 4 finished, 0 to do" in bench.plan("a", bench.store)
    another = bench.store.parent / "another"
    assert "4 to do, no past records to estimate from" in bench.plan("c", another)
    output = bench.plan("c", another, "--like", bench.store)
    assert re.search(r"4 to do, about .*, \d+ MiB of disk, [1-9]\d* MiB of memory\n", output), output

    printed = bench("results", "--runs", bench.store, "--plugins", bench.plugins)
    assert f"all {len(TABLES['results'].columns)} columns" in printed.stdout
    assert re.search(r"^a .*  measure-[0-9a-f]{16}$", printed.stdout, re.MULTILINE)
    printed = bench("results", "--runs", bench.store, "--plugins", bench.plugins, "--format", "csv")
    assert printed.stdout.splitlines()[0].split(",") == list(TABLES["results"].columns)
    assert len(printed.stdout.splitlines()) == 3
    data = json.loads(bench("results", "--runs", bench.store, "--format", "json").stdout)
    assert data[0]["rate"] is None


def test_measuring_more_primitives_fits_nothing_again_and_stands_for_the_row(finished, tmp_path):
    done = finished.run_suite(suite_file(tmp_path, f'"{finished.dataset}" = ["a"]', "sampled = 2"))
    assert done.stderr.startswith("[4/4] measure")
    tables = finished.store / "tables"
    assert len(pd.read_parquet(tables / "results.parquet")) == 1
    features = pd.read_parquet(tables / "features.parquet")
    assert [len(values) for values in features["values"]] == [2 * width for width in features["width"]]


def test_quality_is_the_mean_over_all_views_of_unequal_error(finished) -> None:
    (measure,) = finished.of_kind("measure")
    for name in ("psnr", "delta_e_uv", "missing", "excess"):  # the pictures are too small for SSIM
        values = [view.metrics[name] for view in measure.result.views]
        assert len(values) == 4
        assert measure.result.metrics[name] == pytest.approx(sum(values) / 4, rel=1e-12)
    assert len({view.metrics["psnr"] for view in measure.result.views}) == 4


def test_times_have_their_reference_kernel_beside_them(finished) -> None:
    (row,) = finished.tables()["results"].to_dict("records")
    assert row["reference_seconds"] > 0
    assert row["fit_reference_seconds"] > 0


def test_memory_of_loading_is_part_of_that_of_rendering(finished) -> None:
    (row,) = finished.tables()["results"].to_dict("records")
    assert 2**24 < row["load_host_bytes"] <= row["render_host_bytes"]


@pytest.mark.parametrize("method", [pytest.param("fake", marks=pytest.mark.slow), "fake-torch"])
def test_failures_are_rows_and_the_rest_goes_on(bench, method) -> None:
    wrong = ("--set", f"{method}.behaviour=abort", "--set", f"{method}.only=a")
    done = bench.run(*wrong, scenes=("a", "b"), method=method, code=1)
    assert "killed by signal 6 (SIGABRT)" in done.stderr
    table = bench.tables()["results"].set_index("scene")
    assert table.loc["a", "status"] == "failed"
    assert "SIGABRT" in table.loc["a", "reason"]
    assert pd.isna(table.loc["a", "psnr"])
    assert table.loc["b", "status"] == "ok"
    fit = next(r for r in bench.of_kind("fit") if not r.ok)
    assert fit.stage == "colors"
    assert "about to abort" in fit.log_tail


ENDS = {
    "refuse": ("refused", "not to its taste"),
    "diverge": ("diverged", "the color went away"),
    "nan": ("diverged", "not finite at iteration 10"),
    "raise": ("failed", "ValueError: a bug in the method (fake.py:"),
    "mute": ("failed", "Mute: an exception without text (fake.py:"),
    "escape": ("refused", r"\x1b[2Jgone\x07 \u202eout of order"),
    "exit": ("failed", "exit code 3"),
    "busy": ("failed", "exit code 76"),
    "no-checkpoint": ("failed", "without a checkpoint"),
}


@pytest.fixture(scope="module")
def ends(dataset, tmp_path_factory) -> tuple[Bench, CompletedProcess[str]]:
    """A store, and the run of it in which every fit ends in another way, on one thread."""
    bench = Bench(tmp_path_factory.mktemp("ends"), dataset)
    variants = ", ".join(f'{{ fake = {{ behaviour = "{behaviour}" }} }}' for behaviour in [*ENDS, "ledger"])
    more = f"variants = [{variants}]\nthreads = 1"
    suite = suite_file(bench.store.parent, f'"{dataset}" = ["a"]', more)
    return bench, bench.run_suite(suite, code=1)


@pytest.mark.parametrize("behaviour", ENDS)
def test_how_a_fit_can_end(ends, behaviour: str) -> None:
    bench, done = ends
    (fit,) = (record for record in bench.of_kind("fit") if record.job.overrides["behaviour"] == behaviour)
    _check_end(bench, fit, done, *ENDS[behaviour])


@pytest.mark.parametrize(
    ("behaviour", "limits", "status", "words"),
    [
        ("sleep", ("--time-limit", "3"), "timeout", "time limit of 3 s"),
        ("hog", ("--memory-limit", "400M"), "oom", "of 400 MiB"),
    ],
)
def test_how_a_limit_ends_a_fit(bench, behaviour, limits, status: str, words: str) -> None:
    done = bench.run("--set", f"fake.behaviour={behaviour}", *limits, code=1)
    (fit,) = bench.of_kind("fit")
    _check_end(bench, fit, done, status, words)


def _check_end(bench: Bench, fit: Record, done: CompletedProcess[str], status: str, words: str) -> None:
    assert (fit.status, words in fit.reason) == (status, True), fit.reason
    (measure,) = (record for record in bench.of_kind("measure") if record.cause == fit.job.id)
    assert (measure.status, measure.reason) == (status, f"fit: {fit.reason}")
    assert "Traceback" not in done.stderr
    assert not {"\x1b", "\x07", "\u202e"} & {*done.stdout, *done.stderr}
    log = bench.store / "jobs" / fit.job.id / "log.txt"
    assert (f"log: {log}" in done.stderr) is (status not in ("refused", "diverged"))
    assert log.is_file()


def test_a_suite_may_limit_the_threads_of_its_jobs(ends) -> None:
    bench, _ = ends
    assert {fit.provenance.threads for fit in bench.of_kind("fit") if fit.provenance} == {1}


def test_a_ledger_that_does_not_sum_is_a_failure(ends) -> None:
    bench, _ = ends
    (encode,) = (one for one in bench.of_kind("encode") if one.job.overrides["behaviour"] == "ledger")
    assert encode.status == "failed"
    size = sum(f.stat().st_size for f in (bench.store / "jobs" / encode.job.id / "model").iterdir())
    assert f"sums to {size + 1} bytes, the saved files have {size}" in encode.reason


def test_failed_jobs_run_again_only_with_retry(bench, tmp_path) -> None:
    cure = tmp_path / "cure"
    wrong = ("--set", "fake.behaviour=raise", "--set", f"fake.file={cure}")
    bench.run(*wrong, code=1)
    cure.touch()
    again = bench.run(*wrong, code=1)
    assert "nothing to run" in again.stderr
    bench.run(*wrong, "--retry")
    assert all(record.ok for record in bench.records().values())
    assert not list((bench.store / "partial").iterdir())


def test_a_joint_method_is_partitioned_and_its_shares_sum(bench) -> None:
    bench.run(scenes=("a", "b", "c"), method="fake-joint")
    table = bench.tables()["results"].set_index("scene")
    assert list(table["group"]) == ["a+b", "a+b", "c"]
    groups = {r.job.group: r.result.total_bytes for r in bench.of_kind("encode")}
    assert table["size_bytes"].sum() == sum(groups.values())
    assert table["group_bytes"].to_dict() == {"a": groups["a+b"], "b": groups["a+b"], "c": groups["c"]}
    own = {p.stem: p.stat().st_size for p in (bench.store / "jobs").glob("encode-*/model/*.json")}
    assert table["standalone_bytes"].to_dict() == {scene: size + 7 for scene, size in own.items()}
    (partition,) = bench.of_kind("partition")
    spent = partition.result.seconds
    spent += sum(r.result.seconds for r in bench.of_kind("fit"))
    spent += sum(r.result.seconds for r in bench.of_kind("encode"))
    assert table["train_seconds"].sum() == pytest.approx(spent)


@pytest.mark.slow
def test_a_mended_partition_leaves_no_failed_rows(bench, tmp_path) -> None:
    """Jobs of a failed partition have other identities than those that follow when it is mended."""
    cure = tmp_path / "cure"
    wrong = ("--set", "fake-joint.behaviour=apart", "--set", f"fake-joint.file={cure}")
    bench.run(*wrong, scenes=("a", "b"), method="fake-joint", code=1)
    table = bench.tables()["results"]
    assert list(table["status"]) == ["failed", "failed"]
    assert table["reason"].str.contains("cannot be compared").all()
    cure.touch()
    bench.run(*wrong, "--retry", scenes=("a", "b"), method="fake-joint")
    table = bench.tables()["results"]
    assert list(table["status"]) == ["ok", "ok"]


def test_rows_of_another_version_are_stale_and_changed_source_alone_is_not(finished, tmp_path) -> None:
    bench, plugins = finished, tmp_path / "own"
    shutil.copytree(bench.plugins, plugins, ignore=shutil.ignore_patterns("__pycache__"))
    file, common = plugins / "fake.py", ("results", "--runs", bench.store, "--format", "json")
    file.write_text(file.read_text() + "\n# a change\n")
    (row,) = json.loads(bench(*common, "--plugins", plugins).stdout)
    assert (row["method_version"], row["stale"]) == ("1", False)
    bench.plugins = plugins
    again = bench.run().stderr
    assert "nothing to run" in again
    assert "fitted by other source than is installed: fake; a higher version" in again
    file.write_text(file.read_text().replace('version="1"', 'version="2"'))
    (row,) = json.loads(bench(*common, "--plugins", plugins).stdout)
    assert (row["stale"], row["changes"]) == (True, "version 1 (today 2)")


def test_pictures_of_truth_and_model_can_be_scored(finished, inside) -> None:
    bench = finished
    (measure,) = bench.of_kind("measure")
    out = bench.store.parent
    common = ("render", bench.dataset, "--scene", "a", "--size", "8", "--views", "4")
    common += ("--plugins", bench.plugins)
    bench(*common, "--out", out / "truth")
    done = bench(*common, "--runs", bench.store, "--model", measure.job.id, "--out", out / "model")
    assert done.stdout.strip().endswith("tiny/a")
    scored = bench("score", out / "model" / "tiny" / "a", out / "truth" / "tiny" / "a", "--format", "json")
    (*images, mean) = json.loads(scored.stdout)
    assert [row["file"] for row in images] == [f"{i:04d}.png" for i in range(4)]
    # What the folders say is what the measure job said, but for one rounding more of the pictures.
    assert mean["psnr"] == pytest.approx(measure.result.metrics["psnr"], abs=0.1)
    unknown = bench(*common, "--runs", bench.store, "--model", "fit-nowhere", "--out", out / "x", code=2)
    assert "is no finished encode or measure job" in unknown.stderr
    edited = (*common, "--runs", bench.store, "--model", measure.job.id, "--edit", "a.palette=#0000ff")
    bench(*edited, "--out", out / "blue")
    assert (read_png(out / "blue" / "tiny" / "a" / "0003.png") == [0.0, 0.0, 1.0, 1.0]).all()
    refusal = "rendered elsewhere, so there is no truth for edits"
    assert refusal in bench(*edited, "--truth", code=2).stderr
    missing = bench(*common, "--runs", bench.store, "--model", measure.job.id, "--device", "cuda", code=2)
    assert "fake runs on cpu, not on cuda" in missing.stderr
