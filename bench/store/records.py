"""Jobs and their records: typed, versioned, one JSON file per job."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

SAMPLED = 100
"""Primitives of each scene whose attributes are recorded, unless a suite names another number."""
SCHEMA = 3
"""Raised when a record of an older store could be misread."""
READABLE = (2, SCHEMA)
"""Schemas that :mod:`.bench.store.migration` reads."""

Kind = Literal["views", "dvr", "complexity", "partition", "fit", "encode", "measure"]
Status = Literal["ok", "failed", "oom", "timeout", "diverged", "refused"]
Whole = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Metrics = Annotated[dict[str, float | None], Field(max_length=100)]
Value = bool | Whole | float | str
Key = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
"""Hash of an identity (:func:`.datasets.content.hash_of`): names of folders are made of it."""
JobId = Annotated[str, Field(pattern=f"^({'|'.join(get_args(Kind))})-[0-9a-f]{{16}}$")]
"""Name of a job and of its folder."""
PictureFile = Annotated[str, Field(pattern=r"^[^/\\\x00-\x1f]+\.png$")]
"""Name of a picture in the folder of its job."""
Views = Annotated[int, Field(ge=0, le=1_000_000)]
Pixels = Annotated[int, Field(ge=0, le=1_000_000)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="null")


class Request(_Model):
    """Numbers of views and their size in pixels, before the validation split.

    Attributes:
        samples: rays a pixel of rendered views; 0: as many as each needs. Pre-rendered views and older
            records have 1.
    """

    train_views: Views
    test_views: Views
    width: Pixels
    height: Pixels
    samples: Count = 1

    @property
    def identity(self) -> dict[str, int]:
        """All that decides pictures."""
        return self.model_dump(exclude={"samples"} if self.samples == 1 else None)


class Job(_Model):
    """One node of the job graph.

    Attributes:
        key: hash of ``identity``, which holds everything that decides the result; the other fields are labels
            and needs, or repeat it.
        scenes: basic scenes of the job: one (or those of a composition) for views, dvr and measure, a group
            for fit and encode, all of the dataset for partition.
        composition: name of the composition that the scenes make up, "" for a basic scene.
        edit: change before rendering (views, measure), as "opacity=0.5"; of a composition, changes of its
            scenes in turn, as "opacity=0.5 | opacity=2".
        recipe: scenes whose models are rendered together for a basic scene, and the edit of each, where a
            method cannot make the edit (measure only); empty: it makes the edit.
        stress: harder conditions that decide the job (:mod:`.bench.suites.stress`), as "noise=8"; of measure,
            all that decide the jobs before it as well.
        group: label of the scenes that were fitted together; labels of several groups (measure of a
            composition) are joined by commas.
        needs: ids of the jobs that must be finished before this one.
        metrics: metric name -> version (measure only).
        overrides: options that differ from the preset's, with "iterations" and "configuration";
            ``variant`` is their label.
        knob: the rate knob among the overrides, "" if there is none.
        cloud_points: points of the initial cloud.
        sampled: number of primitives per scene whose attributes the record keeps (measure only).
        prunable: whether to find out what the model could do without (measure only).
    """

    kind: Kind
    key: Key
    identity: dict[str, Any]
    needs: tuple[JobId, ...] = ()
    dataset: str
    dataset_name: str
    scenes: tuple[str, ...]
    composition: str = ""
    edit: str = ""
    recipe: dict[str, str] = Field(default_factory=dict)
    stress: str = ""
    group: str = ""
    request: Request
    split: Literal["test", "val"] = "test"
    method: str | None = None
    variant: str = ""
    preset: str
    seed: Whole = 0
    options: dict[str, Value] = Field(default_factory=dict)
    overrides: dict[str, Value] = Field(default_factory=dict)
    knob: str = ""
    iterations: Count | None = None
    rate: float | None = None
    device: str = "cpu"
    cloud_points: Count = 10_000
    metrics: dict[str, str] = Field(default_factory=dict)
    sampled: Count = SAMPLED
    prunable: bool = False

    @property
    def id(self) -> str:
        return f"{self.kind}-{self.key}"

    @property
    def subject(self) -> str:
        """Name of the composition, or of the first basic scene."""
        return self.composition or self.scenes[0]

    @property
    def rendered(self) -> tuple[str, ...]:
        """The scenes whose models are rendered together."""
        return tuple(self.recipe) or self.scenes

    @property
    def title(self) -> str:
        """Kind, scenes, method and settings, for people; of a measurement the scenes that it shows."""
        group = self.group if self.kind != "measure" else ""
        about = self.composition or group or "+".join(self.scenes)
        parts = [self.kind, f"{self.dataset_name}/{about}"]
        if self.edit:
            parts.append(self.edit)
        if self.stress:
            parts.append(self.stress)
        if self.method:
            parts.append(self.method + (f"[{self.variant}]" if self.variant else ""))
        if self.rate is not None:
            parts.append(f"rate {self.rate:g}")
        if self.method and self.seed:
            parts.append(f"seed {self.seed}")
        return " ".join(parts)


class Task(_Model):
    """``job.json``: a job, and the plugins and threads with which this machine runs it.

    Attributes:
        alone: it has the machine to itself while it is timed; else its cores, beside jobs on other cores.
        replaces: when the record ended that this run of the job is to replace; "" for none.
    """

    job: Job
    plugins: tuple[str, ...] = ()
    threads: Count
    alone: bool = True
    replaces: str = ""


class Provenance(_Model):
    """Machine and software of a job; recorded, never hashed.

    Attributes:
        usable: cores of the machine that the job could use; None in older records.
    """

    machine: str
    cpu: str
    cores: Count
    usable: Count | None = None
    threads: Count
    memory_bytes: Count
    gpu: str | None
    system: str
    python: str
    versions: dict[str, str]
    isa: str | None
    commit: str | None
    source: str | None
    """Hash of the method's source."""


