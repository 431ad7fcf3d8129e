"""Baked occlusion for depth enhancement; formula in :mod:`.datasets.ground_truth.model`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from econgs_bench.datasets.ground_truth.model import Layer
from econgs_bench.datasets.visibility import ends

RADII = (1 / 64, 1 / 32, 1 / 16, 1 / 8)
"""Half-sides of the neighbourhoods in scene space."""

_MOST = 128  # cubes an axis: occlusion is smooth


@dataclass(frozen=True, eq=False)
class Occlusion:
    """Occlusion at the centres of cubes of voxels.

    Attributes:
        values: (z, y, x) float32 in [0, 1].
        cube: voxels along a cube's side.
    """

    values: NDArray[np.float32]
    cube: int

    @property
    def scale(self) -> float:
        """Index among the cubes = grid index * scale + offset."""
        return 1.0 / self.cube

    @property
    def offset(self) -> float:
        return (1.0 - self.cube) / (2.0 * self.cube)


def bake(
    layers: Sequence[Layer], fields: Sequence[NDArray[np.float32]], table_size: int, most: int = _MOST
) -> Occlusion:
    """Occlusion by all layers together.

    Args:
        layers: layers of one scene or composition, on one grid.
        fields: normalised values (nz, ny, nx) of each layer's volume.
        table_size: entries of transfer function tables.
        most: maximum number of cubes along an axis.
    """
    from scipy.ndimage import uniform_filter  # long to import, and few need it

    volume = layers[0].volume
    cube = -(-max(volume.dims) // most)
    shape = [-(-n // cube) for n in fields[0].shape]
    extinction = np.zeros(shape, dtype=np.float32)
    for layer, values in zip(layers, fields, strict=True):
        _add(extinction, layer, values, cube, table_size)
    spacing = cube * volume.extent / (np.array(volume.dims) - 1)
    occlusion = np.zeros_like(extinction)
    for radius in RADII:
        sizes = [2 * int(np.rint(radius / h)) + 1 for h in spacing[::-1]]
        opaque = -np.expm1(-radius * extinction)
        occlusion += uniform_filter(opaque, sizes, mode="constant") / np.float32(len(RADII))
    return Occlusion(np.clip(occlusion, 0.0, 1.0), cube)


def _add(
    total: NDArray[np.float32], layer: Layer, values: NDArray[np.float32], cube: int, table_size: int
) -> None:
    """Add a layer's extinction, averaged over cubes, slab by slab."""
    table = None
    if layer.transfer is not None:
        table = layer.transfer.table(layer.transfer.entries(table_size))[:, 3].copy()
    mask = layer.volume.mask
    for k in range(len(total)):
        here = slice(k * cube, min((k + 1) * cube, len(values)))
        if table is None:
            extinction = _surfaces(layer, values, here)
        else:
            extinction = table[np.rint(values[here] * np.float32(len(table) - 1)).astype(np.int32)]
        if mask is not None:
            extinction *= mask[here]
        for axis in range(3):
            n = extinction.shape[axis]
            starts = np.arange(0, n, cube)
            counts = np.minimum(cube, n - starts).astype(np.float32)
            extinction = np.add.reduceat(extinction, starts, axis=axis)
            extinction /= counts.reshape([-1 if a == axis else 1 for a in range(3)])
        total[k] += extinction[0]


def _surfaces(layer: Layer, values: NDArray[np.float32], here: slice) -> NDArray[np.float32]:
    """Extinction of isosurfaces at the voxels of some slices."""
    around = slice(max(here.start - 1, 0), min(here.stop + 1, len(values)))
    slab = values[around]
    extinction = np.zeros(slab.shape, dtype=np.float32)
    for surface in layer.isosurfaces:
        near = beside_level(slab, surface.value)
        extinction += near * np.float32(-np.log1p(-min(surface.opacity, 0.99)) / (2.0 * layer.volume.voxel))
    start = here.start - around.start
    return extinction[start : start + here.stop - here.start]


def beside_level(values: NDArray[np.float32], level: float) -> NDArray[np.bool_]:
    """Mask of the voxels with a neighbour along an axis on the other side of a level."""
    inside = values >= np.float32(level)
    beside = np.zeros(values.shape, dtype=bool)
    for axis in range(3):
        differs = np.not_equal(*ends(inside, axis))
        for side in ends(beside, axis):
            side |= differs
    return beside
