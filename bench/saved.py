"""Models of a run store, loaded from their files and rendered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from econgs_bench.bench.store.store import Store, folder_bytes
from econgs_bench.datasets.errors import DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from econgs_bench.bench.jobs.truth import Truth
    from econgs_bench.bench.store.records import Job, Record
    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.edits import Edit
    from econgs_bench.datasets.scene import RGB
    from econgs_bench.datasets.views import Split
    from econgs_bench.methods.interface import Model


def load(
    store: Store, job_id: str, plugins: Sequence[str] = (), device: str = "cpu"
) -> tuple[str, tuple[str, ...], int, Model]:
    """Method, basic scenes, bytes of all its groups and model of a finished encode or measure job.

    Raises:
        DataError: there is no such job, or its method refuses to compose its groups or the device.
    """
    from econgs_bench.bench.jobs.measure import load_models
    from econgs_bench.bench.jobs.method import MethodJob
    from econgs_bench.bench.jobs.supersampling import drawer_of, drawn_as
    from econgs_bench.bench.machine.device import prepare_device
    from econgs_bench.methods.interface import Refused
    from econgs_bench.methods.registry import Registry, load_method

    record = store.record(job_id)
    encodes = _encodes(store, job_id)
    if record is None or not encodes or not isinstance(record.job, MethodJob):
        raise DataError(
            job_id,
            f"is no finished encode or measure job of {store.root}",
            "`bench results` names the jobs in its column `job`",
        )
    registry, name = Registry(plugins), record.job.method
    if name not in registry.names() and name not in registry.broken:
        reason = f"is a model of the method {name}, which is not there"
        raise DataError(job_id, reason, "Give the folder of its plugin (--plugins DIR)")
    spec = registry.spec(name)
    folders = [_model(store, encode) for encode in encodes]
    try:
        prepare_device(device, spec)
        loaded = drawer_of(record.job, load_models(load_method(spec), folders, device))
        model = drawn_as(record.job, loaded)
    except Refused as error:
        raise DataError(job_id, str(error), "Render another model, or on another device") from error
    return spec.name, record.job.scenes, sum(map(folder_bytes, folders)), model


def bytes_of(store: Store, job_id: str, scene: str) -> int:
    """Bytes of the groups of a finished encode or measure job that hold a basic scene."""
    return sum(
        folder_bytes(_model(store, encode))
        for encode in _encodes(store, job_id)
        if scene in encode.job.scenes
    )


def _encodes(store: Store, job_id: str) -> list[Record]:
    """The records of a model's groups; none where one is not finished."""
    record = store.record(job_id)
    needs = record.job.needs if record is not None and record.job.kind == "measure" else (job_id,)
    encodes = [store.record(need) for need in needs if need.startswith("encode-")]
    finished = [encode for encode in encodes if encode is not None and encode.ok]
    return finished if len(finished) == len(encodes) else []


def _model(store: Store, encode: Record) -> Path:
    return store.jobs / encode.job.id / "model"


def truth_of(store: Store, job_id: str, scene: str) -> tuple[Record, Truth]:
    """The views job of a basic scene that a job builds on, and what it stored.

    Raises:
        DataError: they are not in the store.
    """
    from econgs_bench.bench.jobs.truth import Truth

    waiting, seen = [job_id], set()
    while waiting:
        record = store.record(waiting.pop())
        if record is None or record.job.id in seen:
            continue
        seen.add(record.job.id)
        job = record.job
        if job.kind == "views" and job.subject == scene and not (job.edit or job.composition):
            return record, Truth(store.jobs / job.id)
        waiting += job.needs
    raise DataError(job_id, f"the store lacks the training views of {scene}", "Use the store that it ran in")


def seen(store: Store, job_id: str, scene: str) -> tuple[Sequence[Camera], RGB, Truth, Split]:
    """Training cameras of a job's fit, background and views of a scene, and the split that is measured.

    Raises:
        DataError: they are not in the store.
    """
    record, truth = truth_of(store, job_id, scene)
    split: Split = "train" if record.job.split == "val" else "trainval"
    return truth.cameras(split), truth.scene().background, truth, measured_split(record.job)


def measured_split(job: Job) -> Split:
    """The views that a job is measured on: "test", or "val" of a store that keeps its test views closed."""
    return "val" if job.split == "val" else "test"


def pictures(
    model: Model,
    cameras: Sequence[Camera],
    scenes: list[str],
    edit: Mapping[str, Edit],
    background: RGB | None,
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32] | None]]:
    """RGB and alpha of views; those that another program draws come from one process, perhaps without alpha.

    Raises:
        DataError: the method refuses the edit or the composition, or its program fails.
    """
    from econgs_bench.methods.interface import DrawsTogether, Refused

    if not isinstance(model, DrawsTogether):
        yield from (picture(model, camera, scenes, edit, background) for camera in cameras)
        return
    try:
        drawn = model.draw_all(cameras, scenes, edit, background)
    except Refused as error:
        raise DataError("these pictures", str(error), "Leave out what this method refuses") from error
    yield from (drawn[index] for index in range(len(cameras)))


def picture(
    model: Model, camera: Camera, scenes: list[str], edit: Mapping[str, Edit], background: RGB | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """RGB (height, width, 3) and alpha (height, width) of one view.

    Raises:
        DataError: the method refuses the edit or the composition.
    """
    from econgs_bench.bench.jobs.monitor import as_numpy
    from econgs_bench.methods.interface import Refused

    try:
        rgb, alpha = model.render(camera, scenes=scenes, edit=edit, background=background)
    except Refused as error:
        raise DataError("this picture", str(error), "Leave out what this method refuses") from error
    return as_numpy(rgb), as_numpy(alpha)
