"""Models that draw a pixel as the mean over several points of it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from econgs_bench.bench.machine.timing import synchronise
from econgs_bench.methods.interface import DrawnHere
from econgs_bench.methods.options import DRAWN, SAMPLES

if TYPE_CHECKING:
    from econgs_bench.bench.jobs.method import MethodJob
    from econgs_bench.datasets.camera import Camera
    from econgs_bench.datasets.edits import Edit
    from econgs_bench.datasets.scene import RGB
    from econgs_bench.methods.interface import Model


def drawer_of(job: MethodJob, model: Model) -> Model:
    """A loaded model, or its Gaussians drawn here where its own program draws it otherwise.

    Raises:
        DataError: its Gaussians cannot be read.
    """
    return (
        model.drawn_here() if job.overrides.get(DRAWN) == "here" and isinstance(model, DrawnHere) else model
    )


def drawn_as(job: MethodJob, model: Model) -> Model:
    """The model as a measurement draws it: itself, or as means over pixels."""
    samples = int(job.overrides.get(SAMPLES, 1))
    return model if samples == 1 else Supersampled(model, math.isqrt(samples), job.device)


class Supersampled:
    """A :class:`.methods.interface.Model` whose pixels are means over k x k of a larger picture.

    It draws; what a model can do beside that, such as ``decoding``, is asked of the model itself.

    Args:
        model: draws the larger picture, on a background of one color, so that means are those of
            premultiplied colors.
        k: factor on width and height.
        device: on which it draws.
    """

    def __init__(self, model: Model, k: int, device: str = "cpu") -> None:
        self._model, self._k, self._device = model, k, device
        self._drawn: dict[tuple[int, int], tuple[Any, Any]] = {}

    @property
    def scenes(self) -> tuple[str, ...]:
        """Those of the model."""
        return self._model.scenes

    def primitives(self, scene: str | None = None) -> int:
        """Those of the model."""
        return self._model.primitives(scene)

    def save(self, folder: Path, rate: float | None = None) -> Mapping[str, Mapping[str, int]]:
        """Write the model, which is the same however it is drawn."""
        return self._model.save(folder, rate)

    def render(
        self,
        camera: Camera,
        scenes: Sequence[str] | None = None,
        edit: Mapping[str, Edit] | None = None,
        background: RGB | None = None,
    ) -> tuple[Any, Any]:
        """Color (height, width, 3) and alpha (height, width), as the model's own ``render`` has them."""
        rgb, alpha = self._model.render(self._larger(camera), scenes, edit, background)
        return self._means(rgb, camera), self._means(alpha, camera)

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame by part: those of the larger picture, and ``average``."""
        larger = self._larger(camera)
        parts = self._model.timings(larger, scenes)
        size = larger.width, larger.height
        if size not in self._drawn:  # any picture of that size takes as long to average
            self._drawn = {size: self._model.render(larger, scenes)}
        synchronise(self._device)
        start = time.perf_counter()
        for channels in self._drawn[size]:
            self._means(channels, camera)
        synchronise(self._device)
        return {**parts, "average": time.perf_counter() - start}

    def _larger(self, camera: Camera) -> Camera:
        return camera.resized(self._k * camera.width, self._k * camera.height)

    def _means(self, picture: Any, camera: Camera) -> Any:
        shape = (camera.height, self._k, camera.width, self._k, *picture.shape[2:])
        return picture.reshape(shape).mean((1, 3))
