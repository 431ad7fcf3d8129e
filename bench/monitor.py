"""What a fit reports to: the training clock, anytime evaluations, checkpoints, and the way to stop it."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.checkpoints import read_checkpoint, write_checkpoint
from bench.losses import LossCurve
from bench.metrics.image import Pair, psnr, to_8bit
from bench.records import CurvePoint, LossPoint
from datasets.views import ViewSet
from methods.interface import Checkpoint, Diverged, EstimatesBytes, Model

CHECKPOINT_SECONDS = 30.0
CURVE_POINTS = 8
REPORT_SECONDS = 0.5


class Stopped(BaseException):
    """The job was asked to stop and has stored what it can continue from."""


class Stop:
    """Set by SIGTERM (or SIGINT): a fit then ends at its next checkpoint, any other job at once."""

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
    """Implements :class:`methods.interface.Monitor`.

    The clocks of training (wall and processor time) run from :meth:`start` to :meth:`stop` and stand still
    inside :meth:`pause`.
    Anytime evaluations take place at moments spread evenly over the logarithm of the iteration; a checkpoint
    is written every 30 s, at the last iteration and when the job is asked to stop.

    Args:
        folder: where checkpoints go.
        iterations: the budget.
        held_out: scene -> the views of anytime evaluations. None of them is trained on.
        report: takes progress.
        stop: says when to end early.
        every: seconds between checkpoints.
    """

    def __init__(
        self,
        folder: Path,
        iterations: int,
        held_out: Mapping[str, ViewSet],
        report: Callable[..., None],
        stop: Stop,
        every: float = CHECKPOINT_SECONDS,
    ) -> None:
        self._folder = folder
        self._iterations = iterations
        self._views = held_out
        self._report = report
        self._stop = stop
        self._every = every
        self._moments = _moments(iterations)
        self._clock = 0.0
        self._cpu_clock: float | None = 0.0
        self._since: tuple[float, float] | None = None
        self._loss: float | None = None
        self._parts: dict[str, float] = {}
        self._primitives = 0
        self._psnr: float | None = None
        self._stage = "fit"
        self._reported = 0.0
        self._stored = time.monotonic()
        self._speed: tuple[int, float] | None = None
        self.curve: list[CurvePoint] = []
        self._losses = LossCurve(iterations)
        self.resumed = 0
        self.iteration = 0
        self.final = False

    # ------------------------------------------------------------------ the harness's side

    def resume(self) -> Checkpoint | None:
        """Continue clock and curve from the newest checkpoint, if there is one, and return it."""
        found = read_checkpoint(self._folder)
        if found is None:
            return None
        checkpoint, harness = found
        self._clock = harness["seconds"]
        self._cpu_clock = harness.get("cpu_seconds")  # checkpoints of older versions have none
        self.curve = [CurvePoint.model_validate(point) for point in harness["curve"]]
        if "losses" in harness:  # checkpoints of older versions have none
            self._losses.resume(harness["losses"])
        self.resumed = harness["resumed"] + 1
        self.iteration = checkpoint.iteration
        self.final = checkpoint.iteration >= self._iterations
        self._moments = [m for m in self._moments if m > checkpoint.iteration]
        return checkpoint

    def start(self) -> None:
        self._since = time.perf_counter(), time.process_time()

    def stop(self) -> None:
        if self._since is not None:
            wall, cpu = self._since
            self._clock += time.perf_counter() - wall
            if self._cpu_clock is not None:
                self._cpu_clock += time.process_time() - cpu
            self._since = None

    @property
    def seconds(self) -> float:
        """Training time up to the last stop."""
        return self._clock

    @property
    def cpu_seconds(self) -> float | None:
        """Processor time of all threads in the same time; None where part of it is not known."""
        return self._cpu_clock

    @property
    def losses(self) -> list[LossPoint]:
        """Of all iterations so far."""
        return self._losses.points

    # ------------------------------------------------------------------ the method's side

    def stage(self, name: str) -> None:
        self._stage = name
        self._tell(force=True)

    def progress(self, iteration: int, losses: Mapping[str, float], primitives: int) -> None:
        self.iteration, self._primitives = iteration, primitives
        total = losses.get("loss", sum(losses.values())) if losses else None
        if total is not None and not math.isfinite(total):
            named = ", ".join(f"{name} = {value}" for name, value in losses.items())
            raise Diverged(f"loss is not finite at iteration {iteration}: {named}")
        self._loss = total
        self._parts = {name: float(value) for name, value in losses.items() if name != "loss"}
        if total is not None:
            self._losses.add(iteration, self._stage, {"loss": total, **self._parts})
        self._tell()

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

    def _write(self, checkpoint: Checkpoint) -> None:
        harness = {
            "seconds": self._clock,
            "cpu_seconds": self._cpu_clock,
            "curve": [point.model_dump() for point in self.curve],
            "losses": self._losses.state(),
            "resumed": self.resumed,
        }
        write_checkpoint(self._folder, checkpoint, harness)
        self._stored = time.monotonic()
        self._report(
            stage=self._stage, iteration=checkpoint.iteration, iterations=self._iterations, stored=True
        )

    def _evaluate(self, iteration: int, model: Model) -> None:
        found = {
            scene: float(np.mean([_psnr(model, scene, views, i) for i in range(len(views))]))
            for scene, views in self._views.items()
        }
        self._psnr = float(np.mean(list(found.values()))) if found else None
        self._primitives = model.primitives()
        size = model.bytes_estimate() if isinstance(model, EstimatesBytes) else None
        self.curve.append(
            CurvePoint(
                iteration=iteration,
                train_seconds=self._clock,
                loss=self._loss,
                psnr=found,
                primitives=self._primitives,
                bytes_estimate=size,
                loss_parts=self._parts,
            )
        )
        self._tell(force=True)

    def _tell(self, force: bool = False) -> None:
        now = time.monotonic()
        if not force and now - self._reported < REPORT_SECONDS:
            return
        left = None
        if self._speed is not None and self.iteration > self._speed[0]:
            left = (
                (self._iterations - self.iteration)
                * (now - self._speed[1])
                / (self.iteration - self._speed[0])
            )
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


def as_numpy(array: Any) -> Any:
    """A tensor (or array) as a numpy array on the host."""
    return array.detach().cpu().numpy() if hasattr(array, "detach") else np.asarray(array)


def _moments(iterations: int) -> list[int]:
    """About eight iterations, evenly spread over the logarithm between 2 % and 100 % of the budget."""
    first = max(1, iterations // 50)
    return sorted({round(m) for m in np.geomspace(first, iterations, CURVE_POINTS)})


def _psnr(model: Model, scene: str, views: ViewSet, index: int) -> float:
    """The metric ``psnr`` of one view; NaN where the model renders values that are not finite."""
    rendered, _ = model.render(views.cameras[index], scenes=[scene], background=views.background)
    rgb = as_numpy(rendered)
    if not np.isfinite(rgb).all():
        return math.nan
    return psnr(Pair(to_8bit(views.composited(index)), to_8bit(rgb), None))
