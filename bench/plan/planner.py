"""From a selection to the job graph: views → (partition →) fit → encode → measure; dvr and complexity on
their own.

Planning reads the data, so that bad input ends a run before its first job, and the records of finished
partitions. The groups of a joint method follow from its partition job, so the executor plans again after it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

from econgs_bench.bench.machine.timing import RULERS
from econgs_bench.bench.metrics import METRICS
from econgs_bench.bench.plan.selection import Selection, Subset, subset_of_scene, subsets, usual_sources
from econgs_bench.bench.store.records import SAMPLED, Job
from econgs_bench.bench.store.store import Store
from econgs_bench.bench.suites.edits import edit_of, text_of
from econgs_bench.bench.suites.stress import part_of, stress_of
from econgs_bench.datasets.content import hash_of
from econgs_bench.datasets.edits import changes_transfer
from econgs_bench.datasets.names import unknown
from econgs_bench.datasets.unseen import recipe
from econgs_bench.methods.interface import CLOUD_POINTS, MethodSpec
from econgs_bench.methods.options import ITERATIONS, SAMPLES, Settings, resolve
from econgs_bench.methods.registry import Registry
from econgs_bench.reports import schema


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
        climbing = {name for ladder in self._selection.suite.ladders for name in ladder.datasets}
        climbed = usual_sources(self._selection, climbing)  # their usual runs are first rungs
        for subset in self._subsets:
            if self._selection.suite.dvr and subset.kind == "volume":
                for name in (*subset.hashes, *subset.compositions):
                    yield self._of_scene("dvr", subset, name)
            if self._selection.suite.parsimony and subset.kind == "volume":
                for name in subset.hashes:
                    yield self._of_scene("complexity", subset, name)
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
            name: self._of_scene("views", subset, name, stress=before)
            for name in (*subset.hashes, *subset.compositions)
        }
        edited = {} if case.stress else self._edited_views(subset)
        yield from (*views.values(), *edited.values())
        tested = views
        if shown != before:
            tested = {name: self._of_scene("views", subset, name, stress=shown) for name in subset.hashes}
            yield from tested.values()
        for spec, settings, rates in case.choices:
            for seed in seeds:
                training = partial(self._training, case, spec, settings.fitted, seed, views)
                fitted, partition = [[scene] for scene in subset.hashes], None
                if spec.joint:
                    partition = training("partition", list(subset.hashes))
                    yield partition
                    fitted = groups(partition)
                # A group's share of partition time is that of this very partition.
                after = {"partition": partition.key if partition else None}
                needs = (partition.id,) if partition else ()
                fits = [training("fit", group, needs, after) for group in fitted]
                jobs = self._of_fits(spec, fits, replace(case, subset=subset), tested, edited, rates)
                yield from (_drawn(job, settings) for job in jobs)

    def _of_fits(
        self,
        spec: MethodSpec,
        fits: list[Job],
        case: _Case,
        views: dict[str, Job],
        edited: dict[tuple[str, str], Job],
        rates: list[float | None],
    ) -> Iterator[Job]:
        """The fits of all scenes, their models at all rates, and the measurements."""
        encodes: dict[tuple[str, float | None], Job] = {}
        for fit in fits:
            yield fit
            for rate in rates:
                identity = {"kind": "encode", "fit": fit.key, "rate": rate}
                encode = _after(fit, identity, needs=(fit.id,), rate=rate)
                yield encode
                for scene in fit.scenes:
                    encodes[scene, rate] = encode
                    yield self._measure([encode], (scene,), views[scene], stress=case.stress)
        for (name, edit), truth in edited.items() if fits else ():
            parts = case.subset.compositions.get(name)
            if parts is not None:
                yield self._measure(_of(encodes, parts, None), parts, truth, name, edit)
                continue
            mixed = _recipe(case.subset, name, edit, spec)
            models = _of(encodes, mixed or (name,), None)
            yield self._measure(models, (name,), truth, edit=edit, recipe=mixed)
        for name, parts in case.subset.compositions.items() if fits else ():
            for rate in rates:
                yield self._measure(_of(encodes, parts, rate), parts, views[name], name)

    def _measure(
        self,
        encodes: list[Job],
        scenes: tuple[str, ...],
        views: Job,
        composition: str = "",
        edit: str = "",
        stress: str = "",
        recipe: Mapping[str, str] = MappingProxyType({}),
    ) -> Job:
        """The measurement of a basic scene, edited or not, or of the scenes of a composition together."""
        identity: dict[str, Any] = {
            "kind": "measure",
            "views": views.key,
            "split": self._selection.split,
            "metrics": self._metrics,
            "rulers": RULERS,
        }
        if composition:
            identity |= {"encodes": [encode.key for encode in encodes], "scenes": list(scenes)}
        else:
            identity |= {"encode": encodes[0].key, "scene": scenes[0]}
        if edit:
            identity["edit"] = edit
        if recipe:
            identity |= {"encodes": [encode.key for encode in encodes], "recipe": dict(recipe)}
        if (sampled := self._selection.suite.sampled) != SAMPLED:
            identity["sampled"] = sampled
        usual = encodes[0].rate is None and not (encodes[0].knob or composition or edit or stress)
        prunable = self._selection.suite.parsimony and usual
        if prunable:
            identity["prunable"] = True
        return _after(
            encodes[0],
            identity,
            needs=(views.id, *(encode.id for encode in encodes)),
            scenes=scenes,
            composition=composition,
            edit=edit,
            recipe=dict(recipe),
            stress=stress,
            group=",".join(encode.group for encode in encodes),
            metrics=dict(self._metrics),
            sampled=sampled,
            prunable=prunable,
        )

    def _edited_views(self, subset: Subset) -> dict[tuple[str, str], Job]:
        """Scene or composition, and edit -> the views of the edited one, where scenes can be rendered."""
        if subset.kind != "volume":
            return {}
        suite = self._selection.suite
        wanted = [(scene, edit) for scene in subset.hashes for edit in suite.edits]
        wanted += [(name, chain) for name in subset.compositions for chain in suite.chains]
        return {(name, edit): self._of_scene("views", subset, name, edit) for name, edit in wanted}

    def _of_scene(self, kind: str, subset: Subset, name: str, edit: str = "", stress: str = "") -> Job:
        """A job about a scene or composition without a method: its views, cost of rendering or complexity."""
        identity: dict[str, Any] = {"kind": kind, "scene": subset.content(name)}
        if kind != "complexity":
            identity["request"] = subset.request.identity
        if edit:
            identity["edit"] = edit
        if stress:
            identity["stress"] = stress
        if kind == "views":
            identity["split"] = self._selection.split
        if kind == "dvr":
            identity["rulers"] = {"frame": RULERS["frame"]}
        return self._job(
            subset,
            identity,
            scenes=subset.compositions.get(name, (name,)),
            composition=name if name in subset.compositions else "",
            edit=edit,
            stress=stress,
        )

    def _training(
        self,
        case: _Case,
        spec: MethodSpec,
        settings: Settings,
        seed: int,
        views: dict[str, Job],
        kind: str,
        scenes: list[str],
        needs: tuple[str, ...] = (),
        more: Mapping[str, Any] = MappingProxyType({}),
    ) -> Job:
        """A partition of scenes, or the fit of a group.

        Its identity: content of the scenes, method, options, budget, seed, class of device, training views,
        and the stress that decides it.
        """
        subset, stress = case.subset, part_of(case.stress, "truth", "input", "fit")
        request, device = subset.request, self._selection.device
        share = float(stress_of(stress).get("budget", 1.0))
        if ITERATIONS not in settings.overrides:
            share *= self._preset.budget
        iterations = settings.budget(len(scenes), share)
        points = max(self._preset.cloud_points, int(settings.values.get(CLOUD_POINTS, 0)))
        identity = {
            "kind": kind,
            "dataset": subset.name,
            "scenes": [[name, subset.hashes[name]] for name in scenes],
            "method": [spec.name, spec.version],
            "options": settings.values,
            "iterations": iterations,
            "seed": seed,
            "device": device.split(":")[0],
            "views": [request.train_views, request.width, request.height],
            "trains_on": "train" if self._selection.split == "val" else "trainval",
            "cloud_points": points,
            **more,
        }
        if request.samples != 1:
            identity["samples"] = request.samples
        if stress:
            identity["stress"] = stress
        return self._job(
            subset,
            identity,
            needs=(*(views[scene].id for scene in scenes), *needs),
            scenes=tuple(scenes),
            group="+".join(scenes) if kind == "fit" else "",
            method=spec.name,
            variant=settings.variant,
            seed=seed,
            options=settings.values,
            overrides=settings.overrides,
            knob=settings.knob,
            iterations=iterations,
            stress=stress,
            device=device,
            cloud_points=points,
        )

    def _job(self, subset: Subset, identity: dict[str, Any], **fields: Any) -> Job:
        return Job(
            kind=identity["kind"],
            key=hash_of(identity),
            identity=identity,
            dataset=subset.source,
            dataset_name=subset.name,
            request=subset.request,
            split=self._selection.split,  # type: ignore[arg-type]
            preset=self._preset_name,
            **fields,
        )


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
            job.dataset == self.subset.source
            and job.request == self.subset.request
            and job.scenes[0] in self.subset.hashes
            and (job.stress, job.method, job.variant) == (self.stress, spec.name, settings.variant)
        )


def _groups(partition: Job, store: Store | None) -> list[list[str]]:
    """Groups of a partition; none as long as it has not run."""
    record = store.record(partition.id) if store else None
    if record is not None and not record.ok:
        return [list(partition.scenes)]  # its failure is the failure of every scene
    return record.partition.groups if record is not None and record.partition is not None else []


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
    encodes: Mapping[tuple[str, float | None], Job], scenes: Iterable[str], rate: float | None
) -> list[Job]:
    """The models at a rate that hold some scenes, each once."""
    return list({encodes[scene, rate].id: encodes[scene, rate] for scene in scenes}.values())


def _drawn(job: Job, settings: Settings) -> Job:
    """A measurement by the settings that decide drawing alone; other jobs as they are."""
    if job.kind != "measure" or settings.samples == 1:
        return job
    identity = {**job.identity, SAMPLES: settings.samples}
    return _after(job, identity, variant=settings.variant, overrides=settings.overrides)


def _after(job: Job, identity: dict[str, Any], **changes: Any) -> Job:
    """A job that follows another one of the same method and group."""
    kind = {"kind": identity["kind"], "key": hash_of(identity), "identity": identity}
    return job.model_copy(update=kind | changes)
