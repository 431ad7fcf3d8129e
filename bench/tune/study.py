"""Tuning: a search for the options with which a method does best on validation views.

A study is a sequence of trials. A trial is a variant of a suite's plan, and its jobs are ordinary jobs of the
run store. The options of a trial follow from the trials before it, the seed and its number alone, so a
study that was interrupted goes on as if nothing had happened.

    RUNS/studies/METHOD-KEY.json    the study: conditions, search space, trials, chosen options
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import ValidationError

from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.results.tables import stored_tables
from econgs_bench.bench.store.progress import now
from econgs_bench.bench.store.records import Job, Record, Value, derived_seed
from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.bench.tune.objective import Objective, objective_of
from econgs_bench.bench.tune.space import PUBLISHED, Range, Stored, search_space, starts
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.methods.interface import MethodSpec, OptionValue
from econgs_bench.methods.options import ITERATIONS, resolve, written
from econgs_bench.reports.schema import joined

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.bench.plan.selection import Selection

FOLDER = "studies"
"""Folder of a run store with its studies."""
SCHEMA = 1
FIRST = 4
"""Trials, starting points among them, after which proposals follow from a model of the scores."""
ENOUGH = 20
"""Trials that must have succeeded before options are said to be important: five are in the best quarter."""
LOSS = 0.1
"""dB by which a trial that is as good as the defaults may lie below them, mean over scenes and seeds."""
SCENE_LOSS = 0.3
"""dB by which it may on any scene; repeated fits differ by as much."""


# --------------------------------------------------------------------------- study


class Point(Stored):
    """A model of a trial, measured on validation views.

    Attributes:
        rate: value of the method's rate knob; None: the method's own size.
        psnr: mean over the views, dB.
        bytes: the scene's share of the files.
    """

    dataset: str
    scene: str
    seed: int
    rate: float | None
    psnr: float
    bytes: int

    @property
    def mib(self) -> float:
        return self.bytes / 2**20


class Trial(Stored):
    """A trial that has ended.

    Attributes:
        overrides: options that differ from the preset's, with "configuration".
        values: option of the search space -> value.
        status: "ok", or that of the first job that failed.
        reason: why it failed.
        score: by the study's objective; None if it failed.
        points: its models.
    """

    number: int
    overrides: dict[str, Value]
    values: dict[str, Value]
    status: str
    reason: str = ""
    score: float | None = None
    points: tuple[Point, ...] = ()


class Conditions(Stored):
    """What decides the scores of a study, apart from the method: studies under the same compare.

    Attributes:
        scenes: dataset, scene and hash of its content.
        protocol: views, cloud points and share of the iterations (:class:`.bench.suites.suite.ViewPreset`).
        seeds: of the fits; the first one seeds the search.
        objective: :attr:`Objective.text`.
    """

    suite: str
    preset: str
    scenes: tuple[tuple[str, str, str], ...]
    protocol: dict[str, Value]
    seeds: tuple[int, ...]
    objective: str
    device: str
    split: Literal["val"] = "val"


class Chosen(Stored):
    """The best trial.

    Attributes:
        gains: "paper" or "fair" -> its score minus that of the starting point; none where that failed.
    """

    trial: int
    score: float
    overrides: dict[str, Value]
    gains: dict[str, float]


class Study(Stored):
    """A study as its file holds it.

    Attributes:
        fixed: options that every trial has.
        space: option -> range.
        starts: number of trials that were given and not searched.
        budget: number of trials that were asked for.
        chosen: the best trial; None as long as none has succeeded, or all lie beyond the reference point.
    """

    schema_version: int = SCHEMA
    method: str
    version: str
    conditions: Conditions
    fixed: dict[str, Value]
    space: dict[str, Range]
    starts: int
    budget: int
    chosen: Chosen | None = None
    trials: tuple[Trial, ...] = ()

    @property
    def name(self) -> str:
        """Method and hash of all that decides the trials."""
        return f"{self.method}-{hash_of(self.model_dump(exclude={'budget', 'chosen', 'trials'}))[:10]}"

    @property
    def objective(self) -> Objective:
        return objective_of(self.conditions.objective)

    @property
    def default(self) -> Trial | None:
        """The trial with the method's own defaults; None as long as it has not ended."""
        return next((one for one in self.trials if one.number == self.starts - 1), None)

    def with_trial(self, trial: Trial) -> Study:
        """The study after one more trial, or after another attempt at one; the best one is chosen anew."""
        trials = {one.number: one for one in (*self.trials, trial)}
        every = tuple(trials[number] for number in sorted(trials))
        return self.model_copy(update={"trials": every, "chosen": self._choice(every)})

    def _choice(self, trials: Sequence[Trial]) -> Chosen | None:
        scores = {one.number: one.score for one in trials if one.score is not None}
        if not scores:
            return None
        best = max(scores, key=lambda number: (scores[number], -number))
        if self.objective.has_reference and scores[best] <= 0.0:  # all beyond the reference point
            return None
        names = (PUBLISHED, "fair")[-self.starts :]
        gains = {name: scores[best] - scores[place] for place, name in enumerate(names) if place in scores}
        return Chosen(trial=best, score=scores[best], overrides=trials[best].overrides, gains=gains)


