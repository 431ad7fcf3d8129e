"""Options of every method that splats Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from methods.interface import option


@dataclass(frozen=True)
class SplattingOptions:
    """How projected Gaussians are filtered; models keep it with their files."""

    low_pass: float = option(
        0.3, "variance of the low-pass filter on projected Gaussians, px²", minimum=0.01, maximum=4.0
    )
    antialiased: bool = option(
        False, "opacities shrink so that the filter keeps a Gaussian's mass (Mip-Splatting)"
    )
