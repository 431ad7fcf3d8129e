"""Tuning: a search for the options with which a method does best on validation views.

A study is a sequence of trials. A trial is a variant of a suite's plan, and its jobs are ordinary jobs of the
run store. The options of a trial follow from the trials before it, the seed and its number alone, so a
study that was interrupted goes on as if nothing had happened.

    RUNS/studies/METHOD-KEY.json    the study: conditions, search space, trials, chosen options
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, ValidationError

from econgs_bench.bench.plan.planner import Planner
from econgs_bench.bench.results.tables import stored_tables
from econgs_bench.bench.store.progress import now
from econgs_bench.bench.store.records import Job, Record, Value, derived_seed
from econgs_bench.bench.store.store import Store, write_text
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.datasets.names import unknown
from econgs_bench.methods.interface import MethodSpec, Option, OptionValue
from econgs_bench.methods.options import CONFIGURATION, ITERATIONS, declared, resolve, written
from econgs_bench.reports.schema import joined

if TYPE_CHECKING:
    import pandas as pd

    from econgs_bench.bench.plan.selection import Selection

FOLDER = "studies"
"""Folder of a run store with its studies."""
SCHEMA = 1
REFERENCE = (20.0, 64.0)
"""PSNR (dB) and size of a scene (MiB) at which the area of a front ends, unless others are named."""
REACH = 4.0
"""A number is searched from its smallest starting value / this to its largest starting value x this."""
_DIGITS = 3
"""Significant digits of values that are tried, so that a copied command line gives the same jobs."""
FIRST = 4
"""Trials, starting points among them, after which proposals follow from a model of the scores."""
ENOUGH = 20
"""Trials that must have succeeded before options are said to be important: five are in the best quarter."""
PUBLISHED = "paper"
"""Configuration of a method that the first trial has."""
LOSS = 0.1
"""dB by which a trial that is as good as the defaults may lie below them, mean over scenes and seeds."""
SCENE_LOSS = 0.3
"""dB by which it may on any scene; repeated fits differ by as much."""


# --------------------------------------------------------------------------- objective


@dataclass(frozen=True)
class Objective:
    """The score of a trial; the larger, the better.

    Attributes:
        kind: "front": area under the front of PSNR over the logarithm of size, dB x octaves; "point": that of
            the method's own size alone; "size": greatest PSNR of a model of at most that size, dB; "psnr":
            greatest PSNR, dB.
        text: as on the command line: "front=20,64", "point=20,64", "size=0.5" or "psnr".
        psnr: reference of a front or point, dB.
        mib: reference of a front or point, or size, MiB.
    """

    kind: Literal["front", "point", "size", "psnr"]
    text: str
    psnr: float = 0.0
    mib: float = math.inf

    @property
    def unit(self) -> str:
        return "dB x octaves" if self.has_reference else "dB"

    @property
    def has_reference(self) -> bool:
        """Whether models beyond a reference point score 0."""
        return self.kind in ("front", "point")

    @property
    def every_rate(self) -> bool:
        """Whether a trial has a model per rate, and not only one of the method's own size."""
        return self.kind in ("front", "size")

    @property
    def title(self) -> str:
        """The definition, for people."""
        if self.kind == "front":
            return f"area under PSNR over log2 of size, above {self.psnr:g} dB and below {self.mib:g} MiB"
        if self.kind == "point":
            return f"(PSNR - {self.psnr:g} dB) x log2({self.mib:g} MiB / size)"
        if self.kind == "size":
            return f"PSNR of a model of at most {self.mib:g} MiB"
        return "PSNR"

    def score(self, points: ArrayLike) -> float:
        """Score of the models of one scene.

        Where no model is as small as a size asks for, it is minus the octaves by which the smallest exceeds
        that size: less than any PSNR, and more for smaller models.

        Args:
            points: (n, 2) size in MiB and PSNR in dB, n >= 1.
        """
        table = np.asarray(points, dtype=np.float64)
        if self.has_reference:
            return hypervolume(table, (self.psnr, self.mib))
        fitting = table[table[:, 0] <= self.mib]
        if len(fitting):
            return float(fitting[:, 1].max())
        return -float(np.log2(table[:, 0].min() / self.mib))


