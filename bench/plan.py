"""From a selection to the job graph: views → (partition →) fit → encode → measure, and dvr on its own.

Planning reads the data (so bad input is found before any job starts) and the records of finished
partitions: which groups a joint method fits is known only once its partition job has run, so the
executor plans again after it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bench.records import Job, hash_of
from bench.selection import Selection, Subset, subsets
from bench.store import Store
from bench.suites import SAMPLED
from datasets.names import unknown
from methods.interface import MethodSpec
from methods.options import Settings, resolve
from methods.registry import Registry


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
        self._specs = self._methods()
        self._settings = list(self._variants())
        self._subsets = subsets(selection, self._preset)

    def jobs(self, store: Store | None) -> list[Job]:
        """All jobs that can be planned so far, in an order in which they can run."""
        jobs: dict[str, Job] = {}
        for job in self._all(store):
            jobs.setdefault(job.id, job)
        return list(jobs.values())

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
                overrides = {**variant.get(spec.name, {}), **self._selection.overrides.get(spec.name, {})}
                for settings, rates in self._with_rates(spec, overrides):
                    if (spec.name, settings.variant) not in variants:
                        variants.add((spec.name, settings.variant))
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

    # ------------------------------------------------------------------ graph

    def _all(self, store: Store | None) -> Iterator[Job]:
        for subset in self._subsets:
            if self._selection.suite.dvr and subset.kind == "volume":
                for name in (*subset.hashes, *subset.compositions):
                    yield self._of_scene("dvr", subset, name)
            if not self._settings:
                continue
            views = {
                name: self._of_scene("views", subset, name) for name in (*subset.hashes, *subset.compositions)
            }
            edited = self._edited_views(subset)
            yield from (*views.values(), *edited.values())
            for spec, settings, rates in self._settings:
                for seed in self._seeds:
                    common = self._common(subset, spec, settings, seed)
                    yield from self._of_method(store, spec, common, subset, views, edited, rates)

    def _of_method(
        self,
        store: Store | None,
        spec: MethodSpec,
        common: dict[str, Any],
        subset: Subset,
        views: dict[str, Job],
        edited: dict[tuple[str, str], Job],
        rates: list[float | None],
    ) -> Iterator[Job]:
        partition = None
        groups = [[scene] for scene in subset.hashes]
        if spec.joint:
            partition = self._partition(spec, common, subset, views)
            yield partition
            record = store.record(partition.id) if store else None
            if record is not None and not record.ok:
                groups = [list(subset.hashes)]  # its failure is the failure of every scene
            elif record is None or record.partition is None:
                return
            else:
                groups = record.partition.groups
        encodes: dict[tuple[str, float | None], Job] = {}
        for group in groups:
            fit = self._fit(spec, common, group, subset, views, partition)
            yield fit
            for rate in rates:
                needs = (fit.id, *(views[scene].id for scene in group))
                encode = _job("encode", fit, {"fit": fit.key, "rate": rate}, needs, rate=rate)
                yield encode
                for scene in group:
                    encodes[scene, rate] = encode
                    yield self._measure([encode], (scene,), views[scene])
                    for edit in self._selection.suite.edits if rate is None else ():
                        if (scene, edit) in edited:
                            yield self._measure([encode], (scene,), edited[scene, edit], edit=edit)
        for name, parts in subset.compositions.items():
            for rate in rates:
                models = list({encodes[part, rate].id: encodes[part, rate] for part in parts}.values())
                yield self._measure(models, parts, views[name], name)

    def _measure(
        self,
        encodes: list[Job],
        scenes: tuple[str, ...],
        views: Job,
        composition: str = "",
        edit: str = "",
    ) -> Job:
        """Of a basic scene, as it is or edited, or of the scenes of a composition together."""
        identity: dict[str, Any] = {
            "views": views.key,
            "split": self._selection.split,
            "metrics": self._metrics,
        }
        if composition:
            identity |= {"encodes": [encode.key for encode in encodes], "scenes": list(scenes)}
        else:
            identity |= {"encode": encodes[0].key, "scene": scenes[0]}
        if edit:
            identity["edit"] = edit
        if (sampled := self._selection.suite.sampled) != SAMPLED:
            identity["sampled"] = sampled
        return _job(
            "measure",
            encodes[0],
            identity,
            (views.id, *(encode.id for encode in encodes)),
            scenes=scenes,
            composition=composition,
            edit=edit,
            group=",".join(encode.group for encode in encodes),
            metrics=dict(self._metrics),
            sampled=sampled,
        )

    def _edited_views(self, subset: Subset) -> dict[tuple[str, str], Job]:
        """Scene and edit -> the views of the edited scene, where scenes can be rendered."""
        edits = self._selection.suite.edits if subset.kind == "volume" else ()
        return {
            (scene, edit): self._of_scene("views", subset, scene, edit)
            for scene in subset.hashes
            for edit in edits
        }

    def _of_scene(self, kind: str, subset: Subset, name: str, edit: str = "") -> Job:
        """A job about a scene or composition itself, of no method: its views, or the cost of rendering it."""
        identity = {"kind": kind, "scene": subset.content(name), "request": subset.request.model_dump()}
        if edit:
            identity["edit"] = edit
        if kind == "views":
            identity["split"] = self._selection.split
        return Job.model_validate(
            {
                "kind": kind,
                "key": hash_of(identity),
                "identity": identity,
                "dataset": subset.source,
                "dataset_name": subset.name,
                "scenes": subset.compositions.get(name, (name,)),
                "composition": name if name in subset.compositions else "",
                "edit": edit,
                "request": subset.request,
                "split": self._selection.split,
                "preset": self._preset_name,
            }
        )

    def _common(self, subset: Subset, spec: MethodSpec, settings: Settings, seed: int) -> dict[str, Any]:
        return {
            "dataset": subset.source,
            "dataset_name": subset.name,
            "request": subset.request,
            "split": self._selection.split,
            "method": spec.name,
            "variant": settings.variant,
            "preset": self._preset_name,
            "seed": seed,
            "options": settings.values,
            "overrides": settings.overrides,
            "knob": settings.knob,
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
        self, spec: MethodSpec, common: dict[str, Any], subset: Subset, views: dict[str, Job]
    ) -> Job:
        hashes = subset.hashes
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
        subset: Subset,
        views: dict[str, Job],
        partition: Job | None,
    ) -> Job:
        identity = {
            "kind": "fit",
            **self._identity(spec, common, {scene: subset.hashes[scene] for scene in group}),
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