class CurvePoint(_Model):
    """An evaluation during a fit.

    Attributes:
        psnr: scene -> PSNR of a few of the views that are measured at the end; no method trains on them.
        loss_parts: part of the loss -> its weighted value.
    """

    iteration: Count
    train_seconds: float
    loss: float | None
    psnr: Mapping[str, float | None]
    primitives: Count
    bytes_estimate: Count | None = None
    loss_parts: dict[str, float] = Field(default_factory=dict)


class LossPoint(_Model):
    """Means over a stretch of a fit, within one stage.

    Attributes:
        first: first iteration of the stretch.
        iteration: last iteration of the stretch.
        losses: "loss" (the minimised sum), its weighted parts and further figures of the method -> mean.
    """

    stage: str
    first: Count
    iteration: Count
    losses: dict[str, float]


class ViewsResult(_Model):
    """What :mod:`.bench.jobs.truth` stored.

    Attributes:
        view_keys: split -> content hash of its views.
        truth: the measured split -> PNG file names, in the order of its cameras.
        render_seconds: time that this job waited for the views.
        cost: split -> cost of rendering its views (:attr:`.datasets.views.ViewSet.cost`), renderer and
            version among it; empty for pre-rendered views.
        distance: distance in [0, 1] of the transfer functions from those before the edit
            (:func:`.datasets.unseen.transfer_distance`); None without an edit of them.
        transfer: part -> its transfer function and isosurfaces (:func:`.bench.plan.inputs.transfer_summary`);
            empty for pre-rendered views.
        variable: what a basic scene shows; "" for others.
        cloud_seconds: from the volume in memory to the candidates of initial clouds; None without a volume.
        floor: metric -> what the truth itself reaches against the same views rendered with other, more rays
            (:func:`.datasets.render_views.finer_views`), mean over some of the measured views; empty for
            pre-rendered views and in older records.
        one_ray: metric -> what one ray a pixel reaches against these.
        floor_seconds: time that this took.
    """

    view_keys: dict[str, str]
    background: tuple[float, float, float]
    truth: dict[str, list[PictureFile]]
    render_seconds: float
    cost: dict[str, dict[str, Any]] = Field(default_factory=dict)
    distance: float | None = None
    transfer: dict[str, dict[str, list[list[float]]]] = Field(default_factory=dict)
    variable: str = ""
    cloud_seconds: float | None = None
    floor: dict[str, float | None] = Field(default_factory=dict)
    one_ray: dict[str, float | None] = Field(default_factory=dict)
    floor_seconds: float | None = None


class FrameTimes(_Model):
    """Times of single frames over a path of cameras.

    Attributes:
        frame_seconds, frame_seconds_p05, frame_seconds_p95: median and percentiles over all timed frames (at
            least one per camera), after warm-up.
        warmup_frames: their number; None in older records of dvr.
        warmup_stable: whether frame times had settled when warm-up ended.
        reference_seconds: mean of the reference kernel's times before and after; None without native core.
        reference_worst: the longest of its times before, amid and after the timed frames; None in older
            records.
        ruler: version of how frames are timed (:data:`.bench.machine.timing.RULERS`).
    """

    frame_seconds: float
    frame_seconds_p05: float
    frame_seconds_p95: float
    frames: Count
    warmup_frames: Count | None = None
    warmup_stable: bool
    reference_seconds: float | None
    reference_worst: float | None = None
    ruler: Count | None = None


