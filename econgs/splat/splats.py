"""Arguments of the backends."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from econgs_bench.datasets.camera import Camera
from econgs_bench.econgs.splat.low_pass import LINEAGE, LowPass


class Splats(NamedTuple):
    """What a backend splats; fields as the arguments of :func:`.econgs.splat.rasterise`."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    features: Tensor
    camera: Camera
    screen_offset: Tensor | None = None
    low_pass: LowPass = LINEAGE
