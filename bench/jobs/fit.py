"""The fit job: trains a model of a group of scenes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar, Literal

from pydantic import Field

from econgs_bench.bench.jobs import returned
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.method import TrainingJob
from econgs_bench.bench.jobs.monitor import FitMonitor
from econgs_bench.bench.jobs.scenes import scene_inputs
from econgs_bench.bench.machine.timing import mean_of, reference_seconds, synchronise, worst_of
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import Count, CurvePoint, LossPoint, Record, Result, Row, derived_seed
from econgs_bench.bench.suites.stress import stress_of
from econgs_bench.datasets.units import views_in_units
from econgs_bench.datasets.views import ViewSet, evenly_spaced
from econgs_bench.methods.interface import Budget, MethodSpec, Refused, RunsPrograms, SceneInput

CURVE_VIEWS = 4
"""Number of views of each scene for anytime evaluations."""


class FitResult(Result):
    """A fit.

    Attributes:
        seconds: training clock, summed over resumes.
        cpu_seconds: processor time of all threads; other work on the machine hardly changes it.
        primitives: scene -> its primitives.
        cloud_points: scene -> points of the initial cloud that the method was given; empty in older records.
        resumed: number of resumes.
        reference_seconds: mean of the reference kernel's times before and after; None without native core.
        reference_worst: the longest of its times before, amid and after the fit; None in older records.
    """

    long: ClassVar[Mapping[str, str]] = {"losses": "losses"}

    seconds: float
    cpu_seconds: float | None = None
    iterations: Count
    primitives: dict[str, Count]
    cloud_points: dict[str, Count] = Field(default_factory=dict)
    train_views: Count
    curve: list[CurvePoint]
    losses: list[LossPoint] = Field(default_factory=list)
    resumed: Count
    reference_seconds: float | None
    reference_worst: float | None = None

    def parts(self) -> Mapping[str, float]:
        return {} if self.resumed else {"fit.seconds": self.seconds}


class Fit(TrainingJob):
    """Trains a model of a group of scenes."""

    kind: Literal["fit"] = "fit"
    result_type = FitResult

    @classmethod
    def labelled(cls, scenes: Iterable[str]) -> str:
        return "+".join(scenes)

    def run(self, context: Context) -> FitResult:
        """Train a model, or continue from the checkpoint of an earlier attempt."""
        context.report(stage="loading")
        scenes = scene_inputs(self, context)
        method = context.method()
        refuse_without_volume(context.spec, scenes)
        read_volumes(context.spec, scenes)
        assert self.iterations is not None
        together = sum(scene.train.images.nbytes for scene in scenes)
        spec = context.spec
        assert spec is not None
        # A model that another program draws is drawn once it is saved.
        curved = scenes if spec.resumable else []
        views = {scene.name: _curve_views(self, context, scene.name, together) for scene in curved}
        monitor = FitMonitor(
            context.folder / "checkpoint", self.iterations, views, context.report, context.stop
        )
        resume = monitor.resume()
        if isinstance(method, RunsPrograms) and resume is None:
            method.prepare(scenes, self.device)
        before = reference_seconds()
        context.stop.deferred = spec.resumable
        monitor.start()
        if resume is not None and resume.iteration == self.iterations:  # stopped after its last iteration
            model = method.restore(resume, context.options(self), self.device)
        else:
            seed = derived_seed("fit", self.method, self.dataset_name, self.group, self.seed)
            budget = Budget(self.iterations)
            model = method.fit(scenes, context.options(self), budget, seed, self.device, monitor, resume)
        synchronise(self.device)
        monitor.stop()
        context.stop.deferred = False
        after = reference_seconds()
        if isinstance(method, RunsPrograms):
            context.peak_host_bytes, context.peak_device_bytes = (
                method.peak_host_bytes,
                method.peak_device_bytes,
            )
        if not monitor.final:
            raise RuntimeError(
                f"{self.method} ended its fit without a checkpoint at iteration {self.iterations}: "
                "its fit must call monitor.due and monitor.pause after the last iteration"
            )
        return FitResult(
            seconds=monitor.seconds,
            cpu_seconds=monitor.cpu_seconds,
            iterations=self.iterations,
            primitives={name: returned.primitives(model.primitives(name)) for name in self.scenes},
            cloud_points={scene.name: len(scene.cloud) for scene in scenes},
            train_views=sum(len(scene.train) for scene in scenes) // len(scenes),
            curve=monitor.curve,
            losses=monitor.losses.points,
            resumed=monitor.resumed,
            reference_seconds=mean_of(before, after),
            reference_worst=worst_of([before, monitor.reference_worst, after]),
        )

    def rows(self, record: Record, lineage: Lineage) -> Mapping[str, Iterable[Row]]:
        result = record.of(FitResult)
        if result is None:
            return {}
        curve = [
            point.model_dump()
            | {"scene": scene, "psnr": point.psnr.get(scene), "loss_parts": json.dumps(point.loss_parts)}
            for scene in self.scenes
            for point in result.curve
        ]
        losses = [one.model_dump() | {"losses": json.dumps(one.losses)} for one in result.losses]
        return {"curve": curve, "losses": losses}


def _curve_views(job: Fit, context: Context, scene: str, together: int) -> ViewSet:
    """A few of the views that are measured on, evenly spaced; held with training views of that many bytes."""
    truth, split = context.truth(scene), job.split
    views = truth.views(split, evenly_spaced(len(truth.cameras(split)), CURVE_VIEWS), together)
    return views_in_units(views, stress_of(job.stress).get("units", 1.0))


def refuse_without_volume(spec: MethodSpec | None, scenes: Sequence[SceneInput]) -> None:
    """Check that each scene has the volume that a method needs.

    Raises:
        Refused: a scene has none.
    """
    for scene in scenes:
        if spec is not None and spec.needs_volume and scene.volume is None:
            raise Refused(f"{spec.name} reads the volume itself, and scene {scene.name!r} has only views")


def read_volumes(spec: MethodSpec | None, scenes: Sequence[SceneInput]) -> None:
    """Have the volumes of a method that reads them in memory, like the views, before its clock starts."""
    for scene in scenes:
        if spec is not None and spec.needs_volume and scene.volume is not None:
            scene.volume()