class DvrResult(FrameTimes):
    """Cost of direct volume rendering, view by view as an interactive viewer would draw.

    Attributes:
        dims: nx, ny, nz of the first variable.
        volume_bytes: size of all variables in memory, as ``dtype``.
        load_seconds: time to read the volumes.
        setup_seconds: time from the volumes in memory to the first picture, compilation included.
    """

    dims: tuple[Count, Count, Count]
    variables: list[str]
    dtype: str
    volume_bytes: Count
    load_seconds: float
    setup_seconds: float
    renderer: str
    version: str
    backend: str


class ComplexityResult(_Model):
    """The volume of a scene as its transfer function shows it: 8-bit RGBA, coded without loss.

    Attributes:
        lossless_bytes: None for scenes of isosurfaces, which classify no volume.
        coder: what coded it.
    """

    voxels: Count
    lossless_bytes: Count | None
    coder: str


class PartitionResult(_Model):
    """Groups of scenes, by name."""

    groups: list[list[str]]
    seconds: float


class FitResult(_Model):
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


class EncodeResult(_Model):
    """A saved model.

    Attributes:
        ledger: scene ("" for what the group shares) -> part -> bytes; sums to ``total_bytes``.
    """

    seconds: float
    total_bytes: Count
    ledger: dict[str, dict[str, Whole]]


class ViewResult(_Model):
    """Metrics of one view; a metric that cannot be computed is None."""

    view: str
    metrics: Metrics
    identical: bool
    truth_file: str
    render_file: str


class PruningResult(_Model):
    """What a model could do without.

    Attributes:
        gaussians: those that any training view splats.
        shares: column of :data:`.reports.schema.PRUNED` -> share of them that can go.
    """

    gaussians: Count
    shares: dict[str, float]


class MeasureResult(FrameTimes):
    """Measurements of the loaded model, by a process of their own.

    Attributes:
        missing: metric -> why it could not be computed.
        flicker: see :class:`.bench.metrics.flicker.Flicker`; None where views are not neighbouring frames.
        features: attribute -> rows of some primitives; empty if the method does not expose attributes.
        pruning: None where the job does not ask for it, or the model tells no Gaussians apart.
        drawn: Gaussians that are splatted in a test view, mean over a few; None of a model without Gaussians.
        renderer: what rendered the truth; "" in older records.
        sketch: of the truth's pictures (:func:`.bench.results.identity.sketch`); "" in older records.
        decoding: when the model's networks make what is drawn: "once", as it is loaded, or "per frame"; ""
            without such networks; None in older records.
        frame_seconds_decoding: median over frames in which a model that is decoded once is decoded again.
        parts_ruler: version of how the parts of a frame are timed (:data:`.bench.machine.timing.RULERS`).
    """

    load_seconds: float
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


class Record(_Model):
    """A finished job, also a failed one.

    Attributes:
        status: "ok", or the kind of failure; ``reason``, ``stage``, ``iteration`` and ``log_tail`` detail it.
        cause: id of the failed job without which this one could not run.
        peak_host_bytes: VmHWM of the process (of the timed part for measure).
        peak_device_bytes: the same of the device.
    """

    schema_version: Count = SCHEMA
    job: Job
    status: Status
    reason: str | None = None
    cause: JobId | None = None
    stage: str | None = None
    iteration: Count | None = None
    log_tail: str | None = None
    started: str
    finished: str
    wall_seconds: float
    peak_host_bytes: Count | None = None
    peak_device_bytes: Count | None = None
    provenance: Provenance | None = None
    views: ViewsResult | None = None
    dvr: DvrResult | None = None
    complexity: ComplexityResult | None = None
    partition: PartitionResult | None = None
    fit: FitResult | None = None
    encode: EncodeResult | None = None
    measure: MeasureResult | None = None

    @property
    def ok(self) -> bool:
        return self.status == "ok"


def derived_seed(purpose: str, *axes: object) -> int:
    """A seed in [0, 2^31) for one source of randomness, from the axes it may depend on."""
    digest = hashlib.sha256("\x1f".join([purpose, *map(str, axes)]).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1
