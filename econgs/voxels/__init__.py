"""Sparse voxel grids of density and color, and rays through them.

Plenoxels (S. Fridovich-Keil, A. Yu et al.: Plenoxels: Radiance Fields without Neural Networks, CVPR 2022).
"""

from econgs_bench.econgs.voxels.grid import ROW, SH, VoxelGrid, Voxels, bricks_of, lattice, links_of, occupied
from econgs_bench.econgs.voxels.march import Trace, drawn, trace, voxel_weights
from econgs_bench.econgs.voxels.optimise import rms_step, variation

__all__ = [
    "ROW",
    "SH",
    "Trace",
    "VoxelGrid",
    "Voxels",
    "bricks_of",
    "drawn",
    "lattice",
    "links_of",
    "occupied",
    "rms_step",
    "trace",
    "variation",
    "voxel_weights",
]
