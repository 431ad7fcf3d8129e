"""Image quality metrics, each named and versioned. This module is import-light.

Metrics judge the picture as displayed: composited on the scene's background, clipped to [0, 1] and
rounded to 8 bit, so that a number from memory and one from the PNG files agree. Those of :data:`COVERAGE`
judge alpha, rounded likewise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Metric:
    """What a metric's name stands for.

    Attributes:
        name: identifier; column of the tables.
        version: raised when numbers may change; part of the measure key.
        title: as printed in tables.
        unit: "" if it has none.
        higher_is_better: direction.
        bounds: least and greatest possible value.
        doc: the definition, in one or two sentences.
    """

    name: str
    version: str
    title: str
    unit: str
    higher_is_better: bool
    bounds: tuple[float, float]
    doc: str


_INF = float("inf")
METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "psnr", "1", "PSNR", "dB", True, (0.0, 100.0),
            "10 log10(1 / MSE) over all pixels and channels of one image. Identical images count 100 dB and "
            "are flagged; 100 dB is also the cap.",
        ),
        Metric(
            "psnr_fg", "1", "PSNR (foreground)", "dB", True, (0.0, 100.0),
            "PSNR over the pixels where the alpha of truth or model is at least 1/255.",
        ),
        Metric(
            "ssim", "1", "SSIM", "", True, (-1.0, 1.0),
            "Wang et al. 2004 as in scikit-image: Gaussian window 11x11, sigma 1.5, population covariance, "
            "mean over the interior (5 pixels from the border) and the three channels.",
        ),
        Metric(
            "lpips_vgg", "1", "LPIPS (VGG)", "", False, (0.0, _INF),
            "LPIPS 0.1 of the `lpips` package, VGG-16, input in [-1, 1] as its authors ask.",
        ),
        Metric(
            "lpips_vgg01", "1", "LPIPS (VGG, unscaled)", "", False, (0.0, _INF),
            "LPIPS 0.1, VGG-16, input left in [0, 1]: the splatting papers' convention, "
            "which gives lower values.",
        ),
        Metric(
            "lpips_alex", "1", "LPIPS (AlexNet)", "", False, (0.0, _INF),
            "LPIPS 0.1, AlexNet, input in [-1, 1].",
        ),
        Metric(
            "flip", "1", "FLIP", "", False, (0.0, 1.0),
            "Mean LDR-FLIP (Andersson et al. 2020) at 67 pixels per degree, by flip-evaluator.",
        ),
        Metric(
            "delta_e_uv", "1", "ΔE*uv", "", False, (0.0, _INF),
            "Mean CIE 1976 L*u*v* color difference; sRGB decoded, white point D65.",
        ),
        Metric(
            "missing", "1", "Missing", "", False, (0.0, 1.0),
            "Share of the truth's alpha, summed over pixels, that the model lacks: structures that it never "
            "found, and what has the background's color, which no error in color asks for.",
        ),
        Metric(
            "excess", "1", "Excess", "", False, (0.0, _INF),
            "Alpha of the model beyond the truth's, summed over pixels, relative to the sum of the truth's: "
            "what hides other things, and shows on another background.",
        ),
    )
}  # fmt: skip
COVERAGE = ("missing", "excess")
"""Of alpha alone. Every measure job takes them, but its key does not name them: they came later, and records
without them are worth the same."""


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
    alpha: NDArray[np.float32],
    background: Sequence[float],
    names: Sequence[str] | None = None,
) -> Scores:
    """Compare one rendered view with the ground truth.

    Networks stay loaded from one call to the next.

    Args:
        truth: (height, width, 4) RGBA in [0, 1], premultiplied, background-free.
        rgb: (height, width, 3) rendered image, composited on ``background``.
        alpha: (height, width) rendered alpha in [0, 1].
        background: RGB in [0, 1].
        names: metrics wanted; all of :data:`METRICS` if None.

    Raises:
        UnknownName: a name is no metric.
        ValueError: shapes differ or values are not finite.
    """
    from bench.metrics.image import Pair, compute
    from datasets.names import unknown

    wanted = list(METRICS) if names is None else list(names)
    for name in wanted:
        if name not in METRICS:
            raise unknown("metric", name, METRICS)
    pair = Pair.composite(truth, rgb, alpha, background)
    values: dict[str, float | None] = {}
    reasons: dict[str, str] = {}
    for name in wanted:
        result = compute(name, pair)
        values[name] = result if isinstance(result, float) else None
        if isinstance(result, str):
            reasons[name] = result
    return Scores(values, reasons)
