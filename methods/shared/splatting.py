"""Options that every method that splats Gaussians has: common equipment, no part of a method's idea."""

from __future__ import annotations

from dataclasses import dataclass

from methods.interface import option


@dataclass(frozen=True)
class SplattingOptions:
    """How projected Gaussians are filtered, which models keep with their files; whether alpha is a target."""

    low_pass: float = option(
        0.3, "variance of the low-pass filter on projected Gaussians, px²", minimum=0.01, maximum=4.0
    )
    antialiased: bool = option(
        False, "opacities shrink so that the filter keeps a Gaussian's mass (Mip-Splatting)"
    )
    smoothing: float = option(
        0.0,
        "variance added to every Gaussian in the scene, px² of the training views at their mean distance",
        minimum=0.0,
        maximum=4.0,
    )
    alpha_weight: float = option(
        0.0,
        "weight of the mean absolute error of alpha, where training views are transparent anywhere",
        minimum=0.0,
    )
