"""From a selection to the job graph: views → (partition →) fit → encode → measure; dvr and complexity on
their own.

Planning reads the data, so that bad input ends a run before its first job, and the records of finished
partitions. The groups of a joint method follow from its partition job, so the executor plans again after it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from econgs_bench.bench.jobs.complexity import Complexity
from econgs_bench.bench.jobs.dvr import Dvr
from econgs_bench.bench.jobs.encode import Encode
from econgs_bench.bench.jobs.fit import Fit
from econgs_bench.bench.jobs.measure import Measure
from econgs_bench.bench.jobs.method import MethodJob, TrainingJob
from econgs_bench.bench.jobs.partition import Partition, PartitionResult
from econgs_bench.bench.jobs.scene import SceneJob
from econgs_bench.bench.jobs.views import Views
from econgs_bench.bench.metrics import METRICS
from econgs_bench.bench.plan.selection import Selection, Subset, subset_of_scene, subsets, usual_sources
from econgs_bench.bench.store.records import Job
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.edits import edit_of, text_of
from econgs_bench.bench.suites.stress import part_of, stress_of
from econgs_bench.datasets.edits import changes_transfer
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.unseen import recipe
from econgs_bench.methods.interface import CLOUD_POINTS, MethodSpec
from econgs_bench.methods.options import DRAWN, ITERATIONS, SAMPLES, Settings, resolve
from econgs_bench.methods.registry import Registry
from econgs_bench.reports import schema

_S = TypeVar("_S", bound=SceneJob)
_T = TypeVar("_T", bound=TrainingJob)


class Planner:
    """Turns a selection into jobs; data are read and hashed once.

    Args:
        selection: what to run.
        metrics: name -> version; default: those of the tables.

    Attributes:
        registry: the methods.
        ladders: those of the suite.
        renders: whether any dataset is a volume, whose views are rendered.

    Raises:
        UnknownName: a dataset, scene, method, option or preset that is not there.
        DataError: data that cannot be used.
    """

    def __init__(self, selection: Selection, metrics: Mapping[str, str] | None = None) -> None:
        suite = selection.suite
        self._selection = selection
        if metrics is None:
            measured = (*schema.METRICS, *schema.COVERAGE)
            metrics = {name: METRICS[name].version for name in measured}
        self._metrics = dict(metrics)
        self.registry = Registry(selection.plugins)
        preset = selection.preset or suite.preset
        if preset not in suite.presets:
            raise unknown("preset", preset, suite.presets, of=f"suite {suite.name}")
        self._preset_name, self._preset = preset, suite.presets[preset]
        self._like = self._preset.like or preset
        self.ladders = suite.ladders
        self._seeds = selection.seeds or suite.seeds
        self._specs = self._methods()
        self._settings = list(self._variants())
        self._subsets = subsets(selection, self._preset)
        self._cases = list(self._rungs())
        every = [*self._subsets, *(case.subset for case in self._cases)]
        self.renders = any(subset.kind == "volume" for subset in every)

    def jobs(self, store: Store | None) -> list[Job]:
        """All jobs that can be planned so far, in an order in which they can run."""
        jobs = self._distinct(partial(_groups, store=store))
        if store is not None and self._selection.suite.repeats:
            for job in list(self._repeats(list(jobs.values()), store)):
                jobs.setdefault(job.id, job)
        return list(jobs.values())

    def total(self, jobs: list[Job], store: Store | None) -> tuple[int, bool]:
        """Number of all jobs, of which ``jobs`` can be planned so far, and whether it is a lower bound.

        More follow where a partition finds several groups, and where a rung that breaks is repeated.
        """
        waiting = [job for job in jobs if job.kind == "partition" and not _groups(job, store)]
        if waiting:
            with_one_group = self._distinct(lambda job: _groups(job, store) or [list(job.scenes)])
            jobs = list({job.id: job for job in [*jobs, *with_one_group.values()]}.values())
        return len(jobs), bool(waiting or self._selection.suite.repeats)

    def _distinct(self, groups: Callable[[Job], list[list[str]]]) -> dict[str, Job]:
        jobs: dict[str, Job] = {}
        for job in self._all(groups):
            jobs.setdefault(job.id, job)
        return jobs

    def vary(self, variants: Iterable[Mapping[str, Mapping[str, Any]]]) -> None:
        """Plan other variants of the suite from now on; data are not read again.

        Raises:
            UnknownName, DataError: an option that is not there, or a value that it cannot have.
        """
        suite = replace(self._selection.suite, variants=tuple(variants))
        self._selection = replace(self._selection, suite=suite)
        self._settings = list(self._variants())
        self._cases = list(self._rungs())

    # ------------------------------------------------------------------ choices

    def _methods(self) -> list[MethodSpec]:
        if self._selection.methods:
            names: list[str] = list(self._selection.methods)
        else:
            optional = [name for name in self._selection.suite.optional if name in self.registry.names()]
            names = [*self._selection.suite.methods, *optional]
        specs = [self.registry.spec(name) for name in names]
        for name in self._selection.overrides:
            if name not in names:
                raise unknown("method", name, names, of="this run (--set)")
        suite = self._selection.suite
        known = {*names, *suite.methods, *suite.optional, *self.registry.names()}
        for variant in suite.variants:
            for name in variant:
                if name not in known:
                    raise unknown("method", name, sorted(known), of=f"suite {suite.name} (variants)")
        return specs

    def _variants(self) -> Iterator[tuple[MethodSpec, Settings, list[float | None]]]:
        """Method, resolved options and rates, for each variant; equal ones once."""
        variants = set()
        for spec in self._specs:
            for variant in self._selection.suite.variants:
                own = variant.get(spec.name, {})
                overrides = {**own, **self._selection.overrides.get(spec.name, {})}
                curve = list(self._with_rates(spec, overrides))
                if SAMPLES in own and curve[0][0].samples != 1:
                    del curve[1:]  # a suite's second drawing, of models that the first one has
                choices = [*curve, *self._with_lengths(spec, overrides)]
                if spec.drawn_here and DRAWN not in overrides:  # who draws is told apart: two rows of a fit
                    choices.append((resolve(spec, self._like, {**overrides, DRAWN: "here"}), [None]))
                for settings, rates in choices:
                    if (spec.name, settings.variant) not in variants:
                        variants.add((spec.name, settings.variant))
                        yield spec, settings, rates

    def _with_lengths(
        self, spec: MethodSpec, overrides: Mapping[str, Any]
    ) -> Iterator[tuple[Settings, list[float | None]]]:
        """Shorter and longer schedules of a method that is trained, at its own size."""
        lengths = self._selection.suite.lengths
        if not lengths or ITERATIONS in overrides:
            return
        usual = resolve(spec, self._like, overrides).budget(1, self._preset.budget)
        for share in lengths:
            count = round(share * usual)
            if usual > 1 and count not in (0, usual):
                yield resolve(spec, self._like, {**overrides, ITERATIONS: count}), [None]

    def _with_rates(
        self, spec: MethodSpec, overrides: Mapping[str, Any]
    ) -> Iterator[tuple[Settings, list[float | None]]]:
        """The method's own size or, where the suite asks for its curve, every value of its rate knobs."""
        points = [
            (knob, value)
            for knob in (spec.rate_knobs if self._selection.suite.rates == "all" else ())
            for value in knob.values
        ]
        saved = [None, *(value for knob, value in points if not knob.refit)]
        yield resolve(spec, self._like, overrides), saved
        for knob, value in points:
            if knob.refit:
                yield resolve(spec, self._like, {**overrides, knob.name: value}), [None]

    # ------------------------------------------------------------------ ladders

    def _rungs(self) -> Iterator[_Case]:
        """The runs of all rungs, those of the first ones too; equal jobs are made once by :meth:`jobs`.

        A dataset that the suite does not name climbs every ladder whose rungs are no scenes.
        """
        alone: list[float | None] = [None]
        stressed = [(spec, settings, alone) for spec, settings, _ in self._settings if not settings.knob]
        named = usual_sources(self._selection, self._selection.suite.datasets)
        opened: dict[str, Subset | None] = {}
        for ladder in self._selection.suite.ladders:
            sources = usual_sources(self._selection, ladder.datasets)
            for rung in ladder.rungs:
                if rung.scene:
                    if rung.scene not in opened:
                        opened[rung.scene] = subset_of_scene(self._selection, self._preset, rung.scene)
                    chosen = [opened[rung.scene]]
                else:
                    chosen = [
                        one
                        for one in self._subsets
                        if not ladder.datasets or one.source in sources or one.source not in named
                    ]
                for subset in chosen:
                    # Truth that was rendered elsewhere is there as it is.
                    if subset is None or (subset.kind == "views" and part_of(rung.stress, "truth", "test")):
                        continue
                    plain = not (rung.stress or rung.options or rung.scene)
                    choices = [
                        (spec, self._with(spec, settings, rung.options), rates)
                        for spec, settings, rates in (self._settings if plain else stressed)
                        if ladder.is_for(spec.name)
                    ]
                    if choices:
                        yield _Case(subset, rung.stress, choices)

    def _with(
        self, spec: MethodSpec, settings: Settings, options: Mapping[str, Mapping[str, Any]]
    ) -> Settings:
        """Settings with the options of a rung."""
        more = options.get(spec.name)
        return resolve(spec, self._like, {**settings.overrides, **more}) if more else settings

    def _repeats(self, jobs: list[Job], store: Store) -> Iterator[Job]:
        """Rungs on which a method breaks, and the first rungs beside them, with further seeds."""
        from econgs_bench.bench.results.tables import rungs_table
        from econgs_bench.reports.sections.ladders.table import ladders

        records = [store.record(job.id) for job in jobs if job.kind == "measure"]
        done = [record for record in records if record is not None]
        by_id = {record.job.id: record.job for record in done}
        table = ladders(rungs_table(done, self._selection.suite.ladders))
        broken = table[table["failure"].notna() & (table["failure"] != "refusal")]
        again = [by_id[name] for column in ("job", "first_job") for name in broken[column].dropna()]
        for case in self._cases:
            choices = [
                (spec, settings, rates)
                for spec, settings, rates in case.choices
                if any(case.has(job, spec, settings) for job in again)
            ]
            if choices:
                yield from self._of_case(
                    replace(case, choices=choices),
                    self._selection.suite.repeats,
                    partial(_groups, store=store),
                )

    # ------------------------------------------------------------------ graph

    def _all(self, groups: Callable[[Job], list[list[str]]]) -> Iterator[Job]:
        suite = self._selection.suite
        climbing = {name for ladder in suite.ladders for name in ladder.datasets}
        climbed = usual_sources(self._selection, climbing)  # their usual runs are first rungs
        for subset in self._subsets:
            if suite.dvr and subset.kind == "volume":
                for name in (*subset.hashes, *subset.compositions):
                    yield self._of_scene(Dvr, subset, name)
            if suite.parsimony and subset.kind == "volume":
                for name in subset.hashes:
                    yield self._of_scene(Complexity, subset, name)
            if self._settings and subset.source not in climbed:
                yield from self._of_case(_Case(subset, "", self._settings), self._seeds, groups)
        for case in self._cases:
            yield from self._of_case(case, self._seeds, groups)

    def _of_case(
        self, case: _Case, seeds: Iterable[int], groups: Callable[[Job], list[list[str]]]
    ) -> Iterator[Job]:
        """Views, fits and measurements of a subset under some stress; under any, of basic scenes alone.

        Args:
            case: the runs.
            seeds: of the fits.
            groups: partition -> its groups of scenes; none as long as they are not known.
        """
        subset = case.subset
        if case.stress:
            subset = replace(subset, compositions={})
        before, shown = (part_of(case.stress, *parts) for parts in (("truth",), ("truth", "test")))
        views = {
            name: self._of_scene(Views, subset, name, stress=before)
            for name in (*subset.hashes, *subset.compositions)
        }
        edited = {} if case.stress else self._edited_views(subset)
        yield from (*views.values(), *edited.values())
        tested = views
        if shown != before:
            tested = {name: self._of_scene(Views, subset, name, stress=shown) for name in subset.hashes}
            yield from tested.values()
        for spec, settings, rates in case.choices:
            for seed in seeds:
                training = partial(self._training, case, spec, settings.fitted, seed, views)
                fitted, partition = [[scene] for scene in subset.hashes], None
                needs: tuple[str, ...] = ()
                if spec.joint:
                    partition = training(Partition, list(subset.hashes))
                    yield partition
                    fitted, needs = groups(partition), (partition.id,)
                # A group's share of partition time is that of this very partition.
                after = {"partition": partition.key if partition else None}
                fits = [training(Fit, group, needs, **after) for group in fitted]
                yield from self._of_fits(
                    spec, settings, fits, replace(case, subset=subset), tested, edited, rates
                )

    def _of_fits(
        self,
        spec: MethodSpec,
        settings: Settings,
        fits: list[Fit],
        case: _Case,
        views: dict[str, Views],
        edited: dict[tuple[str, str], Views],
        rates: list[float | None],
    ) -> Iterator[Job]:
        """The fits of all scenes, their models at all rates, and the measurements."""

        def measure(models: list[Encode], scenes: tuple[str, ...], truth: Views, **fields: Any) -> Job:
            suite = self._selection.suite
            measured = Measure.of(
                models, truth, scenes,
                metrics=self._metrics, sampled=suite.sampled, parsimony=suite.parsimony, **fields,
            )  # fmt: skip
            return measured.drawn(settings)

        encodes: dict[tuple[str, float | None], Encode] = {}
        for fit in fits:
            yield fit
            for rate in rates:
                encode = Encode.of(fit, rate)
                yield encode
                for scene in fit.scenes:
                    encodes[scene, rate] = encode
                    yield measure([encode], (scene,), views[scene], stress=case.stress)
        for (name, edit), truth in edited.items() if fits else ():
            parts = case.subset.compositions.get(name)
            if parts is not None:
                yield measure(_of(encodes, parts, None), parts, truth, composition=name, edit=edit)
                continue
            mixed = _recipe(case.subset, name, edit, spec)
            models = _of(encodes, mixed or (name,), None)
            yield measure(models, (name,), truth, edit=edit, recipe=mixed)
        for name, parts in case.subset.compositions.items() if fits else ():
            for rate in rates:
                yield measure(_of(encodes, parts, rate), parts, views[name], composition=name)

    def _edited_views(self, subset: Subset) -> dict[tuple[str, str], Views]:
        """Scene or composition, and edit -> the views of the edited one, where scenes can be rendered."""
        if subset.kind != "volume":
            return {}
        suite = self._selection.suite
        wanted = [(scene, edit) for scene in subset.hashes for edit in suite.edits]
        wanted += [(name, chain) for name in subset.compositions for chain in suite.chains]
        return {(name, edit): self._of_scene(Views, subset, name, edit) for name, edit in wanted}

    def _of_scene(self, kind: type[_S], subset: Subset, name: str, edit: str = "", stress: str = "") -> _S:
        """A job about a scene or composition without a method."""
        return kind.of(
            self._about(subset),
            subset.content(name),
            subset.compositions.get(name, (name,)),
            name if name in subset.compositions else "",
            edit,
            stress,
        )

    def _training(
        self,
        case: _Case,
        spec: MethodSpec,
        settings: Settings,
        seed: int,
        views: dict[str, Views],
        kind: type[_T],
        scenes: list[str],
        needs: tuple[str, ...] = (),
        **more: Any,
    ) -> _T:
        """A partition of scenes, or the fit of a group; stress that decides it is part of it."""
        subset, stress = case.subset, part_of(case.stress, "truth", "input", "fit")
        share = float(stress_of(stress).get("budget", 1.0))
        if ITERATIONS not in settings.overrides:
            share *= self._preset.budget
        return kind.of(
            self._about(subset),
            {name: subset.hashes[name] for name in scenes},
            spec,
            settings,
            iterations=settings.budget(len(scenes), share),
            seed=seed,
            device=self._selection.device,
            stress=stress,
            points=max(self._preset.cloud_points, int(settings.values.get(CLOUD_POINTS, 0))),
            needs=(*(views[scene].id for scene in scenes), *needs),
            **more,
        )

    def _about(self, subset: Subset) -> dict[str, Any]:
        """Fields that all jobs of a subset have in common."""
        return {
            "dataset": subset.source,
            "dataset_name": subset.name,
            "request": subset.request,
            "split": self._selection.split,
            "preset": self._preset_name,
        }


