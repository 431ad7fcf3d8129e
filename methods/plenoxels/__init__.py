"""Plenoxels: a sparse voxel grid of density and spherical harmonics (Fridovich-Keil, Yu et al. 2022)."""
