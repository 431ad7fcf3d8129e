"""Jobs and their records: typed, versioned, one JSON file per job."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    create_model,
    model_serializer,
    model_validator,
)

from econgs_bench.datasets.hashes import hash_of

SAMPLED = 100
"""Primitives of each scene whose attributes are recorded, unless a suite names another number."""
SCHEMA = 3
"""Raised when a record of an older store could be misread."""
READABLE = (2, SCHEMA)
"""Schemas that :meth:`Job.migrated` reads."""

Kind = Literal["views", "dvr", "complexity", "partition", "fit", "encode", "measure"]
KINDS = get_args(Kind)
Row = dict[str, Any]
"""Column -> value, of a table of :mod:`.reports.schema`."""
Status = Literal["ok", "failed", "oom", "timeout", "diverged", "refused"]
Whole = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Metrics = Annotated[dict[str, float | None], Field(max_length=100)]
Value = bool | Whole | float | str
Key = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
"""Hash of an identity (:func:`.datasets.hashes.hash_of`): names of folders are made of it."""
JobId = Annotated[str, Field(pattern=f"^({'|'.join(KINDS)})-[0-9a-f]{{16}}$")]
"""Name of a job and of its folder."""
PictureFile = Annotated[str, Field(pattern=r"^[^/\\\x00-\x1f]+\.png$")]
"""Name of a picture in the folder of its job."""
ViewCount = Annotated[int, Field(ge=0, le=1_000_000)]
Pixels = Annotated[int, Field(ge=0, le=1_000_000)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="null")


class Request(_Model):
    """Numbers of views and their size in pixels, before the validation split.

    Attributes:
        samples: rays a pixel of rendered views; 0: as many as each needs. Pre-rendered views and older
            records have 1.
    """

    train_views: ViewCount
    test_views: ViewCount
    width: Pixels
    height: Pixels
    samples: Count = 1

    @property
    def identity(self) -> dict[str, int]:
        """All that decides pictures."""
        return self.model_dump(exclude={"samples"} if self.samples == 1 else None)


class Result(_Model):
    """What a finished job found out; each kind has a class of its own.

    Attributes:
        long: table -> field that takes much room and is in no other table.
    """

    long: ClassVar[Mapping[str, str]] = {}

    def parts(self) -> Mapping[str, float]:
        """Part of the job -> its seconds, of those that lie within the job's wall time."""
        return {}


