"""What a job is and what it leaves behind: typed, versioned, one JSON file per job."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from bench.suites import SAMPLED

SCHEMA = 3
"""Raised when a record of an older store could be misread."""
READABLE = (2, SCHEMA)
"""Schemas that :mod:`bench.migration` reads."""

Kind = Literal["views", "dvr", "partition", "fit", "encode", "measure"]
Status = Literal["ok", "failed", "oom", "timeout", "diverged", "refused"]
Value = bool | int | float | str


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="null")


class Request(_Model):
    """Numbers of views and their size in pixels, before the validation split."""

    train_views: int
    test_views: int
    width: int
    height: int


class Job(_Model):
    """One node of the job graph.

    Attributes:
        key: hash of ``identity``, which holds everything that decides the result; what a job only
            carries along (labels, needs) stands beside it.
        scenes: the basic scenes the job is about: one (or those of a composition) for views, dvr and
            measure, a group for fit and encode.
        composition: name of the composition that the scenes make up, "" for a basic scene.
        edit: what is changed of a basic scene before it is shown (views, measure), as "opacity=0.5".
        group: name of the group of scenes fitted together; of several (measure of a composition), joined
            by commas.
        needs: ids of the jobs that must be finished before.
        metrics: metric name -> version (measure only).
        overrides: options that differ from the preset's, with "iterations" and "configuration";
            ``variant`` is their label.
        knob: the rate knob among the overrides, "" if there is none.
        cloud_points: size of the initial cloud.
        sampled: primitives of a scene whose attributes go into the record (measure only).
    """

    kind: Kind
    key: str
    identity: dict[str, Any]
    needs: tuple[str, ...] = ()
    dataset: str
    dataset_name: str
    scenes: tuple[str, ...]
    composition: str = ""
    edit: str = ""
    group: str = ""
    request: Request
    split: Literal["test", "val"] = "test"
    method: str | None = None
    variant: str = ""
    preset: str
    seed: int = 0
    options: dict[str, Value] = Field(default_factory=dict)
    overrides: dict[str, Value] = Field(default_factory=dict)
    knob: str = ""
    iterations: int | None = None
    rate: float | None = None
    device: str = "cpu"
    cloud_points: int = 10_000
    metrics: dict[str, str] = Field(default_factory=dict)
    sampled: int = SAMPLED

    @property
    def id(self) -> str:
        return f"{self.kind}-{self.key}"

    @property
    def shows(self) -> str:
        """Name of the basic scene or composition that a views, dvr or measure job is about."""
        return self.composition or self.scenes[0]

    @property
    def title(self) -> str:
        """For people: what, of which scenes, by which method."""
        about = self.composition or self.group or "+".join(self.scenes)
        parts = [self.kind, f"{self.dataset_name}/{about}"]
        if self.edit:
            parts.append(self.edit)
        if self.method:
            parts.append(self.method + (f"[{self.variant}]" if self.variant else ""))
        if self.rate is not None:
            parts.append(f"rate {self.rate:g}")
        if self.method and self.seed:
            parts.append(f"seed {self.seed}")
        return " ".join(parts)


class Task(_Model):
    """``job.json``: a job and how this machine runs it."""

    job: Job
    plugins: tuple[str, ...] = ()
    threads: int


class Provenance(_Model):
    """Where and with what a job ran; recorded, never hashed."""

    machine: str
    cpu: str
    cores: int
    threads: int
    memory_bytes: int
    gpu: str | None
    system: str
    python: str
    versions: dict[str, str]
    isa: str | None
    commit: str | None
    source: str | None
    """Hash of the method's source."""


class CurvePoint(_Model):
    """An anytime evaluation.

    ``psnr``: scene -> PSNR of a few of the views that are measured on; none of them is trained on.
    """

    iteration: int
    train_seconds: float
    loss: float | None
    psnr: Mapping[str, float | None]
    primitives: int
    bytes_estimate: int | None = None
    loss_parts: dict[str, float] = Field(default_factory=dict)


class LossPoint(_Model):
    """Means over a stretch of a fit, all in one stage.

    ``losses``: "loss" (which is minimised), its parts, and further figures of the method.
    """

    stage: str
    first: int
    iteration: int
    """The last of the stretch."""
    losses: dict[str, float]


