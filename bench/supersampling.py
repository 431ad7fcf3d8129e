"""Models that draw a pixel as the mean over several points of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from methods.options import SAMPLES

if TYPE_CHECKING:
    from bench.records import Job
    from datasets.camera import Camera
    from methods.interface import Model


def drawn_as(job: Job, model: Model) -> Any:
    """The model as a measurement draws it."""
    samples = int(job.overrides.get(SAMPLES, 1))
    return model if samples == 1 else Supersampled(model, math.isqrt(samples))


class Supersampled:
    """A :class:`methods.interface.Model` whose pixels are means over k x k of a larger picture.

    Args:
        model: draws the larger picture; all that is not about drawing is its own.
        k: factor on width and height.
    """

    def __init__(self, model: Model, k: int) -> None:
        self._model, self._k = model, k

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def render(self, camera: Camera, **request: Any) -> tuple[Any, Any]:
        """Color (height, width, 3) and alpha (height, width), as the model's own ``render`` has them."""
        rgb, alpha = self._model.render(self._larger(camera), **request)
        return self._means(rgb, camera), self._means(alpha, camera)

    def timings(self, camera: Camera, scenes: Sequence[str] | None = None) -> Mapping[str, float]:
        """Seconds of one frame by part."""
        return self._model.timings(self._larger(camera), scenes=scenes)

    def _larger(self, camera: Camera) -> Camera:
        return camera.resized(self._k * camera.width, self._k * camera.height)

    def _means(self, picture: Any, camera: Camera) -> Any:
        shape = (camera.height, self._k, camera.width, self._k, *picture.shape[2:])
        return picture.reshape(shape).mean((1, 3))
