"""The optical model of every ground-truth renderer.

A pixel is the mean over its rays (:mod:`.datasets.ground_truth.sampling`). Along each of them, emission and
absorption, front to back, through the box of the volume:

* Samples lie in the middle of segments of length dt = ``step_voxels`` x smallest voxel side. The first
  segment begins where the ray enters the box, the last one ends where the ray leaves it.
* Normalised values (:meth:`.datasets.volume.Volume.normalised`) are interpolated trilinearly between the
  samples of the grid; the box ends at the outermost samples (point data).
* Post-classification: color c and extinction s come from the transfer function's table by linear
  interpolation. Opacity of a segment: alpha = 1 - exp(-s dt).
* The gradient g is the central difference over one voxel to either side, of interpolated values clamped
  at the border, in scene space (so anisotropic spacing counts).
* Blinn-Phong, two-sided, with white specular light: with n = g/|g|, v towards the camera, l towards the
  light (= v for a headlight), h = (v + l)/|v + l|, all at the sample:
  color = c (ambient + diffuse |n.l|) + specular |n.h|^shininess, clamped to [0, 1].
* A vanishing gradient has no normal: the color is c (ambient + diffuse), unshaded. The shaded
  and the unshaded color are blended with weight |g|^2 / (|g|^2 + e^2), e = :data:`GRADIENT_FLOOR`, |g| in
  normalised values per voxel: noise makes no random normals, and the picture is continuous in the data.
* Phong (``Light.model``), as in the shader of VTK's GPU volume mapper, two-sided, with r = 2 (n.l) n - l,
  the mirrored light: color = c (ambient + diffuse |n.l|) + specular max(r.v, 0)^shininess, clamped to
  [0, 1]. r does not depend on the sign of n; with a headlight r.v = 2 (n.v)^2 - 1. As in VTK, the
  unshaded color is c ambient; the blend is the one above with e = :data:`PHONG_FLOOR`, so small that
  it only suppresses normals of rounding errors.
* Colors are composited as displayed (nothing is linearised), premultiplied, without a background.

Compositions show several basic scenes together, each a layer with its own transfer function and light, on
volumes of one box and grid:

* Extinctions add. The color of a sample is the mean of the layers' shaded, clamped colors, weighted by
  their extinctions; each layer is shaded by the gradient of its own volume. One step, one march.

Masks (``Volume.mask``): a layer's extinction is multiplied by the trilinearly interpolated mask (0 or 1 at
the samples), so it fades within the one cell that the border crosses. Values and gradients ignore the mask,
so no shell of other values appears there. An isosurface ends where the mask falls under 1/2.

Isosurfaces (``BasicScene.isosurfaces``) are the level sets of the trilinear field:

* Values are taken at both ends of each segment; the segment crosses each level between them (>= is
  inside, and levels are lowered by :data:`LEVEL_MARGIN`, so that a plateau at the level itself is inside
  whatever the rounding). :data:`BISECTIONS` halvings and one secant locate the crossing, so its place does
  not depend on the step; two crossings of one level within a segment are missed.
* Each crossing is composited with its opacity and its color, shaded by the gradient at the crossing. Several
  crossings in a segment follow each other in the order of the values; crossings of several scenes in one
  segment follow the composition's order.
* In a composition with volumes, a segment's extinction and color (those of its middle) act in shares before,
  between and behind its crossings.

Depth enhancement (``BasicScene.depth_enhancement``, strength d; our stand-in for that of commercial
renderers) multiplies a layer's shaded, clamped color by 1 - d O(x), with the occlusion O in [0, 1] baked once
per scene from the extinction E of all layers together (:mod:`.datasets.ground_truth.occlusion`):

* E at each voxel is the nearest entry of the table (times the mask), averaged over cubes of k^3 voxels,
  with the least k that leaves at most 128 an axis. An isosurface of opacity a counts as
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

from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError
from econgs_bench.datasets.ground_truth.sampling import RAYS_AT_ONCE, Tracer, pictures
from econgs_bench.datasets.scene import BasicScene, Isosurface, Light
from econgs_bench.datasets.scratch import new_array
from econgs_bench.datasets.transfer import TransferFunction
from econgs_bench.datasets.volume import Volume

MODEL_VERSION = 1
"""Version of the model: raised with every change of a picture; part of the key of cached views."""

GRADIENT_FLOOR = 2e-4
"""Gradient (normalised value per smallest voxel side) at which the shaded color has weight 1/2."""

PHONG_FLOOR = 1e-5
"""The same for Phong, where VTK has none: above the rounding errors of a constant field."""

_FULL_FLOOR = 64.0  # spans of visible values below 1/64 lower the floor in proportion

BISECTIONS = 8
"""Halvings of a segment in which a level is crossed, before the secant."""

LEVEL_MARGIN = 1e-6
"""Lowering of all levels, in normalised values."""

Progress = Callable[[int, int], None]
"""Callback with the number of finished views and of all views."""


@dataclass(frozen=True)
class MarchSettings:
    """Accuracy of the integration.

    Attributes:
        step_voxels: ray step in units of ``Volume.voxel``; positive. On real volumes with opaque surfaces,
            pictures with a step of 1 reach 40-44 dB against the converged ones and show wood grain that
            differs from view to view (no method can learn it); 0.5 reaches 46-55 dB in 1.6-2 times the time.
        table_size: least entries of the transfer function's table (linear in between); narrow bumps have
            more. 16384 leaves an error of about 1.5e-5, 1024 an error of 8e-4.
    """

    step_voxels: float = 0.5
    table_size: int = 16384


@dataclass(frozen=True, eq=False)
class Layer:
    """A basic scene with its volume.

    Attributes:
        volume: the field.
        transfer: its transfer function; None for isosurfaces.
        light: light and material; None renders unshaded.
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
        """Levels with their isosurfaces, ascending, each level exact in single precision."""
        by_value = sorted(self.isosurfaces, key=lambda surface: surface.value)
        return [(float(np.float32(s.value - LEVEL_MARGIN)), s) for s in by_value]

    @property
    def narrow(self) -> bool:
        """Whether its table and its floor are those of a narrow range of visible values."""
        size = MarchSettings.table_size
        return self.transfer is not None and (self.transfer.entries(size) > size or self._share < 1.0)

    @property
    def floor(self) -> float:
        """Gradient at which the shaded color has weight 1/2."""
        phong = self.light is not None and self.light.model == "phong"
        return (PHONG_FLOOR if phong else GRADIENT_FLOOR) * self._share

    @property
    def _share(self) -> float:
        return 1.0 if self.transfer is None else min(1.0, _FULL_FLOOR * self.transfer.span)

    @classmethod
    def of(cls, scene: BasicScene, volume: Volume) -> Layer:
        """The layer of a basic scene."""
        return cls(volume, scene.transfer, scene.light, scene.isosurfaces, scene.depth_enhancement)


