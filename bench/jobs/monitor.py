"""The monitor of a fit: training clock, anytime evaluations, checkpoints, and the request to stop."""

from __future__ import annotations

import json
import math
import resource
import shutil
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from econgs_bench.bench.jobs.checkpoints import Damaged, read_checkpoint, write_checkpoint
from econgs_bench.bench.jobs.losses import LossCurve
from econgs_bench.bench.machine.timing import amid_seconds, worst_of
from econgs_bench.bench.metrics.image import Pair, psnr, to_8bit
from econgs_bench.bench.store.records import CurvePoint
from econgs_bench.datasets.views import ViewSet
from econgs_bench.methods.interface import Checkpoint, Diverged, EstimatesBytes, Model

CHECKPOINT_SECONDS = 30.0
CURVE_POINTS = 8
LAP_SECONDS = 2.0
"""Least time between two runs of the reference kernel amid a fit."""
REPORT_SECONDS = 0.5


class Stopped(BaseException):
    """The job stops on request; it can continue from its last checkpoint."""


class Stop:
    """The request to stop, by SIGTERM or SIGINT: a fit ends at its next checkpoint, any other job at once."""

    def __init__(self) -> None:
        self.requested = threading.Event()
        self.deferred = False

    def install(self) -> None:
        """Handle the signals; call from the main thread."""
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, self._handle)

    def _handle(self, number: int, frame: Any) -> None:
        self.requested.set()
        if not self.deferred:
            raise Stopped


