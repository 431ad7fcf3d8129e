"""The splatting core: one differentiable function with three backends."""

from __future__ import annotations

from econgs_bench.econgs.splat.low_pass import LINEAGE, LowPass
from econgs_bench.econgs.splat.rasterise import (
    SplatImages,
    choose_backend,
    rasterise,
    trusted_values,
    values_trusted,
)
from econgs_bench.econgs.splat.sh import spherical_harmonics

__all__ = [
    "LINEAGE",
    "LowPass",
    "SplatImages",
    "choose_backend",
    "rasterise",
    "spherical_harmonics",
    "trusted_values",
    "values_trusted",
]
