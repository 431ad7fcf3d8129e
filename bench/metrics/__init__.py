"""Image quality metrics, each named and versioned. This module is import-light.

Metrics judge the picture as displayed: composited on the scene's background, clipped to [0, 1] and
rounded to 8 bit. PNG files hold color and alpha in 8 bit each and are composited after that rounding, so
PSNR from files is some hundredths of a decibel lower. Those of :data:`.reports.schema.COVERAGE` judge alpha,
rounded likewise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from econgs_bench.reports.schema import COLUMNS, Column

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from econgs_bench.datasets.scene import RGB


@dataclass(frozen=True)
class Metric:
    """A metric; its title, unit, direction and definition are those of its column.

    Attributes:
        name: identifier; column of the tables.
        version: raised when numbers may change; part of the measure key.
        bounds: least and greatest possible value.
    """

    name: str
    version: str
    bounds: tuple[float, float]

    @property
    def column(self) -> Column:
        """Declaration of its column."""
        return COLUMNS[self.name]


_INF = float("inf")
METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("psnr", "1", (0.0, 100.0)),
        Metric("psnr_fg", "1", (0.0, 100.0)),
        Metric("ssim", "1", (-1.0, 1.0)),
        Metric("lpips_vgg", "1", (0.0, _INF)),
        Metric("lpips_vgg01", "1", (0.0, _INF)),
        Metric("lpips_alex", "1", (0.0, _INF)),
        Metric("flip", "1", (0.0, 1.0)),
        Metric("delta_e_uv", "1", (0.0, _INF)),
        Metric("missing", "1", (0.0, 1.0)),
        Metric("excess", "1", (0.0, _INF)),
    )
}


class Scores(NamedTuple):
    """Metrics of one view.

    Attributes:
        values: metric -> value; None if it cannot be computed.
        reasons: metric -> why it is None.
    """

    values: dict[str, float | None]
    reasons: dict[str, str]


def evaluate(
    truth: NDArray[np.float32],
    rgb: NDArray[np.float32],
    alpha: NDArray[np.float32] | None,
    background: Sequence[float],
    names: Sequence[str] | None = None,
) -> Scores:
    """Compare one rendered view with the ground truth.

    Networks stay loaded from one call to the next.

    Args:
        truth: (height, width, 4) RGBA in [0, 1], premultiplied, background-free.
        rgb: (height, width, 3) rendered image, composited on ``background``.
        alpha: (height, width) rendered alpha in [0, 1]; None: that of a picture without any.
        background: RGB in [0, 1].
        names: metrics to compute; all of :data:`METRICS` if None.

    Raises:
        UnknownName: a name is no metric.
        ValueError: shapes differ or values are not finite.
    """
    from econgs_bench.bench.metrics.image import Pair, scores
    from econgs_bench.datasets.names import unknown

    names = list(METRICS) if names is None else list(names)
    for name in names:
        if name not in METRICS:
            raise unknown("metric", name, METRICS)
    return Scores(*scores(Pair.composite(truth, rgb, alpha, background), names))


def mean(values: Sequence[float | None]) -> float | None:
    """Mean over all views; None if any of them is missing (no average over an incomplete set)."""
    numbers = [value for value in values if value is not None]
    return math.fsum(numbers) / len(numbers) if numbers and len(numbers) == len(values) else None


def mean_scores(
    truths: Iterable[NDArray[np.float32]],
    images: Iterable[NDArray[np.float32]],
    background: RGB,
    names: Sequence[str],
) -> dict[str, float | None]:
    """Means of metrics over views of premultiplied pictures.

    Args:
        truths: (height, width, 4) RGBA in [0, 1], premultiplied, background-free.
        images: of the same views, likewise.
        background: on which both are composited.
        names: metrics to compute.
    """
    from econgs_bench.datasets.views import over

    rows = [
        evaluate(truth, over(image, background), image[..., 3], background, names).values
        for truth, image in zip(truths, images, strict=True)
    ]
    return {name: mean([row[name] for row in rows]) for name in names}