def validation(selection: Selection, objective: Objective) -> Selection:
    """What every trial runs: basic scenes, measured on validation views.

    No job of it reads test views, whatever the selection says.
    """
    suite = replace(
        selection.suite,
        variants=({},),
        rates="all" if objective.every_rate else "default",
        lengths=(),
        compositions=(),
        dvr=False,
        parsimony=False,
        edits=(),
        chains=(),
        ladders=(),
        repeats=(),
    )
    return replace(selection, suite=suite, split="val", composed=False, overrides={})


def propose(study: Study, spec: MethodSpec, preset: str, number: int) -> tuple[dict[str, Value], ...]:
    """Overrides of a trial, and the values of the search space among them.

    They follow from the trials of smaller numbers, the seed and the number. The first trials are the starting
    points (:func:`starts`). The others are Optuna's: random until :data:`FIRST` have succeeded, then those of
    a Gaussian process.
    """
    given = starts(spec, study.fixed)
    if number < len(given):
        values = resolve(spec, preset, given[number]).values
        return given[number], {name: values[name] for name in study.space}
    import optuna

    seed = derived_seed("trial", study.conditions.seeds[0], number)
    sampler = optuna.samplers.GPSampler(seed=seed, n_startup_trials=FIRST)
    told = _told(study.trials[:number], study.space, sampler)
    asked = told.ask({name: one.distribution() for name, one in study.space.items()})
    values = {name: one.tidy(asked.params[name]) for name, one in study.space.items()}
    return {**study.fixed, **values}, values


