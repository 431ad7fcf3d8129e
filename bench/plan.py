"""From a selection to the job graph: views → (partition →) fit → encode → measure.

Planning reads the data (so bad input is found before any job starts) and the records of finished
partitions: which groups a joint method fits is known only once its partition job has run, so the
executor plans again after it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bench import inputs
from bench.records import Job, Request, hash_of
from bench.store import Store
from bench.suites import Suite
from datasets.names import unknown
from datasets.scene import Dataset
from methods.interface import MethodSpec
from methods.options import Settings, resolve
from methods.registry import Registry


@dataclass(frozen=True)
class Selection:
    """What is asked for: a suite, narrowed or widened by command-line options.

    Attributes:
        overrides: method -> option -> value, from ``--set``; on top of the suite's variants.
    """

    suite: Suite
    datasets: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    preset: str = ""
    split: str = "test"
    overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    device: str = "cpu"
    plugins: tuple[str, ...] = ()


class Planner:
    """Turns a selection into jobs; data are read and hashed once.

    Raises:
        UnknownName: a dataset, scene, method, option or preset that is not there.
        DataError: data that cannot be used.
    """

    def __init__(self, selection: Selection, metrics: Mapping[str, str]) -> None:
        suite = selection.suite
        self._selection = selection
        self._metrics = dict(metrics)
        self.registry = Registry(selection.plugins)
        preset = selection.preset or suite.preset
        if preset not in suite.presets:
            raise unknown("preset", preset, suite.presets, of=f"suite {suite.name}")
        self._preset_name, self._preset = preset, suite.presets[preset]
        self._seeds = selection.seeds or suite.seeds
        self._specs = self._chosen_methods()
        self._settings = list(self._chosen_settings())
        self._scenes = list(self._chosen_scenes())

    def jobs(self, store: Store | None) -> list[Job]:
        """All jobs known so far, in an order in which they can run."""
        jobs: dict[str, Job] = {}
        for job in self._all(store):
            jobs.setdefault(job.id, job)
        return list(jobs.values())

    # ------------------------------------------------------------------ choices

    def _chosen_methods(self) -> list[MethodSpec]:
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

    def _chosen_settings(self) -> Iterator[tuple[MethodSpec, Settings, list[float | None]]]:
        """Method, resolved options and rates, for each variant; equal ones once."""
        seen = set()
        for spec in self._specs:
            for variant in self._selection.suite.variants:
                overrides = {**variant.get(spec.name, {}), **self._selection.overrides.get(spec.name, {})}
                for settings, rates in self._with_rates(spec, overrides):
                    if (spec.name, settings.variant) not in seen:
                        seen.add((spec.name, settings.variant))
                        yield spec, settings, rates

    def _with_rates(
        self, spec: MethodSpec, overrides: Mapping[str, Any]
    ) -> Iterator[tuple[Settings, list[float | None]]]:
        """The method's own size or, where the suite asks for its curve, every value of its rate knobs."""
        settings = resolve(spec, self._preset_name, overrides)
        saved: list[float | None] = [None]
        if self._selection.suite.rates == "all":
            saved += [value for knob in spec.rate_knobs if not knob.refit for value in knob.values]
        yield settings, saved
        if self._selection.suite.rates == "all":
            for knob in spec.rate_knobs:
                for value in knob.values if knob.refit else ():
                    yield resolve(spec, self._preset_name, {**overrides, knob.name: value}), [None]

    def _chosen_scenes(self) -> Iterator[tuple[str, Dataset, dict[str, str], Request]]:
        """Dataset as named, opened, its scenes with their content hashes, and the views wanted of it."""
        chosen = self._selection.datasets or tuple(self._selection.suite.datasets)
        narrowed = set(self._selection.scenes)
        found: set[str] = set()
        all_names: set[str] = set()
        for name in chosen:
            source = inputs.absolute(name)
            dataset = inputs.open_dataset(source)
            names = [scene.name for scene in dataset.scenes]
            all_names.update(names)
            if not self._selection.datasets:
                names = [dataset.scene(s).name for s in self._selection.suite.datasets[name]] or names
            if narrowed:
                names = [s for s in [sc.name for sc in dataset.scenes] if s in narrowed]
                found.update(names)
            if names:
                hashes = {scene: inputs.fingerprint(dataset, scene) for scene in names}
                yield source, dataset, hashes, inputs.request(dataset, names[0], self._preset)
        for missing in sorted(narrowed - found):
            raise unknown("scene", missing, all_names, of=", ".join(chosen))

    # ------------------------------------------------------------------ graph

    def _all(self, store: Store | None) -> Iterator[Job]:
        for source, dataset, hashes, request in self._scenes:
            views = {scene: self._views(source, dataset, scene, hashes[scene], request) for scene in hashes}
            yield from views.values()
            for spec, settings, rates in self._settings:
                for seed in self._seeds:
                    common = self._common(source, dataset, request, spec, settings, seed)
                    yield from self._of_method(store, spec, common, hashes, views, rates)

    def _of_method(
        self,
        store: Store | None,
        spec: MethodSpec,
        common: dict[str, Any],
        hashes: dict[str, str],
        views: dict[str, Job],
        rates: list[float | None],
    ) -> Iterator[Job]:
        partition = None
        groups = [[scene] for scene in hashes]
        if spec.joint:
            partition = self._partition(spec, common, hashes, views)
            yield partition
            record = store.record(partition.id) if store else None
            if record is not None and not record.ok:
                groups = [list(hashes)]  # its failure is the failure of every scene
            elif record is None or record.partition is None:
                return
            else:
                groups = record.partition.groups
        for group in groups:
            fit = self._fit(spec, common, group, hashes, views, partition)
            yield fit
            for rate in rates:
                encode = _job("encode", fit, {"fit": fit.key, "rate": rate}, (fit.id,), rate=rate)
                yield encode
                for scene in group:
                    identity = {
                        "encode": encode.key,
                        "scene": scene,
                        "views": views[scene].key,
                        "split": self._selection.split,
                        "metrics": self._metrics,
                    }
                    needs = (views[scene].id, encode.id)
                    yield _job(
                        "measure", encode, identity, needs, scenes=(scene,), metrics=dict(self._metrics)
                    )

    def _views(self, source: str, dataset: Dataset, scene: str, content: str, request: Request) -> Job:
        split = self._selection.split
        identity = {"kind": "views", "scene": content, "request": request.model_dump(), "split": split}
        return Job.model_validate(
            {
                "kind": "views",
                "key": hash_of(identity),
                "identity": identity,
                "dataset": source,
                "dataset_name": dataset.name,
                "scenes": (scene,),
                "request": request,
                "split": split,
                "preset": self._preset_name,
            }
        )

    def _common(
        self, source: str, dataset: Dataset, request: Request, spec: MethodSpec, settings: Settings, seed: int
    ) -> dict[str, Any]:
        return {
            "dataset": source,
            "dataset_name": dataset.name,
            "request": request,
            "split": self._selection.split,
            "method": spec.name,
            "variant": settings.variant,
            "preset": self._preset_name,
            "seed": seed,
            "options": settings.options,
            "iterations": settings.iterations,
            "device": self._selection.device,
            "cloud_points": self._preset.cloud_points,
        }

    def _identity(
        self, spec: MethodSpec, common: dict[str, Any], hashes: Mapping[str, str]
    ) -> dict[str, Any]:
        """What decides a fit: scene content, method, options, budget, seed, device class, training views."""
        request = common["request"]
        return {
            "dataset": common["dataset_name"],
            "scenes": [[name, content] for name, content in hashes.items()],
            "method": [spec.name, spec.version],
            "options": common["options"],
            "iterations": common["iterations"],
            "seed": common["seed"],
            "device": common["device"].split(":")[0],
            "views": [request.train_views, request.width, request.height],
            "trains_on": "train" if common["split"] == "val" else "trainval",
            "cloud_points": common["cloud_points"],
        }

    def _partition(
        self, spec: MethodSpec, common: dict[str, Any], hashes: dict[str, str], views: dict[str, Job]
    ) -> Job:
        identity = {"kind": "partition", **self._identity(spec, common, hashes)}
        return Job.model_validate(
            {
                **common,
                "kind": "partition",
                "key": hash_of(identity),
                "identity": identity,
                "needs": tuple(views[scene].id for scene in hashes),
                "scenes": tuple(hashes),
            }
        )

    def _fit(
        self,
        spec: MethodSpec,
        common: dict[str, Any],
        group: list[str],
        hashes: dict[str, str],
        views: dict[str, Job],
        partition: Job | None,
    ) -> Job:
        identity = {
            "kind": "fit",
            **self._identity(spec, common, {scene: hashes[scene] for scene in group}),
            # A group's share of partition time is that of this very partition.
            "partition": partition.key if partition else None,
        }
        needs = tuple(views[scene].id for scene in group)
        return Job.model_validate(
            {
                **common,
                "kind": "fit",
                "key": hash_of(identity),
                "identity": identity,
                "needs": (*needs, partition.id) if partition else needs,
                "scenes": tuple(group),
                "group": "+".join(group),
            }
        )


def _job(kind: str, before: Job, identity: dict[str, Any], needs: tuple[str, ...], **changes: Any) -> Job:
    """A job that follows another of the same method and group."""
    identity = {"kind": kind, **identity}
    return before.model_copy(
        update={"kind": kind, "key": hash_of(identity), "identity": identity, "needs": needs, **changes}
    )
