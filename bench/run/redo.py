"""Models of a bundle decoded and measured anew: the part of `bench verify` that no invented figure passes.

The SHA-256 of the bundle decides which models and views are drawn: who changes a figure changes the draw. The
truth is rendered or read anew from a dataset with the recorded content. Each model is decoded in a process of
its own, under the limits of jobs (:mod:`.bench.run.limits`), which holds one model and the pictures of a few
views. ``python -m econgs_bench.bench.run.redo FOLDER`` is that process.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from econgs_bench.bench.jobs.measure import Measure, MeasureResult
from econgs_bench.bench.jobs.supersampling import drawer_of, drawn_as
from econgs_bench.bench.jobs.views import ViewsResult
from econgs_bench.bench.machine.timing import available_cores
from econgs_bench.bench.metrics import METRICS
from econgs_bench.bench.plan.estimates import Past
from econgs_bench.bench.run.limits import Limit, Limits, memory_reason, time_reason, used_memory
from econgs_bench.bench.run.processes import Processes, end_session
from econgs_bench.bench.run.runner import Runner
from econgs_bench.bench.store.progress import log_tail
from econgs_bench.bench.store.records import Job, Record
from econgs_bench.bench.store.store import Store, read_record, write_text
from econgs_bench.bench.suites.stress import stress_of
from econgs_bench.datasets.catalogue import open_dataset
from econgs_bench.datasets.catalogue.entries import built_in, members
from econgs_bench.datasets.content import content
from econgs_bench.datasets.errors import DataError, text_of
from econgs_bench.datasets.scene import Dataset
from econgs_bench.datasets.units import camera_in_units
from econgs_bench.methods.interface import DrawsTogether, Refused
from econgs_bench.methods.registry import Registry
from econgs_bench.methods.shared.decoders import decode_here

VIEWS = 4
"""Views of each model that are drawn."""
TOLERANCE = 1e-3
"""Largest difference that is none: dB of PSNR, or part of another metric (of SSIM: of 1 - SSIM).