class Job(_Model):
    """One node of the job graph; each kind is a subclass in its own module of :mod:`.bench.jobs`.

    Attributes:
        key: hash of ``identity``, which holds everything that decides the result; the other fields are labels
            and needs, or repeat it.
        scenes: basic scenes of the job: one (or those of a composition) for views, dvr and measure, a group
            for fit and encode, all of the dataset for partition.
        composition: name of the composition that the scenes make up, "" for a basic scene.
        edit: change before rendering (views, measure), as "opacity=0.5"; of a composition, changes of its
            scenes in turn, as "opacity=0.5 | opacity=2".
        stress: harder conditions that decide the job (:mod:`.bench.suites.stress`), as "noise=8"; of measure,
            all that decide the jobs before it as well.
        needs: ids of the jobs that must be finished before this one.
        result_type: of its results.
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
    stress: str = ""
    request: Request
    split: Literal["test", "val"] = "test"
    preset: str

    result_type: ClassVar[type[Result]] = Result

    @model_validator(mode="before")
    @classmethod
    def _own_fields(cls, data: Any) -> Any:
        """Records of version 0.2 and before have the fields of all kinds in each job."""
        if not isinstance(data, dict):
            return data
        return {
            name: value for name, value in data.items() if name in cls.model_fields or name not in _FIELDS
        }

    @classmethod
    def made(cls, identity: Mapping[str, Any], **fields: Any) -> Self:
        """A job by what decides its result, and its other fields."""
        kind = cls.model_fields["kind"].default
        identity = {"kind": kind, **identity}
        return cls(kind=kind, key=hash_of(identity), identity=identity, **fields)

    @property
    def id(self) -> str:
        return f"{self.kind}-{self.key}"

    @property
    def subject(self) -> str:
        """Name of the composition, or of the first basic scene."""
        return self.composition or self.scenes[0]

    @property
    def title(self) -> str:
        """Kind, scenes, method and settings, for people; of a measurement the scenes that it shows."""
        parts = [self.kind, f"{self.dataset_name}/{self._about}", self.edit, self.stress, *self._settings]
        return " ".join(filter(None, parts))

    @property
    def _about(self) -> str:
        return self.composition or "+".join(self.scenes)

    @property
    def _settings(self) -> list[str]:
        return []

    @property
    def shown(self) -> Any:
        """Hash of what a job that is a row of a table is about; None of other kinds."""
        return None

    @property
    def cell(self) -> tuple[Any, ...]:
        """What beside scenes and views tells the rows of a table apart."""
        return ()

    def axes(self) -> dict[str, Any]:
        """Columns of the table `jobs` that follow from the job alone."""
        return {
            "step": self.kind,
            "dataset": self.dataset_name,
            "scene": f"{self.subject} {self.edit}".strip(),
            "kind": "edited" if self.edit else "composed" if self.composition else "basic",
            "edit": self.edit,
            "stress": self.stress,
            "members": json.dumps(self.scenes),
            "group": "",
            "method": None,
            "variant": "",
            "base": "",
            "rate": None,
            "preset": self.preset,
            "split": self.split,
            "seed": 0,
            "requested_views": self.request.train_views,
            "width": self.request.width,
            "height": self.request.height,
            "device": "cpu",
        }

    def run(self, context: Any) -> Result:
        """Run the job (:class:`.bench.jobs.context.Context`)."""
        raise NotImplementedError

    def rows(self, record: Record, lineage: Any) -> Mapping[str, Iterable[Row]]:
        """Table -> the rows of a record of this job, without the columns that all its rows share.

        Args:
            record: of this job, also a failed one.
            lineage: the records beside it (:class:`.bench.store.lineage.Lineage`).
        """
        return {}

    def migrated(self, record: Record) -> Record:
        """A record of this job with what later versions of this program add."""
        if record.schema_version == SCHEMA:
            return record
        return record.model_copy(update={"schema_version": SCHEMA})


_FIELDS = {
    "group", "recipe", "method", "variant", "seed", "options", "overrides", "knob", "iterations", "rate",
    "device", "cloud_points", "metrics", "sampled", "prunable",
}  # fmt: skip
"""Fields that some kinds have."""


def kind_of(name: str) -> type[Job]:
    """The class of a kind of jobs: that of its name in the module of its name."""
    found: type[Job] = getattr(import_module(f"econgs_bench.bench.jobs.{name}"), name.capitalize())
    return found


@cache
def _form(kind: str) -> type[BaseModel]:
    """What a record of a kind is as JSON: its result has the name of the kind."""
    own = kind_of(kind)
    fields: dict[str, Any] = {
        name: (field.annotation, field)
        for name, field in Record.model_fields.items()
        if name not in ("job", "result")
    }
    fields |= dict.fromkeys(KINDS, (None, None)) | {"job": (own, ...), kind: (own.result_type | None, None)}
    return create_model(f"{own.__name__}Record", __base__=_Model, **fields)


def record_of(text: str | bytes, kind: str) -> Record:
    """A record from its JSON, which is read without Python objects in between: it may be a stranger's.

    Raises:
        ValidationError: it is no record of this kind.
    """
    form = _form(kind).model_validate_json(text)
    values = {name: getattr(form, name) for name in Record.model_fields if name != "result"}
    return Record.model_construct(**values, result=getattr(form, kind))


def _of_its_kind(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    name = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(name, str) or name not in KINDS:
        return handler(value)
    return _validated(kind_of(name), value)


def _validated(model: type[BaseModel], value: Any) -> Any:
    """A value of a model that is known only now; what is wrong with it is said in one line."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        wrong = error.errors()[0]
        raise ValueError(": ".join([".".join(map(str, wrong["loc"])), wrong["msg"]])) from error