class Progress:
    """Appends states to ``progress.jsonl``, which the executor shows."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8", buffering=1)

    def __call__(self, **state: Any) -> None:
        self._file.write(json.dumps({"time": time.time(), **state}) + "\n")


class FitMonitor:
    """Implements :class:`.methods.interface.Monitor`.

    The clocks of training (wall and processor time) run from :meth:`start` to :meth:`stop`, except inside
    :meth:`pause`; there the reference kernel runs. Moments of evaluation are even over the logarithm of the
    iteration; a checkpoint is written every 30 s, at the last iteration and on the request to stop.

    Args:
        folder: where checkpoints go.
        iterations: the budget.
        views: scene -> the views of anytime evaluations. No method trains on them.
        report: takes progress.
        stop: the request to end early.
        every: seconds between checkpoints.
        kernel: seconds of the reference kernel, which runs where the clock stands; None where there is none.

    Attributes:
        seconds: training time up to the last stop.
        cpu_seconds: processor time of all threads in the same time.
        losses: of all iterations so far.
        reference_worst: the longest of the kernel's times so far; None without any.
        final: whether the last iteration is stored.
    """

    def __init__(
        self,
        folder: Path,
        iterations: int,
        views: Mapping[str, ViewSet],
        report: Callable[..., None],
        stop: Stop,
        every: float = CHECKPOINT_SECONDS,
        kernel: Callable[[], float | None] = amid_seconds,
    ) -> None:
        self._folder = folder
        self._iterations = iterations
        self._views = views
        self._truth = {
            scene: [to_8bit(one.composited(index)) for index in range(len(one))]
            for scene, one in views.items()
        }
        self._report = report
        self._stop = stop
        self._every = every
        self._kernel = kernel
        self._moments = _moments(iterations)
        self._since: tuple[float, float] | None = None
        self._loss: float | None = None
        self._parts: dict[str, float] = {}
        self._primitives = 0
        self._psnr: float | None = None
        self._stage = "fit"
        self._reported = 0.0
        self._stored = self._lapped = time.monotonic()
        self._speed: tuple[int, float] | None = None
        self.curve: list[CurvePoint] = []
        self.losses = LossCurve(iterations)
        self.seconds = self.cpu_seconds = 0.0
        self.reference_worst: float | None = None
        self.resumed = 0
        self.iteration = 0
        self.final = False

    # ------------------------------------------------------------------ the harness's side

    def resume(self) -> Checkpoint | None:
        """Continue clock and curve from the newest checkpoint, if there is one, and return it.

        After a damaged one, which is removed, the fit begins anew.
        """
        try:
            stored = read_checkpoint(self._folder)
        except Damaged as error:
            print(f"bench: {error.what}: {error.reason}: the fit begins anew", flush=True)
            shutil.rmtree(self._folder)
            return None
        if stored is None:
            return None
        checkpoint, harness = stored
        self.seconds, self.cpu_seconds = harness["seconds"], harness["cpu_seconds"]
        self.reference_worst = harness.get("reference_worst")
        self.curve = [CurvePoint.model_validate(point) for point in harness["curve"]]
        self.losses.resume(harness["losses"])
        self.resumed = harness["resumed"] + 1
        self.iteration = checkpoint.iteration
        self.final = checkpoint.iteration >= self._iterations
        self._moments = [m for m in self._moments if m > checkpoint.iteration]
        return checkpoint

    def start(self) -> None:
        """Let the training clock run."""
        self._since = time.perf_counter(), _cpu_seconds()

    def stop(self) -> None:
        """Halt the training clock."""
        if self._since is not None:
            wall, cpu = self._since
            self.seconds += time.perf_counter() - wall
            self.cpu_seconds += _cpu_seconds() - cpu
            self._since = None

    # ------------------------------------------------------------------ the method's side

    def stage(self, name: str) -> None:
        self._stage = name
        self._report_state(force=True)

    def progress(self, iteration: int, losses: Mapping[str, float], primitives: int) -> None:
        self.iteration, self._primitives = iteration, primitives
        if losses:
            total = losses.get("loss", sum(losses.values()))
            if not math.isfinite(total):
                values = ", ".join(f"{name} = {value}" for name, value in losses.items())
                raise Diverged(f"loss is not finite at iteration {iteration}: {values}")
            self._loss = total
            self._parts = {name: float(value) for name, value in losses.items() if name != "loss"}
            self.losses.add(iteration, self._stage, {"loss": total, **self._parts})
        self._report_state()

    def due(self, iteration: int) -> bool:
        return (
            self._stop.requested.is_set()
            or iteration >= self._iterations
            or bool(self._moments and iteration >= self._moments[0])
            or time.monotonic() - self._stored >= self._every
        )

    def pause(self, iteration: int, model: Callable[[], Model], checkpoint: Callable[[], Checkpoint]) -> None:
        self.stop()
        try:
            self.iteration = iteration
            self._lap()
            if self._moments and iteration >= self._moments[0]:
                self._evaluate(iteration, model())
                self._moments = [m for m in self._moments if m > iteration]
            ended = iteration >= self._iterations
            stopping = self._stop.requested.is_set()
            if ended or stopping or time.monotonic() - self._stored >= self._every:
                self._write(checkpoint())
                self.final = ended
            if stopping and not ended:
                raise Stopped
        finally:
            self.start()

    # ------------------------------------------------------------------ inside

    def _lap(self) -> None:
        """Run the reference kernel, if it did not run just now."""
        if time.monotonic() - self._lapped >= LAP_SECONDS:
            self.reference_worst = worst_of([self.reference_worst, self._kernel()])
            self._lapped = time.monotonic()

    def _write(self, checkpoint: Checkpoint) -> None:
        harness = {
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "reference_worst": self.reference_worst,
            "curve": [point.model_dump() for point in self.curve],
            "losses": self.losses.state(),
            "resumed": self.resumed,
        }
        write_checkpoint(self._folder, checkpoint, harness)
        self._stored = time.monotonic()
        self._report(
            stage=self._stage, iteration=checkpoint.iteration, iterations=self._iterations, stored=True
        )

    def _evaluate(self, iteration: int, model: Model) -> None:
        means = {
            scene: float(np.mean([self._psnr_of(model, scene, index) for index in range(len(views))]))
            for scene, views in self._views.items()
        }
        self._psnr = float(np.mean(list(means.values()))) if means else None
        self._primitives = model.primitives()
        size = model.bytes_estimate() if isinstance(model, EstimatesBytes) else None
        self.curve.append(
            CurvePoint(
                iteration=iteration,
                train_seconds=self.seconds,
                loss=self._loss,
                psnr=means,
                primitives=self._primitives,
                bytes_estimate=size,
                loss_parts=self._parts,
            )
        )
        self._report_state(force=True)

    def _psnr_of(self, model: Model, scene: str, index: int) -> float:
        """The metric ``psnr`` of one view; NaN where the model renders values that are not finite."""
        views = self._views[scene]
        image, _ = model.render(views.cameras[index], scenes=[scene], background=views.background)
        rgb = as_numpy(image)
        if not np.isfinite(rgb).all():
            return math.nan
        return psnr(Pair(self._truth[scene][index], to_8bit(rgb), None))

    def _report_state(self, force: bool = False) -> None:
        now = time.monotonic()
        if not force and now - self._reported < REPORT_SECONDS:
            return
        left = None
        if self._speed is not None and self.iteration > self._speed[0]:
            first, begin = self._speed
            left = (self._iterations - self.iteration) * (now - begin) / (self.iteration - first)
        elif self._speed is None and self.iteration:
            self._speed = (self.iteration, now)
        self._reported = now
        self._report(
            stage=self._stage,
            iteration=self.iteration,
            iterations=self._iterations,
            loss=self._loss,
            parts=self._parts,
            psnr=self._psnr,
            primitives=self._primitives,
            left=left,
        )


def _cpu_seconds() -> float:
    """Processor time of this process, and of the programs that it ran to their end."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


def as_numpy(array: Any) -> Any:
    """A tensor (or array) as a numpy array on the host."""
    return array.detach().cpu().numpy() if hasattr(array, "detach") else np.asarray(array)


def _moments(iterations: int) -> list[int]:
    """About eight iterations, evenly spread over the logarithm between 2 % and 100 % of the budget."""
    first = max(1, iterations // 50)
    return sorted({round(m) for m in np.geomspace(first, iterations, CURVE_POINTS)})
