"""Between Gaussians and pixels: filters, points of a pixel, depth along a ray."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class LowPass:
    """Filters of Gaussians, points at which they are drawn, and how dark they are along a ray.

    Attributes:
        variance: added to the diagonal of the projected covariance, in squared distances of points (px² where
            a pixel has one); above 0.
        compensated: the filter on the image shrinks opacities so that a Gaussian keeps its mass, by the root
            of the ratio of the determinants (Yu et al. 2024, Mip-Splatting).
        smoothing: added to the diagonal of the covariance in the scene, in squared scene units: a least size
            that does not depend on the view.
        ray_power: optical depths are multiplied by this power of a Gaussian's mean area (of the projections
            along its axes; root of the mean square) over its area across the ray: a sheet is darker seen
            edge-on, as in a volume. 0: as dark from everywhere (published); 1: a density of constant mass.
        points: along each side of a pixel, whose color is the mean of what is drawn at them; 1: its centre
            (published).

    Raises:
        ValueError: the variance is not above 0, the smoothing is negative, the power is not within 0 to 1,
            one is not finite, or there are not 1 to 8 points.
    """

    variance: float = 0.3
    compensated: bool = False
    smoothing: float = 0.0
    ray_power: float = 0.0
    points: int = 1

    def __post_init__(self) -> None:
        if not (math.isfinite(self.variance) and self.variance > 0.0):
            raise ValueError(f"low-pass filter: variance {self.variance:g} must be finite and above 0")
        if not (math.isfinite(self.smoothing) and self.smoothing >= 0.0):
            raise ValueError(f"low-pass filter: smoothing {self.smoothing:g} must be finite and 0 or more")
        if not 0.0 <= self.ray_power <= 1.0:
            raise ValueError(f"low-pass filter: power of the ray {self.ray_power:g} must be 0 to 1")
        if not 1 <= self.points <= 8:
            raise ValueError(f"{self.points} points along a side of a pixel: 1 to 8 are possible")

    def at_points(self) -> LowPass:
        """The same filters where each point is a pixel."""
        return replace(self, points=1)

    def at_one_point(self) -> LowPass:
        """What comes nearest in one point a pixel: a Gaussian filter of the variance of filter and points."""
        squared = self.points**2
        return replace(self, points=1, variance=self.variance / squared + (squared - 1) / (12 * squared))


LINEAGE = LowPass()
"""Of 3DGS and all methods that follow it."""