The gate counts the same as equal. Between this core's instruction sets, a few values round to the next step
of 8 bits: up to 1e-5 dB and 2e-5 of other metrics, over five methods of `quick` at 128 x 128.
"""
_POLL_SECONDS = 0.1
_REQUEST, _ANSWER = "redo.json", "answer.json"


@dataclass
class Redone:
    """What became of the models that were drawn.

    Attributes:
        problems: one line for each number that is another.
        unverified: one line for each model that could not be measured here, with the reason.
        views: job -> names of its views that were compared.
    """

    problems: list[str] = field(default_factory=list)
    unverified: list[str] = field(default_factory=list)
    views: dict[str, list[str]] = field(default_factory=dict)


def redo(
    store: Store,
    bundle: Path,
    count: int,
    *,
    datasets: Sequence[str] = (),
    plugins: Sequence[str] = (),
    limits: Limits | None = None,
) -> Redone:
    """Measure some models of a bundle anew.

    Args:
        store: the unpacked bundle; it gets the truth.
        bundle: the file.
        count: number of models, or all that there are.
        datasets: paths of data that the catalogue lacks. The paths that the bundle names are not opened.
        plugins: folders with methods.
        limits: of each process.

    Raises:
        DataError: the bundle holds no model, or a dataset cannot be used.
    """
    with bundle.open("rb") as file:
        draw = Draw(hashlib.file_digest(file, "sha256").hexdigest())
    chosen = draw.models(store, count)
    if not chosen:
        raise DataError(bundle, "holds no measured model", "Make it with `bench bundle --models`")
    given = {name: open_dataset(name) for name in datasets}
    redone, here = Redone(), _Here(store, given, tuple(plugins), limits or Limits())
    for record in chosen:
        places, measured = draw.views(record), _measured(record)
        try:
            here.check_method(record)
            here.truth(record)
            answer = here.measure(record, places)
        except DataError as error:
            redone.unverified.append(f"{record.job.id}: {error}")
            continue
        if "error" in answer:
            redone.problems.append(f"{record.job.id}: its model cannot be measured: {answer['error']}")
            continue
        redone.problems += (f"{record.job.id}: {line}" for line in differences(record, places, answer))
        for name, reason in answer["missing"].items():
            if measured.metrics.get(name) is not None:
                redone.unverified.append(f"{record.job.id}: {name} cannot be computed here: {reason}")
        redone.views[record.job.id] = [measured.views[place].view for place in places]
    return redone


@dataclass(frozen=True)
class Draw:
    """Choices that follow from the hash of a bundle alone."""

    digest: str

    def models(self, store: Store, count: int) -> list[Record]:
        """A measurement of each of some models whose files are there, all of different models."""

        def whole(record: Record) -> bool:
            encodes = [name for name in record.job.needs if name.startswith("encode-")]
            return record.result is not None and all((store.jobs / n / "model").is_dir() for n in encodes)

        # Names alone are held, and no cache of the store: a record may be large.
        records = map(read_record, store.jobs.glob("measure-*/record.json"))
        names = sorted((record.job.id for record in records if whole(record)), key=self._rank)
        chosen: list[Record] = []
        used: set[str] = set()
        for name in names:
            record = store.record(name)
            assert record is not None
            encodes = {need for need in record.job.needs if need.startswith("encode-")}
            if len(chosen) < count and not encodes <= used:
                used |= encodes
                chosen.append(record)
        return chosen

    def views(self, record: Record) -> list[int]:
        """Positions of some of its views, in order."""
        places = range(len(_measured(record).views))
        return sorted(sorted(places, key=lambda place: self._rank(record.job.id, place))[:VIEWS])

    def _rank(self, *axes: object) -> str:
        return hashlib.sha256("\x1f".join([self.digest, *map(str, axes)]).encode()).hexdigest()


@dataclass
class _Here:
    """What this machine has: data, methods and limits."""

    store: Store
    given: dict[str, Dataset]
    plugins: tuple[str, ...]
    limits: Limits

    @cached_property
    def registry(self) -> Registry:
        """The methods."""
        return Registry(self.plugins)

    def check_method(self, record: Record) -> None:
        """Check that the method that made a model is here.

        Raises:
            DataError: it is not, or has another version.
        """
        spec = self.registry.spec(_job(record).method)
        encodes = [need for need in record.job.needs if need.startswith("encode-")]
        fits = [fit for name in encodes if (one := self.store.record(name)) for fit in one.job.needs]
        for fit in filter(None, map(self.store.record, fits)):
            if fit.job.identity.get("method") != [spec.name, spec.version]:
                made = fit.job.identity.get("method")
                commit = fit.provenance.commit if fit.provenance is not None else None
                reason = f"made its model in version {made[-1] if made else '?'}, and here is {spec.version}"
                raise DataError(f"{spec.name}", reason, f"Verify it with the program of commit {commit}")

    def truth(self, record: Record) -> None:
        """Render or read the truth of a measurement into the store, unless it is there.

        Raises:
            DataError: no dataset here has the recorded content, or its views are others.
        """
        name = next(need for need in record.job.needs if need.startswith("views-"))
        stored = self.store.record(name)
        before = stored.of(ViewsResult) if stored is not None else None
        if stored is None or before is None:
            raise DataError(name, "is not in the bundle", "Bundle the whole run store")
        if self.store.holds_files_of(stored):
            return
        job = stored.job.model_copy(update={"dataset": self._source(stored.job)})
        with Runner(
            self.store, self.registry, self.limits.bytes(), plugins=self.plugins, threads=available_cores(),
            stops=lambda: 0, show=lambda job, state: None,
        ) as runner:  # fmt: skip
            limit = self.limits.time(job, Past([]), None)
            made, note = runner.run(job, limit)
        after = made.of(ViewsResult) if made is not None else None
        if made is None or after is None or not self.store.holds_files_of(made):
            reason = note or log_tail(self.store.partial / name) or "no reason is known"
            raise DataError(name, f"its views cannot be made here ({reason})", "Make them on another machine")
        if after.view_keys.get(job.split) != before.view_keys.get(job.split):
            was, now = (_renderer(one, job.split) for one in (before, after))
            reason = f"its views are others: rendered by {was}, here by {now}"
            raise DataError(name, reason, "Use the renderer that made them")

    def _source(self, job: Job) -> str:
        """Name or path of a dataset whose scene has the content of a views job."""
        known = all(part in built_in() for part in members(job.dataset))
        sources = dict(self.given)
        reasons = []
        if known:
            try:
                sources = {job.dataset: open_dataset(job.dataset), **sources}
            except DataError as error:
                reasons.append(str(error))
        for name, dataset in sources.items():
            try:
                found = content(dataset, job.scenes, composed=bool(job.composition))
            except DataError as error:  # it has no such scene, or its files are gone
                reasons.append(str(error))
                continue
            if found == job.identity.get("scene"):
                return name
            reasons.append(f"{name} has another content ({found}, not {job.identity.get('scene')})")
        what = f"{job.dataset_name}/{job.subject}"
        if known:
            remedy = "Fetch or install the data, or name it with --dataset PATH"
        else:
            remedy = "Name it with --dataset PATH: a path in a bundle is not opened"
        raise DataError(what, f"the truth is not here ({'; '.join(reasons) or 'no dataset named'})", remedy)

    def measure(self, record: Record, places: Sequence[int]) -> dict[str, Any]:
        """The answer of a process that decodes the model; its only key is "error" if it failed.

        Raises:
            DataError: it reached a limit, or this machine lacks the model's device.
        """
        folder = self.store.partial / f"redo-{record.job.key}"
        folder.mkdir()
        request = {"job": record.job.id, "views": list(places), "plugins": self.plugins}
        write_text(folder / _REQUEST, json.dumps(request))
        spec = self.registry.spec(_job(record).method)
        code, reason = _run(folder, self.limits.time(record.job, Past([]), spec), self.limits.bytes())
        if reason:
            raise DataError(record.job.title, reason, "Verify on a larger machine, or with another limit")
        try:
            answer: dict[str, Any] = json.loads((folder / _ANSWER).read_text(encoding="utf-8"))
        except OSError:
            answer = {"error": f"its process ended with code {code}"}
        if "refused" in answer:
            raise DataError(record.job.title, answer["refused"], "Verify on a machine that can")
        return answer


def differences(record: Record, places: Sequence[int], answer: dict[str, Any]) -> Iterator[str]:
    """A line for each number of some views that is another than the recorded one."""
    measure = _measured(record)
    for place, again in zip(places, answer["views"], strict=True):
        view = measure.views[place]
        if view.view != again["view"]:
            yield f"view {place} is {view.view}, and {again['view']} in the truth"
        for name, value in again["metrics"].items():
            recorded = view.metrics.get(name)
            if not _equal(name, recorded, value) and name not in answer["missing"]:
                yield f"view {view.view}: {name} is {_text(recorded)}, measured again {_text(value)}"
    if measure.primitives != answer["primitives"]:
        yield f"has {measure.primitives} primitives, decoded again {answer['primitives']}"


def _measured(record: Record) -> MeasureResult:
    result = record.of(MeasureResult)
    assert result is not None
    return result


def _job(record: Record) -> Measure:
    assert isinstance(record.job, Measure)
    return record.job


def _equal(name: str, recorded: float | None, value: float | None) -> bool:
    if recorded is None or value is None:
        return recorded is value
    if name in ("psnr", "psnr_fg"):
        return abs(recorded - value) <= TOLERANCE
    size = 1.0 - recorded if name == "ssim" else recorded
    return abs(recorded - value) <= TOLERANCE * abs(size) + 1e-6


def _text(value: float | None) -> str:
    return "none" if value is None else f"{value:.7g}"


def _renderer(views: ViewsResult, split: str) -> str:
    cost = views.cost.get(split, {})
    return " ".join(str(cost[name]) for name in ("renderer", "version") if name in cost) or "another program"


def _run(folder: Path, limit: Limit, memory: Limit) -> tuple[int | None, str]:
    """Run the process of a folder to its end; returns its exit code, or why it was killed."""
    processes = Processes({**os.environ, "PYTHONSAFEPATH": "1"})
    with (folder / "log.txt").open("wb") as log, processes.adopting():
        process = processes.start(folder, log, "econgs_bench.bench.run.redo")
        start = time.monotonic()
        try:
            while True:
                try:
                    return process.wait(_POLL_SECONDS), ""
                except subprocess.TimeoutExpired:
                    pass
                if time.monotonic() - start > limit.amount:
                    return None, time_reason(limit)
                if (used := used_memory(process.pid, memory.amount)) > memory.amount:
                    return None, memory_reason(memory, used)
        finally:
            if process.poll() is None:
                end_session(process.pid)
                process.wait()


# --------------------------------------------------------------------------- the process


def main(folder: Path) -> int:
    """Answer the request in a folder."""
    decode_here()
    request = json.loads((folder / _REQUEST).read_text(encoding="utf-8"))
    try:
        answer = _again(Store(folder.parent.parent, checked=True), folder, request)
    except Refused as error:
        answer = {"refused": text_of(error)}
    except Exception as error:
        answer = {"error": f"{type(error).__name__}: {text_of(error)}"}
    write_text(folder / _ANSWER, json.dumps(answer))
    return 0


def _again(store: Store, folder: Path, request: dict[str, Any]) -> dict[str, Any]:
    from econgs_bench.bench.jobs import returned
    from econgs_bench.bench.jobs.context import Context
    from econgs_bench.bench.jobs.measure import load_models
    from econgs_bench.bench.jobs.monitor import Progress, Stop
    from econgs_bench.bench.machine.device import prepare_device
    from econgs_bench.bench.metrics import evaluate

    record = store.record(request["job"])
    assert record is not None
    job = _job(record)
    spec = Registry(request["plugins"], lenient=True).spec(job.method)
    prepare_device(job.device, spec)
    report = Progress(folder / "progress.jsonl")
    context = Context(job, folder, store, spec, available_cores(), Stop(), report)
    truth = context.truth(job.subject)
    units = stress_of(job.stress).get("units", 1.0)
    views = truth.views(job.split, request["views"])
    method, scenes = context.method(), list(job.rendered)
    folders = [context.path_of(one) / "model" for one in context.inputs("encode")]
    drawing = drawn_as(job, drawer_of(job, load_models(method, folders, job.device)))
    recorded = {name: job.metrics.get(name, "1") for name in _measured(record).metrics}
    names = [name for name, version in recorded.items() if _is_todays(name, version)]
    rows, missing = [], {name: "its version here is another" for name in recorded if name not in names}
    cameras = [camera_in_units(camera, units) for camera in views.cameras]
    own = None
    if isinstance(drawing, DrawsTogether):
        own = drawing.draw_all(cameras, scenes, job.edits, views.background)
    for index, camera in enumerate(cameras):
        if own is not None:
            rgb, alpha = own[index]
        else:
            answer = drawing.render(camera, scenes=scenes, edit=job.edits, background=views.background)
            rgb, alpha = returned.picture(answer, camera)
        values, reasons = evaluate(views.images[index], rgb, alpha, views.background, names)
        missing.update(reasons)
        rows.append({"view": camera.name or f"{request['views'][index]:04d}", "metrics": values})
    primitives = sum(returned.primitives(drawing.primitives(scene)) for scene in scenes)
    return {"views": rows, "missing": missing, "primitives": primitives}


def _is_todays(name: str, version: str) -> bool:
    return name in METRICS and METRICS[name].version == version


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