def _told(trials: Iterable[Trial], space: Mapping[str, Range], sampler: Any = None) -> Any:
    """Optuna's own study, in memory, with trials that have ended."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    told = optuna.create_study(direction="maximize", sampler=sampler)
    distributions = {name: one.distribution() for name, one in space.items()}
    for trial in trials:
        failed = trial.score is None
        told.add_trial(
            optuna.trial.create_trial(
                state=optuna.trial.TrialState.FAIL if failed else optuna.trial.TrialState.COMPLETE,
                value=trial.score,
                params=trial.values,
                distributions=distributions,
                user_attrs={"reason": trial.reason} if failed else {},
            )
        )
    return told


def importances(study: Study) -> dict[str, float]:
    """Option -> its share in what sets the best quarter of the trials apart (PED-ANOVA), greatest first.

    Empty where fewer than :data:`ENOUGH` trials succeeded, or all scored the same.
    """
    scores = [one.score for one in study.trials if one.score is not None]
    if len(scores) < ENOUGH or len(set(scores)) == 1:
        return {}
    import optuna

    told = _told(study.trials, study.space)
    evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.25)
    shares: dict[str, float] = optuna.importance.get_param_importances(told, evaluator=evaluator)
    return shares


# --------------------------------------------------------------------------- file


def read_study(path: Path) -> Study:
    """Read and check a study.

    Raises:
        DataError: the file is no study.
    """
    remedy = "Delete it: the same command makes it again from the finished jobs of the run store"
    try:
        study = Study.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = ": ".join(map(str, [*first["loc"], first["msg"]]))
        raise DataError(path, f"no whole study ({where})", remedy) from error
    if study.schema_version != SCHEMA:
        reason = f"a study of schema {study.schema_version}; this program writes {SCHEMA}"
        raise DataError(path, reason, remedy)
    if [one.number for one in study.trials] != list(range(len(study.trials))):
        raise DataError(path, "trials are missing from the study", remedy)
    return study


def write_study(study: Study, root: Path) -> Path:
    """Write a study into a run store, whole or not at all; returns its file."""
    path = root / FOLDER / f"{study.name}.json"
    path.parent.mkdir(exist_ok=True)
    write_text(path, study.model_dump_json(indent=1) + "\n")
    return path


def studies(root: Path, method: str = "") -> list[Study]:
    """The studies of a run store, by name; of one method alone, if it is named.

    Raises:
        DataError: a file is no study.
    """
    files = sorted((root / FOLDER).glob("*.json"))
    return [read_study(file) for file in files if method in ("", file.stem.rpartition("-")[0])]


# --------------------------------------------------------------------------- trials


class Trials(Planner):
    """Plans the trials of a study one after another: the next one once all jobs of the last have records.

    Args:
        selection: its one method is tuned; of the rest, what :func:`validation` leaves. Data are read once.
        objective: gives trials their scores.
        fixed: options that every trial has.
        names: options to vary; default: those of :func:`search_space`.
        budget: number of trials.
        show: called with the study alone, then with each of its trials in turn, those of earlier runs too.
        retry: trials that failed are tried again.

    Attributes:
        study: as far as it is.

    Raises:
        UnknownName, DataError: as :class:`Planner` and :func:`search_space`.
    """

    def __init__(
        self,
        selection: Selection,
        *,
        objective: Objective,
        fixed: Mapping[str, OptionValue],
        names: Sequence[str],
        budget: int,
        show: Callable[[Study, Trial | None], None],
        retry: bool = False,
    ) -> None:
        super().__init__(validation(selection, objective))
        (self._spec,) = self._specs
        knobs = [knob.name for knob in self._spec.rate_knobs if knob.refit and objective.every_rate]
        given = resolve(self._spec, self._like, fixed)
        typed = {**given.values, ITERATIONS: given.iterations}
        fixed = {name: typed.get(name, value) for name, value in fixed.items()}
        self.study = Study(
            method=self._spec.name,
            version=self._spec.version,
            conditions=self._conditions(objective),
            fixed=fixed,
            space=search_space(self._spec, self._like, fixed, names, knobs),
            starts=len(starts(self._spec, fixed)),
            budget=budget,
        )
        self._show = show
        self._retry = retry
        self._open: list[int] | None = None
        self._begun = now()

    def _conditions(self, objective: Objective) -> Conditions:
        return Conditions(
            suite=self._selection.suite.name,
            preset=self._preset_name,
            scenes=tuple((one.name, *scene) for one in self._subsets for scene in one.hashes.items()),
            protocol=asdict(self._preset),
            seeds=tuple(self._seeds),
            objective=objective.text,
            device=self._selection.device.split(":")[0],
        )

    def jobs(self, store: Store | None) -> list[Job]:
        """The jobs of the trial that is under way; of the last one, once all have ended."""
        if store is None:
            raise ValueError("trials are planned within a run store")
        if self._open is None:
            self._open = self._begin(store.root)
        while True:
            number = self._open[0] if self._open else self.study.budget - 1
            overrides, values = self._options(number)
            self.vary([{self.study.method: overrides}])
            jobs = super().jobs(store)
            records = [record for job in jobs if (record := store.record(job.id)) is not None]
            again = self._retry and any(not one.ok and one.finished < self._begun for one in records)
            if not self._open or len(records) < len(jobs) or again:
                return jobs
            trial = self._trial(number, overrides, values, records)
            self._open.pop(0)
            self.study = self.study.with_trial(trial)
            write_study(self.study, store.root)
            self._show(self.study, trial)

    def total(self, jobs: list[Job], store: Store | None) -> tuple[int, bool]:
        """Of the trial that is under way: the options of the next ones follow from it."""
        return len(jobs), False

    def _begin(self, root: Path) -> list[int]:
        """Take over what a store knows of the study; returns the numbers of the trials to come.

        Raises:
            DataError: the study's file is damaged.
        """
        path = root / FOLDER / f"{self.study.name}.json"
        if path.is_file():
            known = read_study(path)
            budget = max(self.study.budget, len(known.trials))
            self.study = known.model_copy(update={"budget": budget})
        write_study(self.study, root)
        self._show(self.study, None)
        done = [one.number for one in self.study.trials if one.score is not None or not self._retry]
        for number in done:
            self._show(self.study, self.study.trials[number])
        return [number for number in range(self.study.budget) if number not in done]

    def _options(self, number: int) -> tuple[dict[str, Value], ...]:
        """Overrides of a trial and its values of the search space: those of an earlier attempt, or new."""
        if number < len(self.study.trials):
            trial = self.study.trials[number]
            return trial.overrides, trial.values
        return propose(self.study, self._spec, self._like, number)

    def _trial(
        self, number: int, overrides: dict[str, Value], values: dict[str, Value], records: Sequence[Record]
    ) -> Trial:
        """A trial whose jobs have all ended, with its score."""
        rows = joined(stored_tables(records, self.registry.specs))["results"]
        shown = resolve(self._spec, self._like, overrides).overrides
        trial = Trial(number=number, overrides=shown, values=values, status="ok")
        failed = rows[(rows["status"] != "ok") | rows["psnr"].isna() | rows["size_bytes"].isna()]
        if len(failed):
            row = failed.iloc[0]
            status = row["status"] if row["status"] != "ok" else "failed"
            reason = str(row["reason"] or "PSNR or size is missing")
            return trial.model_copy(update={"status": status, "reason": reason})
        points = tuple(_points(rows))
        return trial.model_copy(update={"points": points, "score": score(points, self.study.objective)})


def _points(rows: pd.DataFrame) -> Iterable[Point]:
    rates = rows["rate"].astype(float).fillna(rows["knob_value"].astype(float))
    for row, rate in zip(rows.to_dict("records"), rates, strict=True):
        yield Point(
            dataset=row["dataset"],
            scene=row["scene"],
            seed=int(row["seed"]),
            rate=None if math.isnan(rate) else rate,
            psnr=float(row["psnr"]),
            bytes=int(row["size_bytes"]),
        )


def score(points: Sequence[Point], objective: Objective) -> float:
    """Mean over scenes and seeds of the objective of their models."""
    models: dict[tuple[str, str, int], list[tuple[float, float]]] = {}
    for one in points:
        models.setdefault((one.dataset, one.scene, one.seed), []).append((one.mib, one.psnr))
    return float(np.mean([objective.score(each) for each in models.values()]))


def means(trial: Trial) -> list[tuple[float | None, float, float]]:
    """Rate, size in MiB and PSNR in dB of each model of a trial: means over scenes and seeds."""
    rates = dict.fromkeys(one.rate for one in trial.points)
    table = {rate: [(one.mib, one.psnr) for one in trial.points if one.rate == rate] for rate in rates}
    return [(rate, *map(float, np.mean(each, axis=0))) for rate, each in table.items()]  # type: ignore[misc]


def smaller(trials: Iterable[Trial], default: Trial) -> Trial | None:
    """The best-scored of the trials that are as good as the defaults in fewer bytes, if there is one.

    It lies at most :data:`LOSS` below them in the mean, and at most :data:`SCENE_LOSS` on any scene.

    Args:
        trials: of a study.
        default: the trial among them with the method's defaults. There is none as good as it where it
            failed, or where trials have a model per rate.
    """
    if default.score is None or len(means(default)) != 1:
        return None
    ((_, size, psnr),) = means(default)
    before = {(one.dataset, one.scene, one.seed): one.psnr for one in default.points}
    found = []
    for trial in trials:
        if trial.score is None or trial.number == default.number:
            continue
        ((_, own_size, own_psnr),) = means(trial)
        gains = [one.psnr - before[one.dataset, one.scene, one.seed] for one in trial.points]
        if own_size < size and own_psnr >= psnr - LOSS and min(gains) >= -SCENE_LOSS:
            found.append(trial)
    return max(found, key=lambda one: (one.score or 0.0, -one.number), default=None)


def command(method: str, overrides: Mapping[str, OptionValue]) -> str:
    """Options as the command line takes them."""
    return " ".join(f"--set {method}.{name}={written(value)}" for name, value in sorted(overrides.items()))
