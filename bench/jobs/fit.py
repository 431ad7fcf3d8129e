"""The fit job: trains a model of a group of scenes."""

from __future__ import annotations

from collections.abc import Sequence

from econgs_bench.bench.jobs import answers
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.monitor import FitMonitor
from econgs_bench.bench.jobs.scenes import scene_inputs
from econgs_bench.bench.machine.timing import mean_of, reference_seconds, synchronise, worst_of
from econgs_bench.bench.store.records import FitResult, derived_seed
from econgs_bench.bench.suites.stress import stress_of
from econgs_bench.datasets.units import views_in_units
from econgs_bench.datasets.views import ViewSet, evenly_spaced
from econgs_bench.methods.interface import Budget, MethodSpec, Refused, SceneInput

CURVE_VIEWS = 4
"""Number of views of each scene for anytime evaluations."""


def run(context: Context) -> FitResult:
    """Train a model, or continue from the checkpoint of an earlier attempt."""
    job = context.job
    context.report(stage="loading")
    scenes = scene_inputs(context)
    method = context.method()
    refuse_without_volume(context.spec, scenes)
    read_volumes(context.spec, scenes)
    assert job.iterations is not None
    together = sum(scene.train.images.nbytes for scene in scenes)
    views = {scene.name: _curve_views(context, scene.name, together) for scene in scenes}
    monitor = FitMonitor(context.folder / "checkpoint", job.iterations, views, context.report, context.stop)
    resume = monitor.resume()
    before = reference_seconds()
    context.stop.deferred = True
    monitor.start()
    if resume is not None and resume.iteration == job.iterations:  # stopped after its last iteration
        model = method.restore(resume, context.options, job.device)
    else:
        seed = derived_seed("fit", job.method, job.dataset_name, job.group, job.seed)
        budget = Budget(job.iterations)
        model = method.fit(scenes, context.options, budget, seed, job.device, monitor, resume)
    synchronise(job.device)
    monitor.stop()
    context.stop.deferred = False
    after = reference_seconds()
    if not monitor.final:
        raise RuntimeError(
            f"{job.method} ended its fit without a checkpoint at iteration {job.iterations}: "
            "its fit must call monitor.due and monitor.pause after the last iteration"
        )
    return FitResult(
        seconds=monitor.seconds,
        cpu_seconds=monitor.cpu_seconds,
        iterations=job.iterations,
        primitives={name: answers.primitives(model.primitives(name)) for name in job.scenes},
        cloud_points={scene.name: len(scene.cloud) for scene in scenes},
        train_views=sum(len(scene.train) for scene in scenes) // len(scenes),
        curve=monitor.curve,
        losses=monitor.losses.points,
        resumed=monitor.resumed,
        reference_seconds=mean_of(before, after),
        reference_worst=worst_of([before, monitor.reference_worst, after]),
    )


def _curve_views(context: Context, scene: str, together: int) -> ViewSet:
    """A few of the views that are measured on, evenly spaced; held with training views of that many bytes."""
    truth, split = context.truth(scene), context.job.split
    views = truth.views(split, evenly_spaced(len(truth.cameras(split)), CURVE_VIEWS), together)
    return views_in_units(views, stress_of(context.job.stress).get("units", 1.0))


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
