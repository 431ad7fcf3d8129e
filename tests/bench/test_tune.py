"""Tuning: what trials have, that they survive interruption, and that no test view has a part in them."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from dataclasses import field, make_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from optuna._hypervolume import compute_hypervolume

from econgs_bench.bench.__main__ import main
from econgs_bench.bench.commands import tune as command_line
from econgs_bench.bench.jobs.encode import EncodeResult
from econgs_bench.bench.jobs.fit import FitResult
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.plan.selection import Selection
from econgs_bench.bench.results.tables import build_tables
from econgs_bench.bench.store.progress import now
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.bench.tune import study as tune
from econgs_bench.bench.tune.objective import front, hypervolume, objective_of
from econgs_bench.bench.tune.space import range_of, search_space, starts
from econgs_bench.bench.tune.study import Point, Trial, Trials
from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.methods.interface import OPTION, PRESETS, Option
from econgs_bench.methods.options import parse_assignments, resolve
from econgs_bench.methods.registry import Registry, check_spec

from .conftest import PATIENCE, PLUGINS, measured, plan, runs, workers

FRONT = objective_of("front=20,0.0625")
REGISTRY = Registry([PLUGINS])


class Lab:
    """Studies of a small suite whose jobs have results by a formula, without processes.

    Attributes:
        ran: ids of the jobs that had no record before.
        cured: whether a bad mood does no harm.
    """

    def __init__(self, suite: str, store: Store) -> None:
        self._suite = suite
        self.store = store
        self.ran: list[str] = []
        self.cured = False

    def trials(self, budget: int, method: str = "fake-tuned", **changes) -> Trials:
        selection = Selection(load_suite(self._suite), methods=(method,), plugins=(str(PLUGINS),))
        usual = {"objective": FRONT, "fixed": {}, "names": (), "show": lambda study, trial: None}
        return Trials(selection, budget=budget, **{**usual, **changes})

    def run(self, budget: int, jobs: float = float("inf"), **changes) -> tune.Study:
        """A study, which is interrupted after a number of jobs."""
        trials, attempted = self.trials(budget, **changes), set()
        trials.jobs(self.store)  # a run asks before it begins, too
        while due := [job for job in trials.jobs(self.store) if self._is_due(job, changes, attempted)]:
            for job in due:
                if jobs <= 0:
                    return trials.study
                jobs -= 1
                attempted.add(job.id)
                self.ran.append(job.id)
                self.store.finish(self._record(job))
        return trials.study

    def _is_due(self, job: Job, changes: dict, attempted: set[str]) -> bool:
        record = self.store.record(job.id)
        if record is None:
            return True
        return bool(changes.get("retry")) and not record.ok and job.id not in attempted

    def _record(self, job: Job) -> Record:
        record = Record(job=job, status="ok", started=now(), finished=now(), wall_seconds=1.0)
        options = getattr(job, "options", {})
        bad = options.get("mood") == "bad" and not self.cured
        if bad:
            return record.model_copy(update={"status": "diverged", "reason": "it is in a bad mood"})
        shift, rate = float(options.get("shift", 0.3)), getattr(job, "rate", None) or 3.0
        if job.kind == "views":
            record.result = ViewsResult(view_keys={}, background=(0, 0, 0), truth={}, render_seconds=1.0)
        if job.kind == "fit":
            record.result = FitResult(seconds=1.0, iterations=1, primitives={}, train_views=1, curve=[],
                                   resumed=0, reference_seconds=None)  # fmt: skip
        if job.kind == "encode":
            total = int(int(options.get("length", 4000)) * rate)
            ledger = {job.scenes[0]: {"all": total}}
            record.result = EncodeResult(seconds=1.0, total_bytes=total, ledger=ledger)
        if job.kind == "measure":
            record.result = measured(30.0 - 40.0 * abs(shift - 0.3) + rate, 1)
        return record


@pytest.fixture
def lab(suite, tmp_path) -> Lab:
    return Lab(suite(), Store(tmp_path / "runs", create=True))


# --------------------------------------------------------------------------- scores


def test_the_area_of_a_front_is_optunas_and_that_of_a_grid() -> None:
    """Points beyond the reference and dominated ones are among them."""
    rng = np.random.default_rng(0)
    for count in (1, 2, 7, 30):
        mib, psnr = 2.0 ** rng.uniform(-6, 7, count), rng.uniform(15, 45, count)
        area = hypervolume(np.stack([mib, psnr], axis=1), (20.0, 64.0))
        losses = np.stack([np.log2(mib), -psnr], axis=1)
        within = losses[(losses < [6.0, -20.0]).all(axis=1)]
        assert area == pytest.approx(
            compute_hypervolume(within, np.array([6.0, -20.0])) if len(within) else 0
        )
        x, y = np.meshgrid(np.linspace(-6, 6, 600), np.linspace(20, 45, 600))
        counted = np.any([(x >= np.log2(m)) & (y <= p) for m, p in zip(mib, psnr, strict=True)], axis=0)
        assert area == pytest.approx(counted.mean() * 12 * 25, abs=1.5)


def test_the_area_of_one_model_is_a_rectangle() -> None:
    assert hypervolume([[1.0, 30.0]], (20.0, 4.0)) == 20.0
    assert hypervolume([[1.0, 30.0], [2.0, 35.0]], (20.0, 4.0)) == 25.0
    assert hypervolume([[8.0, 30.0]], (20.0, 4.0)) == hypervolume([[1.0, 19.0]], (20.0, 4.0)) == 0.0


def test_psnr_at_a_size_is_that_of_the_best_model_that_fits() -> None:
    size = objective_of("size=0.5")
    assert size.score([[0.1, 20.0], [0.5, 30.0], [0.6, 40.0]]) == 30.0
    assert size.score([[1.0, 40.0], [2.0, 50.0]]) == -1.0
    assert objective_of("psnr").score([[1.0, 40.0], [2.0, 39.0]]) == 40.0


def test_the_score_of_a_single_model_is_its_rectangle() -> None:
    point = objective_of("point=20,4")
    assert point.score([[1.0, 30.0]]) == 20.0
    assert point.score([[8.0, 30.0]]) == 0.0
    assert (point.text, objective_of("point").text) == ("point=20,4", "point=20,64")


def test_nothing_is_chosen_where_all_models_are_beyond_the_reference_point(lab, capsys) -> None:
    study = lab.run(3, objective=objective_of("point=99,64"))
    assert [trial.score for trial in study.trials] == [0.0, 0.0, 0.0]
    assert study.chosen is None
    assert main(["tune", "fake-tuned", "--show", "--out", str(lab.store.root)]) == 0
    assert "name another one: --objective point=DB,MIB" in capsys.readouterr().out


def test_a_score_is_the_mean_over_scenes_and_seeds() -> None:
    points = [
        Point(dataset="d", scene=scene, seed=seed, rate=rate, psnr=psnr, bytes=2**20)
        for scene, seed, rate, psnr in (("a", 0, 1, 10), ("a", 0, 2, 20), ("a", 1, 1, 30), ("b", 0, 1, 40))
    ]
    assert tune.score(points, objective_of("psnr")) == 30.0


def _trial(number: int, *models: tuple[float, float], score: float | None = 1.0) -> Trial:
    """A trial with one model per scene, each of MiB and PSNR."""
    points = [
        Point(dataset="d", scene=f"s{place}", seed=0, rate=None, psnr=psnr, bytes=round(mib * 2**20))
        for place, (mib, psnr) in enumerate(models)
    ]
    return Trial(number=number, overrides={}, values={}, status="ok", score=score, points=points)


def test_a_setting_is_as_good_as_the_defaults_within_its_limits_and_in_fewer_bytes() -> None:
    default = _trial(1, (2.0, 30.0), (2.0, 34.0), score=3.0)
    scores_least = _trial(2, (1.0, 30.0), (1.0, 34.0), score=4.0)
    scores_most = _trial(3, (1.0, 29.75), (1.0, 34.2), score=5.0)  # -0.25 and +0.2 dB
    loses_in_the_mean = _trial(4, (0.1, 29.85), (0.1, 33.9), score=9.0)
    loses_on_a_scene = _trial(5, (0.1, 29.6), (0.1, 34.4), score=9.0)
    is_larger = _trial(6, (3.0, 40.0), (3.0, 40.0), score=9.0)
    failed = _trial(7, score=None)
    every = (default, scores_least, scores_most, loses_in_the_mean, loses_on_a_scene, is_larger, failed)
    assert tune.smaller(every, default) is scores_most
    assert tune.smaller((default, loses_in_the_mean, loses_on_a_scene, is_larger, failed), default) is None
    assert tune.smaller(every, failed) is None


def test_a_front_has_what_no_other_model_beats() -> None:
    assert front([[2, 30], [1, 20], [3, 30], [2, 25], [1, 19], [4, 31]]) == [1, 0, 5]


@pytest.mark.parametrize(
    "text", ["fronts", "front=20", "front=20,0", "size", "size=-1", "size=x", "size=nan", "psnr=3", ""]
)
def test_other_objectives_are_refused(text: str) -> None:
    with pytest.raises(DataError, match="front, front=DB,MIB"):
        objective_of(text)


# --------------------------------------------------------------------------- search space


@pytest.mark.parametrize(
    ("option", "values", "low", "high", "log"),
    [
        (Option(1e-3, "", 0.0, 1.0), [1e-3, 4e-3], 2.5e-4, 1.6e-2, True),
        (Option(0.5, "", 0.0, 1.0), [0.5], 0.125, 1.0, True),
        (Option(0.1, "", 0.0), [0.1, 0.0], 0.0, 0.4, False),
        (Option(0.0, "", 0.0, 2.0), [0.0], 0.0, 2.0, False),
        (Option(0.5, "", 1e-3, 4.999), [0.5, 2.5], 0.125, 4.999, True),
        (Option(3, "", 0, 3), [3], 1, 3, False),
        (Option(10, "", 1, 64), [10], 3, 40, True),
        (Option(0.0, "", 0.0, 9.0, search=(0.0, 2.0)), [0.0, 3.0], 0.0, 2.0, False),
    ],
)
def test_numbers_are_searched_around_their_starting_values(option, values, low, high, log) -> None:
    found = range_of(option, values)
    assert (found.low, found.high, found.log, found.whole) == (
        low,
        high,
        log,
        isinstance(option.default, int),
    )


@pytest.mark.parametrize("option", [Option("text", ""), Option(0, "", 0), Option(-1.0, "")])
def test_what_has_neither_scale_nor_bounds_has_no_range(option) -> None:
    assert range_of(option, [option.default]) is None


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", REGISTRY.built_in())
def test_every_method_has_options_to_tune_and_as_many_as_others(name, preset) -> None:
    """Eight and rates that need a fit each, or all; both starting points lie in the space."""
    spec = REGISTRY.spec(name)
    knobs = [knob.name for knob in spec.rate_knobs if knob.refit]
    assert set(search_space(spec, preset, {})) == {*search_space(spec, preset, {}, swept=knobs), *knobs}
    space = search_space(spec, preset, {}, swept=knobs)
    untrained = {"mesh": 3, "sz3": 1, "zfp": 2}
    assert len(space) == untrained.get(name, 8)
    for start in starts(spec, {}):
        values = resolve(spec, preset, start).values
        for option, one in space.items():
            assert one.distribution()._contains(one.distribution().to_internal_repr(values[option])), option
            if not one.choices:
                resolve(spec, preset, {option: one.low})
                resolve(spec, preset, {option: one.high})


def test_tunable_options_must_exist() -> None:
    with pytest.raises(UnknownName, match=r"tunable option 'shft' of method fake-tuned.*shift"):
        check_spec(replace(REGISTRY.spec("fake-tuned"), tunable=("shft",)), "here")


@pytest.mark.parametrize(("search", "reason"), [((0.0, 2.0), "above the maximum 1"), ((0.5, 0.5), "search")])
def test_a_range_of_the_search_lies_within_the_bounds(search, reason) -> None:
    one = field(default=0.5, metadata={OPTION: Option(0.5, "x", 0.0, 1.0, search=search)})
    options = make_dataclass("Options", [("shift", float, one)], frozen=True)
    spec = replace(REGISTRY.spec("fake-tuned"), options=options, presets={}, configurations={}, tunable=())
    with pytest.raises(DataError, match=reason):
        check_spec(spec, "here")


# --------------------------------------------------------------------------- trials


def test_the_first_trials_are_the_published_settings_and_the_defaults(lab) -> None:
    study = lab.run(3, fixed={"pace": "0.5"})
    assert [trial.overrides for trial in study.trials[:2]] == [
        {"configuration": "paper", "pace": 0.5}, {"pace": 0.5},
    ]  # fmt: skip
    assert [trial.values["shift"] for trial in study.trials[:2]] == [0.6, 0.2]
    assert study.trials[2].overrides["pace"] == 0.5
    assert study.fixed == {"pace": 0.5}
    assert "pace" not in study.space


def test_trials_have_every_rate_unless_quality_alone_counts(lab) -> None:
    both = [
        trial
        for objective in ("size=1", "point=1,64", "psnr")
        for trial in lab.run(1, objective=objective_of(objective)).trials
    ]
    assert [sorted({point.rate for point in one.points}, key=str) for one in both] == [
        [2.0, 6.0, None],
        [None],
        [None],
    ]


def test_an_interrupted_study_goes_on_with_the_same_trials(lab, suite, tmp_path) -> None:
    """Whenever it stops, and even if its file is lost; no job runs twice."""
    whole = Lab(suite(), Store(tmp_path / "whole", create=True))
    expected = whole.run(5)
    for _ in range(0, len(whole.ran), 9):
        lab.run(5, jobs=9)
    assert lab.run(5, jobs=0) == expected
    assert lab.ran == whole.ran
    assert len(expected.trials) == 5 > tune.FIRST
    (file,) = (lab.store.root / "studies").glob("*.json")
    text = file.read_text(encoding="utf-8")
    assert tune.read_study(file) == expected
    file.unlink()
    lab.run(5, jobs=0)
    assert file.read_text(encoding="utf-8") == text


def test_more_trials_continue_a_study_and_other_conditions_begin_another(lab) -> None:
    few, many = lab.run(2), lab.run(4)
    assert many.trials[:2] == few.trials
    assert lab.run(3) == many
    names = {lab.trials(3, **changes).study.name for changes in (
        {}, {"fixed": {"pace": 1.0}}, {"objective": objective_of("psnr")}, {"names": ("shift",)},
    )}  # fmt: skip
    assert len(names) == 4
    assert few.name == many.name in names


def test_another_protocol_under_the_same_name_begins_another_study(lab) -> None:
    before = lab.trials(1).study
    file = Path(lab._suite)
    file.write_text(file.read_text().replace("width = 16", "width = 16\ncloud_points = 50"))
    after = lab.trials(1).study
    assert after.conditions.suite == before.conditions.suite
    assert after.name != before.name


def test_seeds_change_the_search_and_the_number_of_trials_does_not(lab) -> None:
    study = lab.run(4)
    assert len({json.dumps(trial.values) for trial in study.trials}) == 4
    spec = REGISTRY.spec("fake-tuned")
    other = study.model_copy(update={"conditions": study.conditions.model_copy(update={"seeds": (1,)})})
    again = tune.propose(study.model_copy(update={"budget": 99}), spec, "quick", 3)
    assert again[1] == study.trials[3].values != tune.propose(other, spec, "quick", 3)[1]


def test_the_chosen_options_win_on_validation_views(lab) -> None:
    """By the tables of the store; the line to copy gives the very jobs of the chosen trial."""
    study = lab.run(9, objective=objective_of("psnr"))
    results = build_tables(lab.store, write=False)["results"]
    psnr = results.groupby("variant")["psnr"].mean()
    best = study.trials[study.chosen.trial]
    assert study.chosen.score == psnr.max() > psnr["configuration=paper"]
    assert study.chosen.gains["fair"] == pytest.approx(psnr.max() - psnr[""])
    assert study.chosen.gains["fair"] > 0.0
    assert abs(best.values["shift"] - 0.3) < 0.1
    words = tune.command("fake-tuned", study.chosen.overrides).split()
    assert words[0::2] == ["--set"] * len(study.chosen.overrides)
    selection = {"methods": ("fake-tuned",), "split": "val", "overrides": parse_assignments(words[1::2])}
    fits = [job.id for job in plan(lab._suite, **selection) if job.kind == "fit"]
    assert fits
    assert set(fits) <= set(lab.ran)


def test_the_option_that_matters_is_important(lab) -> None:
    study, rng = lab.trials(24).study, np.random.default_rng(0)
    for number in range(24):
        values = {"shift": rng.uniform(0.05, 1.0), "length": int(rng.integers(1000, 16000))}
        trial = Trial(number=number, overrides=values, values=values, status="ok", score=-values["shift"])
        study = study.with_trial(trial)
    shares = tune.importances(study)
    assert list(shares) == ["shift", "length"]
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["shift"] > 0.8
    assert tune.importances(study.model_copy(update={"trials": study.trials[:19]})) == {}


# --------------------------------------------------------------------------- failures and budgets


def test_a_trial_that_fails_counts_and_has_its_reason(lab) -> None:
    study = lab.run(6, names=("mood", "shift"))
    failed = [trial for trial in study.trials if trial.values["mood"] == "bad"]
    assert 0 < len(failed) < 4
    assert {(one.status, one.reason, one.score) for one in failed} == {
        ("diverged", "it is in a bad mood", None)
    }
    assert study.chosen.trial not in {one.number for one in failed}
    told = tune._told(study.trials, study.space)
    assert [trial.number for trial in told.trials if trial.value is None] == [one.number for one in failed]
    assert len(study.trials) == study.budget == 6


def test_retry_runs_failed_trials_again_in_their_places(lab) -> None:
    before = lab.run(6, names=("mood", "shift"))
    failed = [trial.number for trial in before.trials if trial.score is None]
    assert failed
    assert lab.run(6, names=("mood", "shift"), retry=True) == before  # they fail again
    lab.cured = True
    assert lab.run(6, names=("mood", "shift")) == before
    after = lab.run(6, names=("mood", "shift"), retry=True)
    assert all(trial.score is not None for trial in after.trials)
    assert [trial.values for trial in after.trials] == [trial.values for trial in before.trials]
    assert [one for one in after.trials if one.number not in failed] == [
        one for one in before.trials if one.number not in failed
    ]


def test_methods_have_equal_conditions_and_budgets(lab) -> None:
    """Data, views, seeds, objective and number of trials; failed ones count."""
    ours, theirs = lab.run(4), lab.run(4, method="fake", names=("behaviour",))
    assert (ours.conditions, ours.budget) == (theirs.conditions, theirs.budget)
    assert len(ours.trials) == len(theirs.trials) == 4
    assert (ours.starts, theirs.starts) == (2, 1)
    assert "under the same conditions: fake, score " in "\n".join(command_line._summary(ours, lab.store))
    lab.run(6, method="fake", names=("behaviour",))
    last = "\n".join(command_line._summary(ours, lab.store))
    assert re.search(r"fake, (score \S+|nothing chosen) of 6 trials \(another budget\)", last)


# --------------------------------------------------------------------------- test views


def test_no_trial_has_a_job_of_the_test_split(lab) -> None:
    """Whatever the selection and its suite ask for."""
    suite = replace(load_suite(lab._suite), compositions="all", dvr=True, edits=("opacity=0.5",))
    asked = Selection(suite, methods=("fake-tuned",), plugins=(str(PLUGINS),), split="test", composed=True)
    trials = Trials(asked, objective=FRONT, fixed={}, names=(), budget=3, show=lambda study, trial: None)
    lab.trials = lambda budget, **changes: trials
    assert len(lab.run(3).trials) == 3
    jobs = [record.job for record in lab.store.records()]
    assert {job.split for job in jobs} == {"val"}
    assert {job.identity["trains_on"] for job in jobs if job.kind == "fit"} == {"train"}
    assert {job.kind for job in jobs} == {"views", "fit", "encode", "measure"}
    assert not any(job.composition or job.edit for job in jobs)


@pytest.fixture(scope="module")
def blind(dataset, tmp_path_factory):
    """The tiny dataset with test pictures that nobody can read."""
    import shutil

    root = tmp_path_factory.mktemp("blind") / "tiny"
    shutil.copytree(dataset, root)
    pictures = list(root.glob("*/test/*.png"))
    assert pictures
    for picture in pictures:
        picture.write_bytes(b"no picture")
    return root


def _arguments(bench, data, *more: object) -> tuple[object, ...]:
    usual = (
        "--objective",
        "psnr",
        "--trials",
        2,
        "--set",
        "fake-tuned.configuration=fair",
        "--scene",
        "a",
        "--plugins",
        PLUGINS,
        "--out",
        bench.store,
    )
    return ("tune", "fake-tuned", "quick", "--dataset", data, *usual, *more)


@pytest.fixture
def undisturbed(bench, blind, tmp_path):
    """A study by real processes, and what the command printed."""
    done = bench(*_arguments(bench, blind))
    (study,) = tune.studies(bench.store)
    return study, done


@pytest.mark.slow
def test_a_study_survives_kill_9_and_opens_no_test_view(bench, blind, undisturbed, tmp_path) -> None:
    """The same trials as without; finished jobs are not run again. No test picture can be read."""
    expected, done = undisturbed
    assert len(expected.trials) == 2
    assert all(trial.score is not None for trial in expected.trials)
    assert not list(bench.store.rglob("test.*"))
    assert [line.split(":")[0] for line in done.stdout.splitlines() if line.startswith("trial ")] == [
        "trial 0", "trial 1",
    ]  # fmt: skip
    assert tune.command("fake-tuned", expected.chosen.overrides) in done.stdout.splitlines()
    shown = bench("tune", "fake-tuned", "--show", "--out", bench.store)
    assert shown.stdout.strip() == done.stdout.strip()

    bench.store = tmp_path / "killed"
    process = bench._start(bench.command(*_arguments(bench, blind)))
    end = time.monotonic() + PATIENCE
    while not (files := list(bench.store.glob("jobs/encode-*"))) or len(files) < 2:
        assert time.monotonic() < end
        assert process.poll() is None
        time.sleep(0.02)
    left = workers(process)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=PATIENCE)
    while any(map(runs, left)):  # a worker may finish its job before it notices
        assert time.monotonic() < end
        time.sleep(0.02)
    (before,) = tune.studies(bench.store)
    assert len(before.trials) == 1
    finished = set(bench.records())
    again = bench(*_arguments(bench, blind))
    assert tune.studies(bench.store) == [expected]
    ran = [line for line in again.stderr.splitlines() if "ok after" in line]
    assert len(ran) == len(bench.records()) - len(finished)


# --------------------------------------------------------------------------- errors


@pytest.fixture
def refusal(dataset, tmp_path, monkeypatch, capsys):
    """The one line that an unusable request ends with."""
    monkeypatch.chdir(tmp_path)
    usual = ("--dataset", str(dataset), "--scene", "a", "--plugins", str(PLUGINS), "--out", "runs")

    def refuse(*arguments: str) -> str:
        with pytest.raises(SystemExit) as end:  # argparse's errors end so, ours by a code
            raise SystemExit(main(["tune", *arguments, *usual]))
        assert end.value.code == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("bench: ")
        assert printed.err.count("\n") == 1
        return printed.err

    return refuse


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fake-tund"], "method 'fake-tund': unknown name. Did you mean fake-tuned"),
        (["nobody"], "method 'nobody': unknown name. Known: 3dgs, "),
        (["nobody"], "zfp; --plugins FOLDER adds methods of your own"),
        (["fake-tuned", "quik"], "suite 'quik': unknown name. Did you mean quick?"),
        (["fake-tuned", "--option", "shft"], "option 'shft' of method fake-tuned: unknown name"),
        (["fake-tuned", "--option", "only"], "only: has no range: it is a text. Others: behaviour, "),
        (["fake-tuned", "--option", "pace"], "pace: has no range: it is 0 without a maximum."),
        (["fake-tuned", "--option", "shift", "--set", "fake-tuned.shift=0.2"], "has one value in all trials"),
        (["fake-tuned", "--set", "fake-tuned.shift=7"], "above the maximum 1"),
        (["fake-tuned", "--set", "3dgs.sh_degree=1"], "method '3dgs' of this study (--set)"),
        (["fake", "--set", "fake.behaviour=good"], "'fake': has no options to tune beside those of --set"),
        (["econgs", "--option", "rate_weight"], "has all values of this rate knob. Use --objective point"),
        (["fake-tuned", "--trials", "0"], "'0' is not a number of at least 1"),
        (["fake-tuned", "--objective", "size"], "--objective size: no objective. Write front, front=DB,MIB"),
    ],
)  # fmt: skip
def test_unusable_requests_are_one_line(refusal, tmp_path, arguments, words) -> None:
    assert words in refusal(*arguments)
    assert not (tmp_path / "runs").exists()


def test_tuning_without_its_package_names_the_remedy(refusal, monkeypatch) -> None:
    monkeypatch.setattr(command_line, "find_spec", lambda name: None)
    assert "needs the package optuna. pip install 'econgs-bench[tune]'" in refusal("fake-tuned")


@pytest.mark.parametrize("damage", ["{", "[]", "schema", "trial"])
def test_a_damaged_study_is_named_and_can_be_made_again(lab, damage: str) -> None:
    study = lab.run(3)
    (file,) = (lab.store.root / "studies").glob("*.json")
    content = json.loads(file.read_text(encoding="utf-8"))
    changed = {
        "schema": content | {"schema_version": 99},
        "trial": content | {"trials": content["trials"][1:]},
    }
    file.write_text(json.dumps(changed[damage]) if damage in changed else damage, encoding="utf-8")
    for attempt in (lambda: lab.run(3), lambda: tune.studies(lab.store.root)):
        with pytest.raises(DataError, match="Delete it: the same command makes it again") as error:
            attempt()
        assert str(file) in str(error.value)
    file.unlink()
    assert lab.run(3, jobs=0) == study


def test_a_store_without_a_study_of_the_method_names_those_that_it_has(lab, capsys) -> None:
    lab.run(1)
    show = ["--show", "--out", str(lab.store.root)]
    assert main(["tune", "fake", *show]) == 2
    assert "no study of 'fake'. It has studies of fake-tuned" in capsys.readouterr().err
    assert main(["tune", "fake-tuned", *show]) == 0
    assert "chosen: trial 0" in capsys.readouterr().out
