"""`bench run --retry busy`: disturbed times are measured again, and nothing that is finished is lost."""

from __future__ import annotations

import shutil
import signal

import pytest

from econgs_bench.bench.__main__ import _with_values, parser
from econgs_bench.bench.results.disturbed import disturbed_jobs, to_measure_again
from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.datasets.seals import sealed

from .conftest import PLUGINS, Bench, wait_for, workers

SEEDS = [word for seed in range(6) for word in ("--seed", str(seed))]


@pytest.fixture(scope="module")
def _six(dataset, tmp_path_factory):
    """A store of one scene with six seeds: enough times of the kernel to know the quiet one."""
    bench = Bench(tmp_path_factory.mktemp("six"), dataset)
    bench.run(*SEEDS)
    return bench.store


@pytest.fixture
def six(bench, _six):
    """That store, in which all times are quiet."""
    shutil.copytree(_six, bench.store)
    return quieted(bench)


@pytest.fixture
def copies(finished):
    """A quiet store in which seed 0 was run; five more seeds have its records, and no files."""
    store = Store(finished.store)
    chain = [record for kind in ("fit", "encode", "measure") for record in finished.of_kind(kind)]
    for seed in range(1, 6):
        names: dict[str, str] = {}
        for record in chain:
            needs = tuple(names.get(need, need) for need in record.job.needs)
            changes = {"seed": seed, "key": hash_of([record.job.key, seed]), "needs": needs}
            job = record.job.model_copy(update=changes)
            names[record.job.id] = job.id
            store.finish(record.model_copy(update={"job": job}))
    return quieted(finished)


def quieted(bench) -> Bench:
    store = Store(bench.store)
    for record in list(store.records()):
        quiet = {"reference_seconds": 0.1, "reference_worst": 0.1}
        even = {"frame_seconds": 0.01, "frame_seconds_p05": 0.01, "frame_seconds_p95": 0.01}
        for kind, changes in (("fit", quiet), ("measure", quiet | even)):
            if record.job.kind == kind:
                changed = record.result.model_copy(update=changes)
                rewrite(
                    bench, record.model_copy(update={"result": changed, "finished": "2026-12-01T00:00:00"})
                )
    assert disturbed_jobs(Store(bench.store).records()) == {}
    return bench


def rewrite(bench, record) -> None:
    """Put a record in the place of an earlier one, beside the files of its job."""
    file = bench.store / "jobs" / record.job.id / "record.json"
    write_text(file, sealed(record.model_dump_json(indent=1) + "\n"))


def disturb(bench, kind: str, seed: int, **changes: float) -> str:
    """Lengthen times of a job; its id."""
    (record,) = [one for one in bench.of_kind(kind) if one.job.seed == seed]
    result = record.result.model_copy(update=changes)
    rewrite(bench, record.model_copy(update={"result": result}))
    return record.job.id


def changed(bench, before) -> set[str]:
    """Jobs with another record than before."""
    return {name for name, record in bench.records().items() if record != before[name]}


@pytest.mark.slow
def test_disturbed_jobs_and_what_follows_from_them_run_again(six) -> None:
    frames = disturb(six, "measure", 1, frame_seconds_p95=0.05)
    amid = disturb(six, "measure", 2, reference_worst=0.2)
    fit = disturb(six, "fit", 3, reference_worst=0.2)
    before = six.records()
    assert disturbed_jobs(before.values()).keys() == {frames, amid, fit}
    chain = {name for name, record in before.items() if record.job.axes()["seed"] == 3}
    assert len(chain) == 3
    assert to_measure_again(before.values()).keys() == {frames, amid, *chain}
    six.run(*SEEDS, "--retry")
    assert changed(six, before) == set(), "failed jobs alone"
    six.run(*SEEDS, "--retry", "busy")
    assert changed(six, before) == {frames, amid, *chain}
    assert six.records().keys() == before.keys()
    assert all(record.ok for record in six.records().values())
    assert not list((six.store / "partial").iterdir())


@pytest.mark.parametrize("executor", ["local", "dask"])
def test_a_finished_job_is_not_lost_where_it_fails_again(copies, tmp_path, executor) -> None:
    """The fit breaks; its earlier model is measured again."""
    fit = disturb(copies, "fit", 0, reference_worst=0.2)
    before = copies.records()
    plugins = tmp_path / "own"
    shutil.copytree(copies.plugins, plugins, ignore=shutil.ignore_patterns("__pycache__"))
    file = plugins / "fake.py"
    file.write_text(
        file.read_text().replace("behaviour = _behaviour(options, targets)", 'behaviour = "raise"')
    )
    copies.plugins = plugins
    if executor == "dask":
        pytest.importorskip("distributed")
    done = copies.run("--retry", "busy", "--executor", executor)
    assert "a bug in the method" in done.stdout + done.stderr
    chain = {
        name
        for name, record in before.items()
        if record.job.kind != "views" and record.job.axes()["seed"] == 0
    }
    assert changed(copies, before) == chain - {fit}
    assert copies.records()[fit] == before[fit]
    assert all(record.ok for record in copies.records().values())
    assert not list((copies.store / "partial").iterdir())


@pytest.mark.slow
def test_a_finished_job_is_not_lost_where_its_next_run_is_killed(six, tmp_path) -> None:
    fit = disturb(six, "fit", 3, reference_worst=0.2)
    before = six.records()[fit]
    plugins = tmp_path / "own"
    shutil.copytree(six.plugins, plugins, ignore=shutil.ignore_patterns("__pycache__"))
    file = plugins / "fake.py"
    file.write_text(
        file.read_text()
        .replace("if options.pace:", "if True:")
        .replace("time.sleep(options.pace)", "time.sleep(0.5)")
    )
    six.plugins = plugins
    for victim in ("worker", "run"):
        process = six.start(*SEEDS, "--retry", "busy")
        wait_for((six.store / "partial" / fit / "progress.jsonl").is_file)
        if victim == "worker":
            workers(process)[0].kill()
        else:
            process.send_signal(signal.SIGKILL)
        process.communicate(timeout=120)
        assert six.records()[fit] == before
    wait_for(lambda: not Store(six.store).lease(fit).is_held)
    six.plugins = PLUGINS
    six.run(*SEEDS, "--retry", "busy")
    after = six.records()[fit]
    assert after.ok
    assert after.finished != before.finished


@pytest.mark.parametrize(
    ("words", "value", "suite"),
    [
        (["--retry", "quick"], "failed", "quick"),
        (["quick", "--retry"], "failed", "quick"),
        (["quick", "--retry", "--seed", "1"], "failed", "quick"),
        (["--retry", "busy", "quick"], "busy", "quick"),
        (["quick", "--retry=busy"], "busy", "quick"),
        (["--retry", "failed", "quick"], "failed", "quick"),
        (["quick"], None, "quick"),
    ],
)
def test_retry_with_and_without_a_value(words, value, suite) -> None:
    options = parser().parse_args(_with_values(["run", *words]))
    assert (options.retry, options.suite) == (value, suite)
