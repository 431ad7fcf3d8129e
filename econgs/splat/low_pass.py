"""The low-pass filter on projected Gaussians, which keeps them from falling between pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class LowPass:
    """A filter of projected Gaussians.

    Attributes:
        variance: added to the diagonal of the projected covariance, in px²; above 0.
        compensated: opacities shrink so that a Gaussian keeps its mass, by the root of the ratio of the
            determinants (Yu et al. 2024, Mip-Splatting).

    Raises:
        ValueError: the variance is not above 0, or not finite.
    """

    variance: float = 0.3
    compensated: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.variance) and self.variance > 0.0):
            raise ValueError(f"low-pass filter: variance {self.variance:g} must be finite and above 0")


LINEAGE = LowPass()
"""Of 3DGS and all methods that follow it."""