def objective_of(text: str) -> Objective:
    """An objective by its text: "front", "front=DB,MIB", "point", "point=DB,MIB", "size=MIB" or "psnr".

    Raises:
        DataError: another text, or numbers out of range.
    """
    kind, _, rest = text.partition("=")
    try:
        numbers = [float(part) for part in rest.split(",")] if rest else []
    except ValueError:
        numbers = [math.nan]
    usable = all(map(math.isfinite, numbers)) and all(number > 0.0 for number in numbers[-1:])
    if usable and kind in ("front", "point") and len(numbers) in (0, 2):
        psnr, mib = numbers or REFERENCE
        return Objective(kind, f"{kind}={psnr:g},{mib:g}", psnr, mib)  # type: ignore[arg-type]
    if usable and kind == "size" and len(numbers) == 1:
        return Objective("size", f"size={numbers[0]:g}", mib=numbers[0])
    if text == "psnr":
        return Objective("psnr", text)
    raise DataError(
        f"--objective {text}",
        "no objective",
        "Write front, front=DB,MIB (its reference point), point=DB,MIB, size=MIB or psnr",
    )


def hypervolume(points: ArrayLike, reference: tuple[float, float]) -> float:
    """Area between the front of models and a reference point, dB x octaves.

    Args:
        points: (n, 2) size in MiB and PSNR in dB; those beyond the reference add nothing.
        reference: PSNR in dB and size in MiB.
    """
    table = np.asarray(points, dtype=np.float64)
    octaves = np.log2(reference[1] / table[:, 0]).clip(0.0)
    gains = (table[:, 1] - reference[0]).clip(0.0)
    order = np.argsort(-octaves)
    widths = -np.diff(octaves[order], append=0.0)
    return float(widths @ np.maximum.accumulate(gains[order]))


def front(points: ArrayLike) -> list[int]:
    """Positions of the points that no other point beats in size and PSNR, by size.

    Args:
        points: (n, 2) size and PSNR.
    """
    from econgs_bench.reports.fronts import pareto

    places: dict[tuple[float, float], int] = {}
    for place, (size, psnr) in enumerate(np.asarray(points, dtype=np.float64).tolist()):
        places.setdefault((size, psnr), place)
    return [places[point] for point in pareto(places, -1)]


# --------------------------------------------------------------------------- search space


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Range(_Model):
    """Values of an option that a study tries.

    Attributes:
        low, high: bounds of a number, inclusive.
        log: whether numbers are drawn on a logarithmic scale.
        whole: whether numbers are whole.
        choices: the only values, if not empty.
    """

    low: float = 0.0
    high: float = 0.0
    log: bool = False
    whole: bool = False
    choices: tuple[Value, ...] = ()

    @property
    def text(self) -> str:
        """The range, for people."""
        if self.choices:
            return ", ".join(map(written, self.choices))
        return f"{self.low:g} to {self.high:g}{' (log)' if self.log else ''}"

    def distribution(self) -> Any:
        """The range as Optuna knows it."""
        from optuna import distributions

        if self.choices:
            return distributions.CategoricalDistribution(self.choices)
        if self.whole:
            return distributions.IntDistribution(int(self.low), int(self.high), log=self.log)
        return distributions.FloatDistribution(self.low, self.high, log=self.log)

    def tidy(self, value: OptionValue) -> OptionValue:
        """A value of the range with few digits."""
        if self.choices or isinstance(value, str):
            return value
        return int(value) if self.whole else min(max(_rounded(value), self.low), self.high)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def range_of(option: Option, values: Sequence[OptionValue]) -> Range | None:
    """What a study tries of an option that starts at some values; None if that cannot be told.

    Choices are all tried. A number has the range that its declaration names (:attr:`Option.search`). Without
    one it has that of :data:`REACH` around its starting values, within its declared range, and a logarithmic
    scale where that spans more than a factor of :data:`REACH`. The declared range alone counts where no
    starting value is above 0.
    """
    if option.choices or isinstance(option.default, bool):
        return Range(choices=option.choices or (False, True))
    if isinstance(option.default, str):
        return None
    whole = isinstance(option.default, int)
    if option.search is not None:
        low, high = option.search
        return Range(low=low, high=high, log=0.0 < REACH * low < high, whole=whole)
    numbers = [float(value) for value in values]
    low, high = _rounded(min(numbers) / REACH), _rounded(max(numbers) * REACH)
    if min(numbers) < 0.0 or high == 0.0:
        if option.minimum is None or option.maximum is None:
            return None
        low, high = option.minimum, option.maximum
    low = max(low, option.minimum if option.minimum is not None else low)
    high = min(high, option.maximum if option.maximum is not None else high)
    if whole:
        low, high = math.ceil(low), math.floor(high)
    return Range(low=low, high=high, log=0.0 < REACH * low < high, whole=whole)