@dataclass(frozen=True)
class _Case:
    """Runs of a subset of scenes under one stress.

    Attributes:
        choices: methods with their settings and rates.
    """

    subset: Subset
    stress: str
    choices: list[tuple[MethodSpec, Settings, list[float | None]]]

    def has(self, job: Job, spec: MethodSpec, settings: Settings) -> bool:
        """Whether a measurement is of one of its runs, with these settings."""
        return (
            isinstance(job, MethodJob)
            and job.dataset == self.subset.source
            and job.request == self.subset.request
            and job.scenes[0] in self.subset.hashes
            and (job.stress, job.method, job.variant) == (self.stress, spec.name, settings.variant)
        )


def _groups(partition: Job, store: Store | None) -> list[list[str]]:
    """Groups of a partition; none as long as it has not run."""
    record = store.record(partition.id) if store else None
    if record is not None and not record.ok:
        return [list(partition.scenes)]  # its failure is the failure of every scene
    result = record.of(PartitionResult) if record is not None else None
    return result.groups if result is not None else []


def _recipe(subset: Subset, name: str, text: str, spec: MethodSpec) -> dict[str, str]:
    """The trained scenes that stand for an edited scene, and their edits; {}: the method makes the edit."""
    edit = edit_of(name, text)[name]
    if "transfer" in spec.edits or not changes_transfer(edit) or "opacity" not in spec.edits:
        return {}
    scene = next(one for one in subset.scenes if one.name == name)
    trained = [one for one in subset.scenes if one.variable == scene.variable]
    if not spec.composable:
        trained = [scene]
    found = recipe(scene, edit, trained, palette="palette" in spec.edits)
    return {one: text_of(change) for one, change in found.items()}


def _of(
    encodes: Mapping[tuple[str, float | None], Encode], scenes: Iterable[str], rate: float | None
) -> list[Encode]:
    """The models at a rate that hold some scenes, each once."""
    return list({encodes[scene, rate].id: encodes[scene, rate] for scene in scenes}.values())
