"""Options that every method that splats Gaussians has: common equipment, no part of a method's idea."""

from __future__ import annotations

from dataclasses import dataclass

from econgs_bench.methods.interface import OptionValue, option
from econgs_bench.methods.shared.schedule import Decay


@dataclass(frozen=True)
class SplattingOptions:
    """Filters, which models keep with their files; start; decay of learning rates; loss of alpha; pruning."""

    low_pass: float = option(
        0.03,
        "variance of the low-pass filter on projected Gaussians, in squared distances of points",
        minimum=0.01,
        maximum=4.0,
    )
    antialiased: bool = option(
        True, "opacities shrink so that the filter keeps a Gaussian's mass (Mip-Splatting)"
    )
    smoothing: float = option(
        0.0,
        "variance added to every Gaussian in the scene, px² of the training views at their mean distance",
        minimum=0.0,
        maximum=4.0,
    )
    ray_power: float = option(
        1.0,
        "power of the ray's length in a Gaussian that multiplies its optical depth; 0 = not (published)",
        minimum=0.0,
        maximum=1.0,
    )
    supersampling: int = option(
        2,
        "points along each side of a pixel at which Gaussians are drawn, in a fit from half of its budget on",
        minimum=1,
        maximum=4,
        before=1,
    )
    start_spacing: float = option(
        0.0,
        "the cloud is thinned to one point per cell of this many pixels of the training views; 0 = off",
        minimum=0.0,
        maximum=100.0,
        search=(0.0, 6.0),
    )
    start_points: int = option(
        0,
        "cells shrink until the thinned cloud has this many points, if it has them at all",
        minimum=0,
        maximum=1_000_000,
        search=(0, 8_000),
    )
    start_scale: float = option(
        0.6, "initial scale, relative to the published initialisation", minimum=0.01, maximum=10.0
    )
    decay: Decay = option("linear", "how learning rates with a last value go there from the first")
    alpha_weight: float = option(
        0.05,
        "weight of the mean absolute error of alpha, where training views are transparent anywhere",
        minimum=0.0,
    )
    prune_loss_db: float = option(
        0.01,
        "prune the least visible primitives, losing at most this much PSNR [dB], twice per fit; 0 = off",
        minimum=0.0,
        maximum=10.0,
        search=(0.0, 0.1),
        formerly="rent",
    )


PUBLISHED: dict[str, OptionValue] = {
    "low_pass": 0.3,
    "antialiased": False,
    "smoothing": 0.0,
    "ray_power": 0.0,
    "supersampling": 1,
    "start_spacing": 0.0,
    "start_points": 0,
    "start_scale": 1.0,
    "decay": "exponential",
    "alpha_weight": 0.0,
    "prune_loss_db": 0.0,
}
"""Of 3DGS and what follows it."""
QUICK: dict[str, OptionValue] = {"alpha_weight": 0.2}
"""In so short a schedule."""
TUNABLE = ("alpha_weight", "start_spacing", "prune_loss_db")
"""Common equipment that ``bench tune`` varies for every method that splats."""