AnyJob = Annotated[SerializeAsAny[Job], WrapValidator(_of_its_kind)]


class Task(_Model):
    """``job.json``: a job, and the plugins and threads with which this machine runs it.

    Attributes:
        alone: it has the machine to itself while it is timed; else its cores, beside jobs on other cores.
        replaces: when the record ended that this run of the job is to replace; "" for none.
    """

    job: AnyJob
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


class FrameTimes(Result):
    """Times of single frames over a path of cameras.

    Attributes:
        frame_seconds, frame_seconds_p05, frame_seconds_p95: median and percentiles over all timed frames (at
            least one per camera), after warm-up; None where another program draws and does not tell.
        warmup_frames: their number; None in older records of dvr.
        warmup_stable: whether frame times had settled when warm-up ended.
        reference_seconds: mean of the reference kernel's times before and after; None without native core.
        reference_worst: the longest of its times before, amid and after the timed frames; None in older
            records.
        ruler: version of how frames are timed (:data:`.bench.machine.timing.RULERS`); 0: by the program that
            draws them.
    """

    frame_seconds: float | None
    frame_seconds_p05: float | None
    frame_seconds_p95: float | None
    frames: Count
    warmup_frames: Count | None = None
    warmup_stable: bool
    reference_seconds: float | None
    reference_worst: float | None = None
    ruler: Count | None = None

    def rates(self) -> dict[str, float | None]:
        """Frames a second, as columns of the tables."""
        seconds = {
            "fps": self.frame_seconds,
            "fps_p05": self.frame_seconds_p95,
            "fps_p95": self.frame_seconds_p05,
        }
        return {name: None if one is None else 1.0 / one for name, one in seconds.items()}


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


class Record(_Model):
    """A finished job, also a failed one.

    Attributes:
        status: "ok", or the kind of failure; ``reason``, ``stage``, ``iteration`` and ``log_tail`` detail it.
        cause: id of the failed job without which this one could not run.
        peak_host_bytes: VmHWM of the process (of the timed part for measure).
        peak_device_bytes: the same of the device.
    """

    schema_version: Count = SCHEMA
    job: AnyJob
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
    result: SerializeAsAny[Result] | None = None

    @model_validator(mode="before")
    @classmethod
    def _by_kind(cls, data: Any) -> Any:
        """The result is stored under the name of its kind."""
        if not isinstance(data, dict):
            return data
        job = data.get("job")
        kind = job.kind if isinstance(job, Job) else job.get("kind") if isinstance(job, dict) else None
        if not isinstance(kind, str) or kind not in KINDS:
            return data
        data = {name: value for name, value in data.items() if name not in KINDS or value is not None}
        result = data.pop(kind, data.pop("result", None))
        if result is not None:
            own = kind_of(kind).result_type
            data["result"] = result if isinstance(result, own) else _validated(own, result)
        return data

    @model_serializer(mode="wrap")
    def _stored(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data: dict[str, Any] = handler(self)
        result = data.pop("result", None)
        return data if result is None else {**data, self.job.kind: result}

    @property
    def ok(self) -> bool:
        return self.status == "ok"

    def of(self, kind: type[R]) -> R | None:
        """The result, if it is of this class."""
        return self.result if isinstance(self.result, kind) else None


R = TypeVar("R", bound=Result)


def derived_seed(purpose: str, *axes: object) -> int:
    """A seed in [0, 2^31) for one source of randomness, from the axes it may depend on."""
    digest = hashlib.sha256("\x1f".join([purpose, *map(str, axes)]).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1
