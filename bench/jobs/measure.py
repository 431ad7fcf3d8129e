"""The measure job: its fields, identity, result, run and rows.

A figure of a model is a field of :class:`MeasureResult`, filled by :meth:`Measure.run` and written to its
column by ``_measured``; :mod:`.reports.schema` declares the column.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from econgs_bench.bench.jobs import returned
from econgs_bench.bench.jobs.context import Context
from econgs_bench.bench.jobs.costs import costs, fit_row, memory
from econgs_bench.bench.jobs.encode import Encode
from econgs_bench.bench.jobs.method import ModelJob
from econgs_bench.bench.jobs.supersampling import drawer_of, drawn_as
from econgs_bench.bench.jobs.truth import renderer_of, sketch
from econgs_bench.bench.jobs.views import Views, ViewsResult
from econgs_bench.bench.machine.timing import (
    BY_PROGRAM,
    MEASURE_SECONDS,
    RULERS,
    median_timings,
    peak_device_bytes,
    synchronise,
    time_frames,
    told_frames,
)
from econgs_bench.bench.store.lineage import Lineage
from econgs_bench.bench.store.records import (
    SAMPLED,
    Count,
    FrameTimes,
    Metrics,
    PruningResult,
    Record,
    Row,
    ViewResult,
)
from econgs_bench.bench.suites.edits import edit_of, edits_of
from econgs_bench.bench.suites.stress import stress_of
from econgs_bench.datasets.hashes import hash_of
from econgs_bench.datasets.memory import peak_host_bytes
from econgs_bench.datasets.units import camera_in_units
from econgs_bench.datasets.views import evenly_spaced
from econgs_bench.methods.interface import (
    DrawsTogether,
    HasAttributes,
    HasDecoders,
    HasGaussians,
    Method,
    Model,
    Refused,
)
from econgs_bench.methods.options import Settings
from econgs_bench.reports.schema import COVERAGE, METRICS

DECODING_SECONDS = 0.5
"""Time for which frames with decoding are timed, of a model that is decoded once."""
_PARTS_2 = "2026-11-28T09:25:51"
"""When the parts of a frame got their second ruler (:data:`.bench.machine.timing.RULERS`), UTC."""
COUNTED = 8
"""Most views in which the drawn Gaussians are counted."""

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.edits import Edit
    from econgs_bench.datasets.scene import RGB
    from econgs_bench.datasets.views import ViewSet


class MeasureResult(FrameTimes):
    """Measurements of the loaded model, by a process of their own.

    Attributes:
        missing: metric -> why it could not be computed.
        flicker: see :class:`.bench.metrics.flicker.Flicker`; None where views are not neighbouring frames.
        features: attribute -> rows of some primitives; empty if the method does not expose attributes.
        pruning: None where the job does not ask for it, or the model tells no Gaussians apart.
        drawn: Gaussians that are splatted in a test view, mean over a few; None of a model without Gaussians.
        renderer: what rendered the truth; "" in older records.
        sketch: of the truth's pictures (:func:`.bench.jobs.truth.sketch`); "" in older records.
        decoding: when the model's networks make what is drawn: "once", as it is loaded, or "per frame"; ""
            without such networks; None in older records.
        load_host_bytes: peak memory of the process once the model is loaded; None in older records.
        frame_seconds_decoding: median over frames in which a model that is decoded once is decoded again.
        parts_ruler: version of how the parts of a frame are timed (:data:`.bench.machine.timing.RULERS`).
    """

    long: ClassVar[Mapping[str, str]] = {"features": "features"}

    load_seconds: float
    load_host_bytes: Count | None = None
    timing: dict[str, float]
    primitives: Count
    metrics: Metrics
    missing: dict[str, str]
    views: list[ViewResult]
    flicker: float | None = None
    features: dict[str, list[list[float]]] = Field(default_factory=dict)
    pruning: PruningResult | None = None
    drawn: float | None = None
    renderer: str = ""
    sketch: str = ""
    decoding: Literal["", "once", "per frame"] | None = None
    frame_seconds_decoding: float | None = None
    parts_ruler: Count | None = None

    def parts(self) -> Mapping[str, float]:
        return {"load_seconds": self.load_seconds}


class Measure(ModelJob):
    """Loads a saved model in a fresh process, renders and times it, and computes the metrics.

    Attributes:
        recipe: scenes whose models are rendered together for a basic scene, and the edit of each, where a
            method cannot make the edit; empty: it makes the edit.
        metrics: metric -> version.
        sampled: number of primitives per scene whose attributes the record keeps.
        prunable: whether to find out what the model could do without.
    """

    kind: Literal["measure"] = "measure"
    recipe: dict[str, str] = Field(default_factory=dict)
    metrics: dict[str, str] = Field(default_factory=dict)
    sampled: Count = SAMPLED
    prunable: bool = False
    result_type = MeasureResult

    @classmethod
    def of(
        cls,
        encodes: Sequence[Encode],
        views: Views,
        scenes: tuple[str, ...],
        *,
        metrics: Mapping[str, str],
        sampled: int,
        parsimony: bool,
        composition: str = "",
        edit: str = "",
        stress: str = "",
        recipe: Mapping[str, str] = MappingProxyType({}),
    ) -> Self:
        """The measurement of a basic scene, edited or not, or of the scenes of a composition together.

        Args:
            encodes: the models that are rendered.
            views: the truth.
            scenes: basic scenes.
            metrics: name -> version.
            sampled: primitives whose attributes are kept.
            parsimony: whether usual models are asked what they could do without.
            composition: name of the composition, "" for a basic scene.
            edit: of the scene or of those of the composition.
            stress: that decides the truth or the fit.
            recipe: the models that stand for an edited scene, and their edits.
        """
        first, models = encodes[0], [encode.key for encode in encodes]
        identity: dict[str, Any] = {
            "views": views.key, "split": views.split, "metrics": dict(metrics), "rulers": RULERS,
        }  # fmt: skip
        if composition:
            identity |= {"encodes": models, "scenes": list(scenes)}
        else:
            identity |= {"encode": first.key, "scene": scenes[0]}
        if edit:
            identity["edit"] = edit
        if recipe:
            identity |= {"encodes": models, "recipe": dict(recipe)}
        if sampled != SAMPLED:
            identity["sampled"] = sampled
        usual = first.rate is None and not (first.knob or composition or edit or stress)
        if prunable := parsimony and usual:
            identity["prunable"] = True
        return cls.after(
            first,
            identity,
            needs=(views.id, *(encode.id for encode in encodes)),
            scenes=scenes,
            composition=composition,
            edit=edit,
            stress=stress,
            group=",".join(encode.group for encode in encodes),
            rate=first.rate,
            recipe=dict(recipe),
            metrics=dict(metrics),
            sampled=sampled,
            prunable=prunable,
        )

    def drawn(self, settings: Settings) -> Self:
        """This measurement by the settings that decide drawing alone."""
        if not settings.drawing:
            return self
        identity = {**self.identity, **settings.drawing}
        update = {"identity": identity, "key": hash_of(identity)}
        return self.model_copy(update=update | {"variant": settings.variant, "overrides": settings.overrides})

    @property
    def rendered(self) -> tuple[str, ...]:
        """The scenes whose models are rendered together."""
        return tuple(self.recipe) or self.scenes

    @property
    def edits(self) -> dict[str, Edit]:
        """Rendered scene -> its change."""
        if not self.recipe:
            return edits_of(self.scenes, self.edit)
        return {one: edit for name, text in self.recipe.items() for one, edit in edit_of(name, text).items()}

    @property
    def _about(self) -> str:
        return self.composition or "+".join(self.scenes)

    @property
    def shown(self) -> Any:
        return self.identity.get("views")

    def run(self, context: Context) -> MeasureResult:
        """Load, time and render a scene (or a composition's scenes together), then compare with the truth.

        Memory is read before the ground truth and the metrics come into the process.

        Raises:
            Refused: the scenes are in several models and the method cannot render those together, or it
                cannot make the edit.
        """
        scenes = list(self.rendered)
        encodes = context.inputs("encode")
        if context.spec is not None and len(encodes) > 1 and not context.spec.composable:
            raise Refused(f"{self.method} cannot render models of several groups together ({self.group})")
        source = context.input("views").of(ViewsResult)
        assert source is not None
        truth = context.truth(self.subject)
        units = stress_of(self.stress).get("units", 1.0)
        cameras = [camera_in_units(camera, units) for camera in truth.cameras(self.split)]
        edit, background = self.edits, source.background
        method = context.method()

        context.report(stage="load")
        start = time.perf_counter()
        folders = [context.path_of(encode) / "model" for encode in encodes]
        model = drawer_of(self, load_models(method, folders, self.device))
        synchronise(self.device)
        load_seconds, load_host_bytes = time.perf_counter() - start, peak_host_bytes()
        if absent := [scene for scene in scenes if scene not in model.scenes]:
            raise RuntimeError(f"the loaded model holds {list(model.scenes)}, not {', '.join(absent)}")

        context.report(stage="timing")

        def timed(model: Model, seconds: float = MEASURE_SECONDS) -> FrameTimes:
            drawing = drawn_as(self, model)
            return time_frames(
                lambda camera: drawing.render(camera, scenes=scenes, edit=edit, background=background),
                cameras,
                self.device,
                seconds,
            )

        drawing = drawn_as(self, model)
        own = None
        if isinstance(drawing, DrawsTogether):
            own = drawing.draw_all(cameras, scenes, edit, background)
        if own is not None:
            frames, parts = told_frames(own.frame_seconds), {}
            load_seconds += own.load_seconds or 0.0
            context.peak_host_bytes, context.peak_device_bytes = own.peak_host_bytes, own.peak_device_bytes
            load_host_bytes = None
        else:
            frames = timed(model)
            parts = median_timings(
                lambda camera: returned.timings(drawing.timings(camera, scenes=scenes)), cameras
            )
            context.peak_host_bytes = peak_host_bytes()
            context.peak_device_bytes = peak_device_bytes(self.device)
        decoding, decoded_seconds = _decoding(
            model, scenes, lambda each_frame: timed(each_frame, DECODING_SECONDS).frame_seconds
        )

        context.report(stage="metrics")

        def draw(index: int) -> tuple[NDArray[Any], NDArray[Any] | None]:
            if own is not None:
                return own[index]
            answer = drawing.render(cameras[index], scenes=scenes, edit=edit, background=background)
            return returned.picture(answer, cameras[index])

        views = truth.views(self.split)
        return MeasureResult(
            load_seconds=load_seconds,
            load_host_bytes=load_host_bytes,
            **frames.model_dump(),
            timing=parts if frames.frame_seconds is None else {"frame": frames.frame_seconds, **parts},
            decoding=decoding,
            frame_seconds_decoding=decoded_seconds,
            parts_ruler=RULERS["parts"],
            primitives=sum(returned.primitives(model.primitives(scene)) for scene in scenes),
            **self._scores(context, draw, cameras, views),
            features=_attributes(model, scenes, self.sampled),
            pruning=_pruning(self, context, model, cameras, views) if self.prunable else None,
            drawn=None if self.edit else mean_drawn(model, scenes, cameras),
            renderer=renderer_of(source.cost.get(self.split)),
            sketch=sketch(views),
        )

    def _scores(
        self, context: Context, draw: Callable[[int], Any], cameras: Sequence[Camera], views: ViewSet
    ) -> dict[str, Any]:
        """Metrics of all views and their means, as fields of the result; the pictures are stored."""
        from econgs_bench.bench.metrics import evaluate, mean
        from econgs_bench.bench.metrics.flicker import Flicker, is_dense
        from econgs_bench.bench.metrics.image import to_8bit
        from econgs_bench.datasets.png import write_png

        source = context.input("views")
        stored = source.of(ViewsResult)
        assert stored is not None
        out, background = context.folder / "renders", stored.background
        out.mkdir(exist_ok=True)
        rows: list[ViewResult] = []
        missing: dict[str, str] = {}
        metrics = list(dict.fromkeys([*self.metrics, *COVERAGE]))
        flicker = Flicker() if is_dense(cameras) else None
        for index, camera in enumerate(cameras):
            rgb, alpha = draw(index)
            values, reasons = evaluate(views.images[index], rgb, alpha, background, metrics)
            missing.update(reasons)
            shown, displayed = to_8bit(views.composited(index)), to_8bit(rgb)
            if flicker is not None:
                flicker.add(shown, displayed)
            file = f"{index:04d}.png"
            write_png(out / file, rgb if alpha is None else premultiplied(rgb, alpha, background))
            rows.append(
                ViewResult(
                    view=camera.name or f"{index:04d}",
                    metrics=values,
                    identical=bool(np.array_equal(displayed, shown)),
                    truth_file=f"jobs/{source.job.id}/truth/{stored.truth[self.split][index]}",
                    render_file=f"jobs/{self.id}/renders/{file}",
                )
            )
            context.report(stage="metrics", iteration=index + 1, iterations=len(cameras))
        return {
            "metrics": {name: mean([row.metrics[name] for row in rows]) for name in metrics},
            "missing": missing,
            "views": rows,
            "flicker": None if flicker is None else flicker.mean,
        }

    def rows(self, record: Record, lineage: Lineage) -> Mapping[str, Iterable[Row]]:
        tables: dict[str, Iterable[Row]] = {"results": [_row(self, record, lineage)]}
        if (result := record.of(MeasureResult)) is not None:
            tables["views"] = _view_rows(result, _truth(record, lineage))
            if not self.edit:  # an edited scene is of the same model
                timing = result.timing.items()
                tables["timing"] = [{"part": part, "seconds": seconds} for part, seconds in timing]
                tables["features"] = _feature_rows(result)
        return tables

    def migrated(self, record: Record) -> Record:
        """Frames that were timed before records had a ruler had the first one, parts of a frame the first or
        second one, by the time of the job's end.
        """
        record = super().migrated(record)
        result = record.of(MeasureResult)
        if result is None or result.ruler is not None:
            return record
        parts = 1 if record.finished < _PARTS_2 else 2
        return record.model_copy(
            update={"result": result.model_copy(update={"ruler": 1, "parts_ruler": parts})}
        )


def _decoding(
    model: Model, scenes: Sequence[str], frame_seconds: Callable[[Model], float | None]
) -> tuple[Literal["", "once", "per frame"], float | None]:
    """When the networks of a model run; if once, the seconds of a frame in which they run too."""
    if not isinstance(model, HasDecoders):
        return "", None
    decoding = returned.decoding(model.decoding(scenes))
    return decoding, frame_seconds(model.decoding_each_frame()) if decoding == "once" else None


def _pruning(
    job: Measure, context: Context, model: Model, cameras: Sequence[Camera], views: ViewSet
) -> PruningResult | None:
    """What the model of a basic scene could do without; None where it tells no Gaussians apart."""
    if not isinstance(model, HasGaussians):
        return None
    from econgs_bench.bench.jobs.pruning import pruning

    context.report(stage="pruning")
    scene = job.subject
    training = context.truth(scene).cameras("train" if job.split == "val" else "trainval")
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
        for name, rows in returned.attributes(model.attributes(scenes[0], sampled)).items()
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


def _row(job: Measure, record: Record, lineage: Lineage) -> Row:
    """The row of a basic scene (with one model) or of a composition (with those that hold its scenes)."""
    fits, truth = lineage.fits(record), _truth(record, lineage)
    reached = truth.reached if truth is not None else {}
    row = {
        "status": record.status,
        "reason": record.reason,
        "stage": record.stage,
        "recipe": json.dumps(job.recipe) if job.recipe else "",
        "distance": truth.distance if truth is not None else None,
        "floor": reached.get("truth", {}).get("psnr"),
        "one_ray": reached.get("one ray", {}).get("psnr"),
        **costs(job.rendered, lineage.models(record)),
        **memory(record, fits),
        **fit_row(job.rendered, fits),
        "render_host_bytes": record.peak_host_bytes,
        "render_device_bytes": record.peak_device_bytes,
    }
    result = record.of(MeasureResult)
    return row if result is None else row | _measured(result)


def _truth(record: Record, lineage: Lineage) -> ViewsResult | None:
    found = (one.of(ViewsResult) for one in lineage.needed(record, "views"))
    return next(filter(None, found), None)


def _measured(measured: MeasureResult) -> Row:
    row: Row = {name: measured.metrics.get(name) for name in (*METRICS, *COVERAGE)}
    if measured.missing:
        row["reason"] = "; ".join(f"{name}: {why}" for name, why in sorted(measured.missing.items()))
        row["omissions"] = json.dumps(measured.missing, sort_keys=True)
    return row | {
        # Another program need not tell how many it has.
        "primitives": None
        if measured.ruler == BY_PROGRAM and not measured.primitives
        else measured.primitives,
        "load_seconds": measured.load_seconds,
        "load_host_bytes": measured.load_host_bytes,
        **measured.rates(),
        "decoding": measured.decoding,
        "fps_decoding": measured.frame_seconds_decoding and 1.0 / measured.frame_seconds_decoding,
        "ruler": measured.ruler,
        "parts_ruler": measured.parts_ruler,
        "reference_seconds": measured.reference_seconds,
        "reference_worst": measured.reference_worst,
        "identical_views": sum(view.identical for view in measured.views),
        "flicker": measured.flicker,
        "drawn": measured.drawn,
        **({"gaussians": measured.pruning.gaussians, **measured.pruning.shares} if measured.pruning else {}),
    }


def _view_rows(result: MeasureResult, truth: ViewsResult | None) -> Iterator[Row]:
    background = None if truth is None else _hex(truth.background)
    names = _distinct([view.view for view in result.views])
    for name, view in zip(names, result.views, strict=True):
        metrics = {metric: view.metrics.get(metric) for metric in (*METRICS, *COVERAGE)}
        yield view.model_dump() | {"view": name} | metrics | {"background": background}


def _distinct(names: list[str]) -> list[str]:
    """Names that tell the views of a job apart, as every reader of the tables takes them to.

    Records of version 0.2 and before have the same for pictures of the same file name in two folders.
    """
    if len(set(names)) == len(names):
        return names
    return [f"{name} ({names[:place].count(name) + 1})" for place, name in enumerate(names)]


def _feature_rows(result: MeasureResult) -> Iterator[Row]:
    for name, rows in result.features.items():
        if rows:
            values = [value for row in rows for value in row]
            yield {"name": name, "values": values, "width": len(rows[0])}


def _hex(color: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0)):02x}" for value in color)
