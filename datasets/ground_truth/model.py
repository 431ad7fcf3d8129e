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

Compositions show several basic scenes together, each a layer with its own transfer function and light, on
volumes of one box and grid:

* Extinctions add. The color of a sample is the mean of the layers' shaded, clamped colors, weighted by
  their extinctions; each layer is shaded by the gradient of its own volume. One step, one march.

Masks (``Volume.mask``): a layer's extinction is multiplied by the trilinearly interpolated mask (0 or 1 at
the samples), so it fades within the one cell that the border crosses; values and gradients know nothing of
the mask, so no shell of other values appears there. An isosurface ends where the mask falls under 1/2.

Isosurfaces (``BasicScene.isosurfaces``) are the level sets of the trilinear field:

* Values are taken at both ends of each segment; a level that lies between them is crossed there (>= is
  inside, and levels are lowered by :data:`LEVEL_MARGIN`, so that a plateau at the level itself is inside
  whatever the rounding). The crossing is found by :data:`BISECTIONS` halvings and one secant, so where it
  lies does not depend on the step; two crossings of one level within a segment are missed.
* Each crossing is composited with its opacity and its color, shaded by the gradient at the crossing. Several
  levels crossed in a segment are taken in the order in which the values pass them; scenes of a composition
  that have crossings in one segment are taken in the composition's order.
* Beside volumes, a segment's extinction and color (those of its middle) act in shares before, between and
  behind its crossings.

Depth enhancement (``BasicScene.depth_enhancement``, strength d; our stand-in for that of commercial
renderers) multiplies a layer's shaded, clamped color by 1 - d O(x), with the occlusion O in [0, 1] baked once
per scene from the extinction E of all layers together (:mod:`datasets.ground_truth.occlusion`):

* E at each voxel is taken from the nearest entry of the table (times the mask), and averaged over cubes of
  k^3 voxels, with the least k that leaves at most 128 an axis. An isosurface of opacity a counts as
  -ln(1 - min(a, 0.99)) / (2 voxels) at the voxels that have a neighbour along an axis beyond its level.
* O is the mean over the radii r = 1/64, 1/32, 1/16, 1/8 (longest side of the box: 1) of the share of the
  neighbourhood that is opaque at that scale: the mean of 1 - exp(-E r) over a box of half-side r, rounded to
  cubes, with nothing outside the volume. Between centres of cubes it is interpolated trilinearly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from datasets.camera import Camera
from datasets.errors import DataError
from datasets.scene import BasicScene, Isosurface, Light
from datasets.transfer import TransferFunction
from datasets.volume import Volume

MODEL_VERSION = 1
"""Raised whenever the model above changes a picture; part of the key of cached views."""

GRADIENT_FLOOR = 2e-4
"""Gradient (normalised value per smallest voxel side) whose normal counts half."""

PHONG_FLOOR = 1e-5
"""The same in Phong mode, where VTK has none: above what single precision makes of a constant field."""

BISECTIONS = 8
"""Halvings of a segment in which a level is crossed, before the secant."""

LEVEL_MARGIN = 1e-6
"""By how much levels are lowered, in normalised values."""

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


@dataclass(frozen=True, eq=False)
class Layer:
    """A basic scene with its volume, as marchers see it.

    Attributes:
        volume: what it shows.
        transfer: None where it shows isosurfaces.
        light: None is unshaded.
        isosurfaces: level sets instead of a transfer function.
        depth_enhancement: strength in [0, 1].
    """

    volume: Volume
    transfer: TransferFunction | None
    light: Light | None
    isosurfaces: tuple[Isosurface, ...] = ()
    depth_enhancement: float = 0.0

    @property
    def levels(self) -> list[tuple[float, Isosurface]]:
        """Levels that are looked for, rising, each representable in single precision."""
        by_value = sorted(self.isosurfaces, key=lambda surface: surface.value)
        return [(float(np.float32(s.value - LEVEL_MARGIN)), s) for s in by_value]

    @classmethod
    def of(cls, scene: BasicScene, volume: Volume) -> Layer:
        """The layer that a basic scene is."""
        return cls(volume, scene.transfer, scene.light, scene.isosurfaces, scene.depth_enhancement)


class Draw(Protocol):
    """Draws views of one scene."""

    def __call__(self, cameras: tuple[Camera, ...], progress: Progress | None = None) -> NDArray[np.float32]:
        """Render views of equal size.

        Args:
            cameras: of one size.
            progress: called with views done and views in all.

        Returns:
            (n, height, width, 4) float32 premultiplied RGBA, background-free.
        """
        ...


class Marcher(Protocol):
    """A renderer of one or several volumes, holding what does not depend on the scene."""

    def prepare(self, layers: Sequence[Layer]) -> Draw:
        """What draws views of a scene, set up once.

        Args:
            layers: on the marcher's own volumes; several are a composition.
        """
        ...

    def compose(
        self, cameras: tuple[Camera, ...], layers: Sequence[Layer], progress: Progress | None = None
    ) -> NDArray[np.float32]:
        """:meth:`prepare` and draw."""
        ...

    def render(
        self,
        cameras: tuple[Camera, ...],
        transfer: TransferFunction,
        light: Light | None,
        progress: Progress | None = None,
    ) -> NDArray[np.float32]:
        """:meth:`compose` of one layer on the first volume."""
        ...


def same_grid(volumes: Sequence[Volume], what: str = "composition") -> tuple[Volume, ...]:
    """The volumes, each once, if they can be marched together.

    Raises:
        DataError: their grids or boxes differ.
    """
    distinct = tuple({id(volume): volume for volume in volumes}.values())
    first = distinct[0]
    for other in distinct[1:]:
        if other.dims != first.dims or not np.allclose(other.extent, first.extent, rtol=1e-6):
            grids = " and ".join(
                f"{v.name} ({'x'.join(map(str, v.dims))}, spacing {v.spacing})" for v in (first, other)
            )
            raise DataError(
                what, f"its volumes differ in grid or box: {grids}", "Resample them to one grid, or drop one"
            )
    return distinct


def index_transform(volume: Volume) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(scale, offset), (3,) each, x y z: grid index = scene position * scale + offset."""
    counts = np.array(volume.dims) - 1.0
    return counts / volume.extent, 0.5 * counts
