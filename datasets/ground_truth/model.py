"""The optical model that every renderer of ground truth evaluates; written down once, here.

Emission-absorption, front to back, along the ray of each pixel centre through the box of the volume:

* Samples lie in the middle of segments of length dt = ``step_voxels`` x smallest voxel side, counted
  from where the ray enters the box; the last segment ends where the ray leaves it.
* Normalised values (:meth:`datasets.volume.Volume.normalised`) are interpolated trilinearly between the
  samples of the grid; the box ends at the outermost samples (point data).
* Post-classification: color c and extinction s come from the transfer function's table by linear
  interpolation. Opacity of a segment: alpha = 1 - exp(-s dt).
* The gradient g is the central difference over one voxel to either side, of interpolated values clamped
  at the border, in scene space (so anisotropic spacing counts).
* Blinn-Phong, two-sided, with white specular light: with n = g/|g|, v towards the camera, l towards the
  light (= v for a headlight), h = (v + l)/|v + l|, all at the sample:
  color = c (ambient + diffuse |n.l|) + specular |n.h|^shininess, clamped to [0, 1].
* Where there is no gradient there is no normal, and the color is c (ambient + diffuse), unshaded. The two
  are blended with weight |g|^2 / (|g|^2 + e^2), e = :data:`GRADIENT_FLOOR`, |g| in normalised values
  per voxel: noise does not turn into random normals, and the picture is continuous in the data.
* Phong (``Light.model``), as in the shader of VTK's GPU volume mapper, two-sided, with r = 2 (n.l) n - l,
  the mirrored light: color = c (ambient + diffuse |n.l|) + specular max(r.v, 0)^shininess, clamped to
  [0, 1]. r does not depend on the sign of n; with a headlight r.v = 2 (n.v)^2 - 1. As in VTK, only c ambient
  is left where there is no gradient; the blend is the one above with e = :data:`PHONG_FLOOR`, so small that
  it only keeps rounding errors from becoming normals.
* Colors are composited as displayed (nothing is linearised), premultiplied, without a background.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datasets.camera import Camera
from datasets.scene import Light
from datasets.transfer import TransferFunction
from datasets.volume import Volume

MODEL_VERSION = 1
"""Raised whenever the model above changes a picture; part of the key of cached views."""

GRADIENT_FLOOR = 2e-4
"""Gradient (normalised value per smallest voxel side) whose normal counts half."""

PHONG_FLOOR = 1e-5
"""The same in Phong mode, where VTK has none: above what single precision makes of a constant field."""

Progress = Callable[[int, int], None]
"""Called with the number of views done and of all views."""


@dataclass(frozen=True)
class MarchSettings:
    """Accuracy of the integration.

    Attributes:
        step_voxels: ray step in units of ``Volume.voxel``; positive. On real volumes with opaque surfaces a
            step of 1 is 40-44 dB from the converged picture, with visible wood grain that differs from view
            to view (so no method could learn it); 0.5 is at 46-55 dB for 1.6 to 2 times the time.
        table_size: entries of the transfer function's table (linear in between). 16384 leaves an error
            of about 1.5e-5, 1024 one of 8e-4.
    """

    step_voxels: float = 0.5
    table_size: int = 16384


class Marcher(Protocol):
    """A renderer of one volume, holding what does not depend on the scene."""

    def render(
        self,
        cameras: tuple[Camera, ...],
        transfer: TransferFunction,
        light: Light | None,
        progress: Progress | None = None,
    ) -> NDArray[np.float32]:
        """Render views of equal size.

        Returns:
            (n, height, width, 4) float32 premultiplied RGBA, background-free.
        """
        ...


def index_transform(volume: Volume) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(scale, offset), (3,) each, x y z: grid index = scene position * scale + offset."""
    counts = np.array(volume.dims) - 1.0
    return counts / volume.extent, 0.5 * counts