class Draw(Protocol):
    """Draws views of one scene."""

    def __call__(self, cameras: tuple[Camera, ...], progress: Progress | None = None) -> NDArray[np.float32]:
        """Render views of equal size.

        Args:
            cameras: views of one size.
            progress: callback after each batch of views.

        Returns:
            (n, height, width, 4) float32 premultiplied RGBA, background-free.
        """
        ...


class Marcher:
    """A renderer of one or several volumes; it holds all that is independent of the scene.

    Args:
        volume: the field, or the fields of a composition.
        settings: step and table size.

    Attributes:
        rays_at_once: rays of the views that are drawn together, at one ray a pixel.

    Raises:
        DataError: the volumes differ in grid or box.
    """

    rays_at_once = RAYS_AT_ONCE

    def __init__(self, volume: Volume | Sequence[Volume], settings: MarchSettings) -> None:
        self._volumes = same_grid((volume,) if isinstance(volume, Volume) else volume)
        self._settings = settings
        self._voxel = self._volumes[0].voxel
        self._dt = settings.step_voxels * self._voxel

    def tracer(self, layers: Sequence[Layer]) -> Tracer:
        """Set up the rays of a scene.

        Args:
            layers: layers on the marcher's own volumes; several make a composition.
        """
        raise NotImplementedError

    def prepare(self, layers: Sequence[Layer], samples: int = 1) -> Draw:
        """Set up the drawing of a scene's views; several small ones share a launch.

        Args:
            layers: layers on the marcher's own volumes; several make a composition.
            samples: rays a pixel (:mod:`.datasets.ground_truth.sampling`): 1 goes through its centre, 0 are
                as many as it needs.
        """
        tracer = self.tracer(layers)

        def draw(cameras: tuple[Camera, ...], progress: Progress | None = None) -> NDArray[np.float32]:
            width, height = cameras[0].width, cameras[0].height
            images = new_array((len(cameras), height, width, 4), np.float32)
            batch = max(1, self.rays_at_once // (width * height))
            for start in range(0, len(cameras), batch):
                part = cameras[start : start + batch]
                images[start : start + batch] = pictures(tracer, part, samples)
                if progress:
                    progress(start + len(part), len(cameras))
            return images

        return draw

    def _numbers(self, layers: Sequence[Layer]) -> list[int]:
        """Index of each layer's volume among the marcher's."""
        return [next(i for i, v in enumerate(self._volumes) if v is layer.volume) for layer in layers]

    def compose(
        self,
        cameras: tuple[Camera, ...],
        layers: Sequence[Layer],
        progress: Progress | None = None,
        samples: int = 1,
    ) -> NDArray[np.float32]:
        """:meth:`prepare` and draw."""
        return self.prepare(layers, samples)(cameras, progress)

    def render(
        self,
        cameras: tuple[Camera, ...],
        transfer: TransferFunction,
        light: Light | None,
        progress: Progress | None = None,
        samples: int = 1,
    ) -> NDArray[np.float32]:
        """:meth:`compose` of one layer on the first volume."""
        return self.compose(cameras, (Layer(self._volumes[0], transfer, light),), progress, samples)


def same_grid(volumes: Sequence[Volume], what: str = "composition") -> tuple[Volume, ...]:
    """The volumes without repetition, if they have one grid and box.

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
