"""The measure job: loads a saved model in a fresh process, renders and times it, and computes the metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from econgs_bench.bench.jobs import answers
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.supersampling import drawn_as
from econgs_bench.bench.machine.timing import (
    MEASURE_SECONDS,
    RULERS,
    median_timings,
    peak_device_bytes,
    synchronise,
    time_frames,
)
from econgs_bench.bench.results.identity import renderer_of, sketch
from econgs_bench.bench.store.records import FrameTimes, MeasureResult, PruningResult, ViewResult
from econgs_bench.bench.suites.edits import edit_of, edits_of
from econgs_bench.bench.suites.stress import stress_of
from econgs_bench.datasets.memory import peak_host_bytes
from econgs_bench.datasets.units import camera_in_units
from econgs_bench.datasets.views import evenly_spaced
from econgs_bench.methods.interface import HasAttributes, HasDecoders, HasGaussians, Method, Model, Refused
from econgs_bench.reports.schema import COVERAGE

DECODING_SECONDS = 0.5
"""Time for which frames with decoding are timed, of a model that is decoded once."""
COUNTED = 8
"""Most views in which the drawn Gaussians are counted."""

if TYPE_CHECKING:
    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.scene import RGB
    from econgs_bench.datasets.views import ViewSet


def run(context: Context) -> MeasureResult:
    """Load, time and render a scene (or a composition's scenes together), then compare with the ground truth.

    Memory is read before the ground truth and the metrics come into the process.

    Raises:
        Refused: the scenes are in several models and the method cannot render those together, or it cannot
            make the edit.
    """
    job, scenes = context.job, list(context.job.rendered)
    encodes = context.inputs("encode")
    if context.spec is not None and len(encodes) > 1 and not context.spec.composable:
        raise Refused(f"{job.method} cannot render models of several groups together ({job.group})")
    views_job = context.input("views")
    assert views_job.views is not None
    truth = context.truth(job.subject)
    units = stress_of(job.stress).get("units", 1.0)
    cameras = [camera_in_units(camera, units) for camera in truth.cameras(job.split)]
    edit = edits_of(job.scenes, job.edit)
    if job.recipe:
        edit = {}
        for scene, text in job.recipe.items():
            edit |= edit_of(scene, text)
    background = views_job.views.background
    method = context.method()

    context.report(stage="load")
    start = time.perf_counter()
    model = load_models(method, [context.path_of(encode) / "model" for encode in encodes], job.device)
    synchronise(job.device)
    load_seconds = time.perf_counter() - start
    if absent := [scene for scene in scenes if scene not in model.scenes]:
        raise RuntimeError(f"the loaded model holds {list(model.scenes)}, not {', '.join(absent)}")

    context.report(stage="timing")

    def timed(model: Model, seconds: float = MEASURE_SECONDS) -> FrameTimes:
        drawing = drawn_as(job, model)
        return time_frames(
            lambda camera: drawing.render(camera, scenes=scenes, edit=edit, background=background),
            cameras,
            job.device,
            seconds,
        )

    frames, drawing = timed(model), drawn_as(job, model)
    parts = median_timings(lambda camera: answers.timings(drawing.timings(camera, scenes=scenes)), cameras)
    context.peak_host_bytes, context.peak_device_bytes = peak_host_bytes(), peak_device_bytes(job.device)
    decoding, decoded_seconds = _decoding(
        model, scenes, lambda each_frame: timed(each_frame, DECODING_SECONDS).frame_seconds
    )

    context.report(stage="metrics")
    from econgs_bench.bench.metrics import evaluate, mean
    from econgs_bench.bench.metrics.flicker import Flicker, is_dense
    from econgs_bench.bench.metrics.image import to_8bit
    from econgs_bench.datasets.png import write_png

    views = truth.views(job.split)
    out = context.folder / "renders"
    out.mkdir(exist_ok=True)
    rows: list[ViewResult] = []
    missing: dict[str, str] = {}
    metrics = list(dict.fromkeys([*job.metrics, *COVERAGE]))
    flicker = Flicker() if is_dense(cameras) else None
    for index, camera in enumerate(cameras):
        answer = drawing.render(camera, scenes=scenes, edit=edit, background=background)
        rgb, alpha = answers.picture(answer, camera)
        values, reasons = evaluate(views.images[index], rgb, alpha, background, metrics)
        missing.update(reasons)
        shown, displayed = to_8bit(views.composited(index)), to_8bit(rgb)
        if flicker is not None:
            flicker.add(shown, displayed)
        file = f"{index:04d}.png"
        write_png(out / file, premultiplied(rgb, alpha, background))
        rows.append(
            ViewResult(
                view=camera.name or f"{index:04d}",
                metrics=values,
                identical=bool(np.array_equal(displayed, shown)),
                truth_file=f"jobs/{views_job.job.id}/truth/{views_job.views.truth[job.split][index]}",
                render_file=f"jobs/{job.id}/renders/{file}",
            )
        )
        context.report(stage="metrics", iteration=index + 1, iterations=len(cameras))
    return MeasureResult(
        load_seconds=load_seconds,
        **frames.model_dump(),
        timing={"frame": frames.frame_seconds, **parts},
        decoding=decoding,
        frame_seconds_decoding=decoded_seconds,
        parts_ruler=RULERS["parts"],
        primitives=sum(answers.primitives(model.primitives(scene)) for scene in scenes),
        metrics={name: mean([row.metrics[name] for row in rows]) for name in metrics},
        missing=missing,
        views=rows,
        flicker=None if flicker is None else flicker.mean,
        features=_attributes(model, scenes, job.sampled),
        pruning=_pruning(context, model, cameras, views) if job.prunable else None,
        drawn=None if job.edit else mean_drawn(model, scenes, cameras),
        renderer=renderer_of(views_job.views.cost.get(job.split)),
        sketch=sketch(views),
    )


def _decoding(
    model: Model, scenes: Sequence[str], frame_seconds: Callable[[Model], float]
) -> tuple[Literal["", "once", "per frame"], float | None]:
    """When the networks of a model run; if once, the seconds of a frame in which they run too."""
    if not isinstance(model, HasDecoders):
        return "", None
    decoding = answers.decoding(model.decoding(scenes))
    return decoding, frame_seconds(model.decoding_each_frame()) if decoding == "once" else None


def _pruning(
    context: Context, model: Model, cameras: Sequence[Camera], views: ViewSet
) -> PruningResult | None:
    """What the model of a basic scene could do without; None where it tells no Gaussians apart."""
    if not isinstance(model, HasGaussians):
        return None
    from econgs_bench.bench.jobs.pruning import pruning

    context.report(stage="pruning")
    scene = context.job.subject
    training = context.truth(scene).cameras("train" if context.job.split == "val" else "trainval")
    return pruning(model, scene, training, cameras, views)


def mean_drawn(model: Model, scenes: Sequence[str], cameras: Sequence[Camera]) -> float | None:
    """Gaussians of scenes that are splatted in a view, mean over at most :data:`COUNTED`, evenly spaced.

    None for a model that tells no Gaussians apart.
    """
    if not isinstance(model, HasGaussians):
        return None
    import torch

    chosen = evenly_spaced(len(cameras), COUNTED)
    with torch.inference_mode():
        counts = [len(model.splats(scene, cameras[view])[1]) for view in chosen for scene in scenes]
    return sum(counts) / len(chosen)


def _attributes(model: Model, scenes: Sequence[str], sampled: int) -> dict[str, list[list[float]]]:
    """Attributes of a basic scene's primitives, three digits each; a composition has those of its parts."""
    if len(scenes) != 1 or not isinstance(model, HasAttributes):
        return {}
    return {
        name: [[float(f"{value:.3g}") for value in row] for row in rows]
        for name, rows in answers.attributes(model.attributes(scenes[0], sampled)).items()
    }


def load_models(method: Method, folders: Sequence[Path], device: str) -> Model:
    """The model of one saved folder, or those of several joined.

    Raises:
        Refused: the method cannot compose them.
    """
    models = [method.load(folder, device) for folder in folders]
    return models[0] if len(models) == 1 else method.compose(models)


def premultiplied(rgb: np.ndarray, alpha: np.ndarray, background: RGB) -> np.ndarray:
    """(H, W, 4) background-free image from one composited on ``background``."""
    back = np.asarray(background, dtype=np.float32)
    free = np.clip(rgb - (1.0 - alpha[..., None]) * back, 0.0, 1.0)
    return np.concatenate([free, alpha[..., None]], axis=-1).astype(np.float32)