def starts(spec: MethodSpec, fixed: Mapping[str, OptionValue]) -> list[dict[str, OptionValue]]:
    """Overrides of the first trials: the published settings, where a method has them, and its own defaults.

    Args:
        spec: the method.
        fixed: options that every trial has.
    """
    if PUBLISHED not in spec.configurations or CONFIGURATION in fixed:
        return [dict(fixed)]
    return [{CONFIGURATION: PUBLISHED, **fixed}, dict(fixed)]


def search_space(
    spec: MethodSpec,
    preset: str,
    fixed: Mapping[str, OptionValue],
    names: Sequence[str] = (),
    swept: Sequence[str] = (),
) -> dict[str, Range]:
    """The options that a study varies, each with its range.

    Args:
        spec: the method.
        preset: whose defaults the ranges are around.
        fixed: options that every trial has; they are not varied.
        names: the options; default: :attr:`MethodSpec.tunable`, else all that declare choices or both bounds,
            and rate knobs that need a fit each.
        swept: rate knobs of which every trial has all values; they are not varied.

    Raises:
        UnknownName: the method has no such option.
        DataError: a named option cannot be varied, or the method has none that can.
    """
    declarations = declared(spec.options)
    values = [resolve(spec, preset, start).values for start in starts(spec, fixed)]
    ranges = {
        name: range_of(option, [each[name] for each in values]) for name, option in declarations.items()
    }
    for name in names:
        if name not in declarations:
            raise unknown("option", name, declarations, of=f"method {spec.name}")
        what = f"--option {name}"
        if name in fixed:
            raise DataError(what, "has one value in all trials (--set)", "Leave out one of the two")
        if name in swept:
            raise DataError(what, "every trial has all values of this rate knob", "Use --objective point")
        if ranges[name] is None:
            reason = "a text" if isinstance(declarations[name].default, str) else "0 without a maximum"
            remedy = f"Others: {', '.join(one for one in ranges if ranges[one] and one not in fixed)}"
            raise DataError(what, f"has no range: it is {reason}", remedy)
    bounded = [
        name
        for name, option in declarations.items()
        if option.choices
        or isinstance(option.default, bool)
        or (option.minimum is not None and option.maximum is not None)
    ]
    knobs = [knob.name for knob in spec.rate_knobs if knob.refit]
    chosen = {*(names or (*(spec.tunable or bounded), *knobs))} - {*fixed, *swept}
    space = {name: one for name, one in ranges.items() if name in chosen and one is not None}
    if not space:
        reason = "has no options to tune" + (" beside those of --set" if fixed else "")
        remedy = "Declare options with a minimum and a maximum, or choices, in its spec"
        raise DataError(f"method {spec.name!r}", reason, remedy)
    return space


# --------------------------------------------------------------------------- study


class Point(_Model):
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


class Trial(_Model):
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


class Conditions(_Model):
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


class Chosen(_Model):
    """The best trial.

    Attributes:
        gains: "paper" or "fair" -> its score minus that of the starting point; none where that failed.
    """

    trial: int
    score: float
    overrides: dict[str, Value]
    gains: dict[str, float]


class Study(_Model):
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
