"""From a selection to the job graph: views → (partition →) fit → encode → measure, and dvr on its own.

Planning reads the data, so that bad input ends a run before its first job, and the records of finished
partitions. The groups of a joint method follow from its partition job, so the executor plans again after it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from types import MappingProxyType
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

    Attributes:
        registry: the methods.
        renders: whether any dataset is a volume, whose views are rendered.

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
        self.renders = any(subset.kind == "volume" for subset in self._subsets)

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
        points = [
            (knob, value)
            for knob in (spec.rate_knobs if self._selection.suite.rates == "all" else ())
            for value in knob.values
        ]
        saved = [None, *(value for knob, value in points if not knob.refit)]
        yield resolve(spec, self._preset_name, overrides), saved
        for knob, value in points:
            if knob.refit:
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
                    training = partial(self._training, subset, spec, settings, seed, views)
                    groups, partition = [[scene] for scene in subset.hashes], None
                    if spec.joint:
                        partition = training("partition", list(subset.hashes))
                        yield partition
                        groups = _groups(partition, store)
                    # A group's share of partition time is that of this very partition.
                    after = {"partition": partition.key if partition else None}
                    needs = (partition.id,) if partition else ()
                    fits = [training("fit", group, needs, after) for group in groups]
                    yield from self._of_fits(fits, subset, views, edited, rates)

    def _of_fits(
        self,
        fits: list[Job],
        subset: Subset,
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
                    yield self._measure([encode], (scene,), views[scene])
                    for edit in self._selection.suite.edits if rate is None else ():
                        if (scene, edit) in edited:
                            yield self._measure([encode], (scene,), edited[scene, edit], edit=edit)
        for name, parts in subset.compositions.items() if fits else ():
            for rate in rates:
                models = list({encodes[part, rate].id: encodes[part, rate] for part in parts}.values())
                yield self._measure(models, parts, views[name], name)

    def _measure(
        self, encodes: list[Job], scenes: tuple[str, ...], views: Job, composition: str = "", edit: str = ""
    ) -> Job:
        """The measurement of a basic scene, edited or not, or of the scenes of a composition together."""
        identity: dict[str, Any] = {
            "kind": "measure",
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
        return _after(
            encodes[0],
            identity,
            needs=(views.id, *(encode.id for encode in encodes)),
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
        """A job about a scene or composition without a method: its views, or the cost of rendering it."""
        identity = {"kind": kind, "scene": subset.content(name), "request": subset.request.model_dump()}
        if edit:
            identity["edit"] = edit
        if kind == "views":
            identity["split"] = self._selection.split
        return self._job(
            subset,
            identity,
            scenes=subset.compositions.get(name, (name,)),
            composition=name if name in subset.compositions else "",
            edit=edit,
        )

    def _training(
        self,
        subset: Subset,
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

        Its identity: content of the scenes, method, options, budget, seed, class of device, training views.
        """
        request, device = subset.request, self._selection.device
        identity = {
            "kind": kind,
            "dataset": subset.name,
            "scenes": [[name, subset.hashes[name]] for name in scenes],
            "method": [spec.name, spec.version],
            "options": settings.values,
            "iterations": settings.iterations,
            "seed": seed,
            "device": device.split(":")[0],
            "views": [request.train_views, request.width, request.height],
            "trains_on": "train" if self._selection.split == "val" else "trainval",
            "cloud_points": self._preset.cloud_points,
            **more,
        }
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
            iterations=settings.iterations,
            device=device,
            cloud_points=self._preset.cloud_points,
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


def _groups(partition: Job, store: Store | None) -> list[list[str]]:
    """Groups of a partition; none as long as it has not run."""
    record = store.record(partition.id) if store else None
    if record is not None and not record.ok:
        return [list(partition.scenes)]  # its failure is the failure of every scene
    return record.partition.groups if record is not None and record.partition is not None else []


def _after(job: Job, identity: dict[str, Any], **changes: Any) -> Job:
    """A job that follows another one of the same method and group."""
    kind = {"kind": identity["kind"], "key": hash_of(identity), "identity": identity}
    return job.model_copy(update=kind | changes)