class ViewsResult(_Model):
    """What :mod:`bench.jobs.truth` stored.

    Attributes:
        view_keys: split -> content hash of its views.
        truth: the split that is measured on -> PNG file names, in the order of its cameras.
        render_seconds: this job's own wait.
        cost: split -> what rendering its views took (:attr:`datasets.views.ViewSet.cost`), renderer and
            version among it; empty for pre-rendered views.
        transfer: part -> what it shows (:func:`bench.inputs.transfer_summary`); empty for pre-rendered views.
    """

    view_keys: dict[str, str]
    background: tuple[float, float, float]
    truth: dict[str, list[str]]
    render_seconds: float
    cost: dict[str, dict[str, Any]] = Field(default_factory=dict)
    transfer: dict[str, dict[str, list[list[float]]]] = Field(default_factory=dict)


class DvrResult(_Model):
    """Cost of direct volume rendering, view by view as an interactive viewer would draw.

    Attributes:
        dims: nx, ny, nz; of the first variable.
        volume_bytes: of all variables as they are held, in ``dtype``.
        load_seconds: reading the volumes.
        setup_seconds: from volumes in memory to the first picture, compilation included.
        frame_seconds: median of single-view launches over the test path, after warm-up.
    """

    dims: tuple[int, int, int]
    variables: list[str]
    dtype: str
    volume_bytes: int
    load_seconds: float
    setup_seconds: float
    frame_seconds: float
    frame_seconds_p05: float
    frame_seconds_p95: float
    frames: int
    warmup_stable: bool
    renderer: str
    version: str
    backend: str
    reference_seconds: float | None


class PartitionResult(_Model):
    """Scene names by group."""

    groups: list[list[str]]
    seconds: float


class FitResult(_Model):
    """``seconds``: the training clock, summed over resumes; ``cpu_seconds``: processor time of all threads.

    On a machine that others use as well the second says more about the work; the first is what one waits.
    """

    seconds: float
    cpu_seconds: float | None = None
    iterations: int
    primitives: dict[str, int]
    train_views: int
    curve: list[CurvePoint]
    losses: list[LossPoint] = Field(default_factory=list)
    resumed: int
    reference_seconds: float | None


class EncodeResult(_Model):
    """``ledger``: scene ("" = shared by the group) -> part -> bytes; sums to ``total_bytes``."""

    seconds: float
    total_bytes: int
    ledger: dict[str, dict[str, int]]


class ViewResult(_Model):
    """Measures of one view. A metric that cannot be computed is None."""

    view: str
    metrics: dict[str, float | None]
    identical: bool
    truth_file: str
    render_file: str


class MeasureResult(_Model):
    """What a fresh process measured on the loaded model."""

    load_seconds: float
    frame_seconds: float
    frame_seconds_p05: float
    frame_seconds_p95: float
    frames: int
    warmup_frames: int
    warmup_stable: bool
    timing: dict[str, float]
    primitives: int
    metrics: dict[str, float | None]
    missing: dict[str, str]
    """Metric -> why it could not be computed."""
    views: list[ViewResult]
    features: dict[str, list[list[float]]] = Field(default_factory=dict)
    """Attribute -> rows of some primitives, of a method that shows them."""
    reference_seconds: float | None


class Record(_Model):
    """A finished job, also a failed one.

    Attributes:
        status: "ok" or how it failed; then ``reason``, ``stage``, ``iteration``, ``log_tail`` say more.
        cause: id of the failed job that kept this one from running at all.
        peak_host_bytes: VmHWM of the process (of the timed part for measure).
    """

    schema_version: int = SCHEMA
    job: Job
    status: Status
    reason: str | None = None
    cause: str | None = None
    stage: str | None = None
    iteration: int | None = None
    log_tail: str | None = None
    started: str
    finished: str
    wall_seconds: float
    peak_host_bytes: int | None = None
    peak_device_bytes: int | None = None
    provenance: Provenance | None = None
    views: ViewsResult | None = None
    dvr: DvrResult | None = None
    partition: PartitionResult | None = None
    fit: FitResult | None = None
    encode: EncodeResult | None = None
    measure: MeasureResult | None = None

    @property
    def ok(self) -> bool:
        return self.status == "ok"


def hash_of(identity: Any) -> str:
    """First 16 hex digits of SHA-256 over canonical JSON."""
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def derived_seed(purpose: str, *axes: object) -> int:
    """A seed in [0, 2^31) for one source of randomness, from the axes it may depend on."""
    digest = hashlib.sha256("\x1f".join([purpose, *map(str, axes)]).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1
