"""What each kind of job does, inside its own process (see ``bench.worker``)."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.inputs import camera_from_json, camera_to_json, scene_inputs
from bench.monitor import FitMonitor, Progress, Stop
from bench.records import (
    EncodeResult,
    FitResult,
    Job,
    PartitionResult,
    Record,
    ViewsResult,
    derived_seed,
)
from bench.store import Store, write_text
from bench.timing import mean_of, reference_seconds, synchronise
from datasets.errors import DataError
from datasets.views import Split, ViewSet
from methods.interface import Budget, Checkpoint, Method, MethodSpec, Model, Refused, SceneInput

CURVE_VIEWS = 4
"""Of each scene, for anytime evaluations."""


@dataclass
class Context:
    """What a stage works with.

    Attributes:
        folder: where its files go.
        store: finished jobs it may read.
        spec: of the method (None for views and dvr).
        method: loads its implementation.
        peak_host_bytes, peak_device_bytes: of the part that counts, where that is not the whole process.
    """

    job: Job
    folder: Path
    store: Store
    spec: MethodSpec | None
    method: Callable[[], Method]
    stop: Stop
    report: Progress
    peak_host_bytes: int | None = None
    peak_device_bytes: int | None = None

    def needed(self, kind: str) -> Record:
        """The finished job of that kind that this one builds on."""
        return self.all_needed(kind)[0]

    def all_needed(self, kind: str) -> list[Record]:
        """The finished jobs of that kind that this one builds on, at least one."""
        names = [name for name in self.job.needs if name.startswith(f"{kind}-")]
        records = [record for record in map(self.store.record, names) if record is not None and record.ok]
        if not records or len(records) < len(names):
            raise RuntimeError(f"{self.job.id} needs a finished {kind} job, and there is none")
        return records

    def path_of(self, record: Record) -> Path:
        return self.store.jobs / record.job.id


def run_stage(context: Context) -> dict[str, Any]:
    """Run a job; returns the fields of its record that it fills."""
    if context.job.kind == "measure":
        from bench.measure import measure

        return {"measure": measure(context)}
    if context.job.kind == "dvr":
        from bench.dvr import time_renderer

        return {"dvr": time_renderer(context)}
    stage = {"views": _views, "partition": _partition, "fit": _fit, "encode": _encode}[context.job.kind]
    return {context.job.kind: stage(context)}


# --------------------------------------------------------------------------- views


def _views(context: Context) -> ViewsResult:
    """Render (or find in the cache) the views, and keep those that are measured on as PNG files."""
    from bench.inputs import cost_of_views, open_dataset, shown_transfer, views
    from datasets.png import write_png

    job = context.job
    dataset = open_dataset(job.dataset)
    measured: Split = job.split
    keys: dict[str, str] = {}
    cost: dict[str, dict[str, Any]] = {}
    start = time.perf_counter()
    # Nobody trains on a composition or an edited scene.
    only = job.composition or job.edit
    wanted: tuple[Split, ...] = (measured,) if only else ("trainval", measured)
    for split in wanted:
        context.report(stage=f"views: {split}")
        found = views(dataset, job.shows, job.request, split, job.edit)
        keys[split] = found.key
        if (spent := cost_of_views(dataset, job.shows, job.request, split, job.edit)) is not None:
            cost[split] = spent
    seconds = time.perf_counter() - start
    if len(found) == 0:
        raise DataError(
            f"{job.dataset_name}/{job.shows}", f"no views in split {measured!r}", "Use another split"
        )
    folder = context.folder / "truth"
    folder.mkdir(exist_ok=True)
    names = []
    for index, image in enumerate(found.images):
        names.append(f"{index:04d}.png")
        write_png(folder / names[-1], image)
    cameras = [camera_to_json(camera) for camera in found.cameras]
    write_text(context.folder / "cameras.json", json.dumps(cameras))
    background = tuple(float(c) for c in found.background)
    return ViewsResult(
        view_keys=keys,
        background=background,  # type: ignore[arg-type]
        truth={measured: names},
        render_seconds=seconds,
        cost=cost,
        transfer=shown_transfer(dataset, job.shows, job.edit),
    )


def read_cameras(folder: Path) -> list[Any]:
    """Cameras that a views job stored."""
    return [camera_from_json(c) for c in json.loads((folder / "cameras.json").read_text(encoding="utf-8"))]


# --------------------------------------------------------------------------- partition


def _partition(context: Context) -> PartitionResult:
    job = context.job
    scenes = scene_inputs(job)
    method = context.method()
    context.report(stage="partition")
    start = time.perf_counter()
    groups = method.partition(scenes, job.options)
    synchronise(job.device)
    seconds = time.perf_counter() - start
    names = [[scene.name for scene in group] for group in groups]
    if sorted(name for group in names for name in group) != sorted(job.scenes):
        raise RuntimeError(f"{job.method} partitioned {list(job.scenes)} into {names}")
    return PartitionResult(groups=names, seconds=seconds)


# --------------------------------------------------------------------------- fit


def _fit(context: Context) -> FitResult:
    job = context.job
    context.report(stage="loading")
    scenes = scene_inputs(job)
    method = context.method()
    _refuse_without_volume(context.spec, scenes)
    assert job.iterations is not None
    held_out = {scene.name: _curve_views(context, scene.name) for scene in scenes}
    monitor = FitMonitor(
        context.folder / "checkpoint", job.iterations, held_out, context.report, context.stop
    )
    resume = monitor.resume()
    before = reference_seconds()
    context.stop.deferred = True
    monitor.start()
    model = method.fit(scenes, job.options, Budget(job.iterations), _seed(job), job.device, monitor, resume)
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
        primitives={name: model.primitives(name) for name in job.scenes},
        train_views=sum(len(scene.train) for scene in scenes) // len(scenes),
        curve=monitor.curve,
        losses=monitor.losses,
        resumed=monitor.resumed,
        reference_seconds=mean_of(before, after),
    )


def _curve_views(context: Context, scene: str) -> ViewSet:
    """A few of the views that are measured on, evenly spaced, as the views job stored them."""
    from datasets.png import read_png  # not in processes that measure memory and read no picture
    from datasets.prerendered import evenly_spaced

    record = next(one for one in context.all_needed("views") if one.job.shows == scene)
    assert record.views is not None
    folder, files = context.path_of(record), record.views.truth[context.job.split]
    cameras = read_cameras(folder)
    chosen = evenly_spaced(len(files), CURVE_VIEWS)
    images = np.stack([read_png(folder / "truth" / files[i]) for i in chosen])
    key = f"{record.views.view_keys[context.job.split]}-curve"
    return ViewSet(tuple(cameras[i] for i in chosen), images, record.views.background, key)


def _refuse_without_volume(spec: MethodSpec | None, scenes: Sequence[SceneInput]) -> None:
    for scene in scenes:
        if spec is not None and spec.needs_volume and scene.volume is None:
            raise Refused(f"{spec.name} reads the volume itself, and scene {scene.name!r} has only views")


def _seed(job: Job) -> int:
    return derived_seed("fit", job.method, job.dataset_name, job.group, job.seed)


# --------------------------------------------------------------------------- encode


class SilentMonitor:
    """Given to ``fit`` where it only returns the model of a finished checkpoint."""

    def progress(self, iteration: int, losses: Mapping[str, float], primitives: int) -> None:
        raise RuntimeError("the method trains although it was given the checkpoint of a finished fit")

    def due(self, iteration: int) -> bool:
        return False

    def pause(self, iteration: int, model: Callable[[], Model], checkpoint: Callable[[], Checkpoint]) -> None:
        pass

    def stage(self, name: str) -> None:
        pass


def _encode(context: Context) -> EncodeResult:
    from bench.checkpoints import read_checkpoint

    job = context.job
    found = read_checkpoint(context.path_of(context.needed("fit")) / "checkpoint")
    if found is None:
        raise RuntimeError("the fit has no checkpoint")
    context.report(stage="loading")
    scenes = scene_inputs(job)
    method = context.method()
    assert job.iterations is not None
    model = method.fit(
        scenes, job.options, Budget(job.iterations), _seed(job), job.device, SilentMonitor(), found[0]
    )
    folder = context.folder / "model"
    if folder.exists():
        import shutil

        shutil.rmtree(folder)
    folder.mkdir()
    context.report(stage="encode")
    start = time.perf_counter()
    ledger = {scene: dict(parts) for scene, parts in model.save(folder, job.rate).items()}
    synchronise(job.device)
    seconds = time.perf_counter() - start
    total = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    check_ledger(ledger, total, job.scenes)
    return EncodeResult(seconds=seconds, total_bytes=total, ledger=ledger)


def check_ledger(ledger: Mapping[str, Mapping[str, int]], total: int, scenes: tuple[str, ...]) -> None:
    """Refuse a byte ledger that is not about these scenes or does not sum to the files' size.

    Raises:
        RuntimeError: saying by how much, or what is in it that should not be.
    """
    foreign = [name for name in ledger if name and name not in scenes]
    if foreign:
        raise RuntimeError(f"byte ledger names scenes that are not in the group: {', '.join(foreign)}")
    negative = [f"{s}/{p}" for s, parts in ledger.items() for p, n in parts.items() if n < 0]
    if negative:
        raise RuntimeError(f"byte ledger has negative entries: {', '.join(negative)}")
    claimed = sum(sum(parts.values()) for parts in ledger.values())
    if claimed != total:
        raise RuntimeError(f"byte ledger sums to {claimed} bytes, the saved files have {total}")
