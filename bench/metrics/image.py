"""The metrics on one pair of images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.views import over

IDENTICAL_DB = 100.0
"""PSNR of identical images, and its cap: one 8-bit step in one pixel of a large image would exceed it."""
FOREGROUND = 1.0 / 255.0
"""Least alpha of the foreground."""
SSIM_WINDOW = 11


@dataclass(frozen=True, eq=False)
class Pair:
    """Two pictures as displayed.

    Attributes:
        truth, render: (height, width, 3) uint8.
        foreground: (height, width) bool, where either has alpha >= 1/255; None if neither has alpha.
        alphas: (height, width) uint8 of truth and render; None if either has no alpha.
    """

    truth: NDArray[np.uint8]
    render: NDArray[np.uint8]
    foreground: NDArray[np.bool_] | None
    alphas: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None

    @staticmethod
    def composite(
        truth: NDArray[np.float32],
        rgb: NDArray[np.float32],
        alpha: NDArray[np.float32] | None,
        background: Sequence[float],
    ) -> Pair:
        """From background-free truth and composited render; see :func:`.bench.metrics.evaluate`."""
        height_width = truth.shape[:2]
        if truth.ndim != 3 or truth.shape[2] != 4:
            raise ValueError(f"truth must be (height, width, 4), not {truth.shape}")
        if rgb.shape != (*height_width, 3) or (alpha is not None and alpha.shape != height_width):
            shape = None if alpha is None else alpha.shape
            raise ValueError(f"render {rgb.shape} with alpha {shape} does not match truth {truth.shape}")
        if 0 in height_width:
            raise ValueError("images have no pixels")
        for what, values in (("truth", truth), ("render", rgb), ("alpha", alpha)):
            if values is not None and not np.isfinite(values).all():
                raise ValueError(f"{what} holds values that are not finite")
        # By the same arithmetic as models and the harness: a perfect render must come out identical.
        color = over(truth, (background[0], background[1], background[2]))
        foreground = truth[..., 3] >= FOREGROUND
        if alpha is None:
            return Pair(to_8bit(color), to_8bit(rgb), foreground)
        alphas = to_8bit(truth[..., 3]), to_8bit(alpha)
        return Pair(to_8bit(color), to_8bit(rgb), foreground | (alpha >= FOREGROUND), alphas)

    @property
    def identical(self) -> bool:
        """Whether the two pictures are the same."""
        return bool(np.array_equal(self.truth, self.render))

    def floats(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Truth and render in [0, 1]."""
        return self.truth.astype(np.float32) / 255.0, self.render.astype(np.float32) / 255.0


def to_8bit(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Clip to [0, 1] and round to the nearest of 256 levels."""
    levels: NDArray[np.uint8] = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    return levels


def scores(pair: Pair, names: Iterable[str]) -> tuple[dict[str, float | None], dict[str, str]]:
    """Metrics of :data:`.bench.metrics.METRICS` by their names: value or None, and why it is None."""
    results = {name: _FUNCTIONS[name](pair) for name in names}
    values = {name: None if isinstance(result, str) else result for name, result in results.items()}
    return values, {name: result for name, result in results.items() if isinstance(result, str)}


def _psnr(truth: NDArray[np.uint8], render: NDArray[np.uint8]) -> float:
    # Integers keep the sum exact: the same pictures give the same number on every machine.
    error = truth.astype(np.int64) - render.astype(np.int64)
    squares = int((error * error).sum())
    if squares == 0:
        return IDENTICAL_DB
    return min(IDENTICAL_DB, float(10.0 * np.log10(255.0**2 * error.size / squares)))


def psnr(pair: Pair) -> float:
    """PSNR in dB over all pixels."""
    return _psnr(pair.truth, pair.render)


def psnr_fg(pair: Pair) -> float | str:
    """PSNR in dB over foreground pixels."""
    if pair.foreground is None:
        return "the images have no alpha"
    if not pair.foreground.any():
        return "no pixel where truth or render has alpha >= 1/255"
    return _psnr(pair.truth[pair.foreground], pair.render[pair.foreground])


def ssim(pair: Pair) -> float | str:
    """Mean SSIM of the interior and the channels."""
    if min(pair.truth.shape[:2]) < SSIM_WINDOW:
        return f"the images are smaller than the {SSIM_WINDOW}x{SSIM_WINDOW} window"
    from skimage.metrics import structural_similarity

    truth, render = pair.floats()
    value = structural_similarity(
        truth.astype(np.float64),
        render.astype(np.float64),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    return float(value)


def flip(pair: Pair) -> float:
    """Mean LDR-FLIP at 67 pixels per degree."""
    import flip_evaluator

    truth, render = pair.floats()
    _, mean, _ = flip_evaluator.evaluate(
        truth,
        render,
        "LDR",
        inputsRGB=True,
        applyMagma=False,
        computeMeanError=True,
        parameters={"ppd": 67.0},
    )
    return float(mean)


def delta_e_uv(pair: Pair) -> float:
    """Mean CIELUV color difference."""
    from econgs_bench.reports.pictures.cieluv import delta_e_uv as difference

    return float(difference(*pair.floats()).mean())


def missing(pair: Pair) -> float | str:
    """Share of the truth's alpha that the render lacks."""
    return _uncovered(pair, 0, 1)


def excess(pair: Pair) -> float | str:
    """The render's alpha beyond the truth's, relative to the truth's."""
    return _uncovered(pair, 1, 0)


def _uncovered(pair: Pair, of: int, by: int) -> float | str:
    if pair.alphas is None:
        return "an image has no alpha"
    levels = [alpha.astype(np.int64) for alpha in pair.alphas]
    total = int(levels[0].sum())
    if total == 0:
        return "the truth shows nothing"
    return int(np.maximum(levels[of] - levels[by], 0).sum()) / total


def _lpips(network: str, *, unscaled: bool = False) -> Callable[[Pair], float | str]:
    def metric(pair: Pair) -> float | str:
        from econgs_bench.bench.metrics.lpips import distance

        return distance(network, *pair.floats(), unscaled=unscaled)

    return metric


_FUNCTIONS: dict[str, Callable[[Pair], float | str]] = {
    "psnr": psnr,
    "psnr_fg": psnr_fg,
    "ssim": ssim,
    "lpips_vgg": _lpips("vgg"),
    "lpips_vgg01": _lpips("vgg", unscaled=True),
    "lpips_alex": _lpips("alex"),
    "flip": flip,
    "delta_e_uv": delta_e_uv,
    "missing": missing,
    "excess": excess,
}
