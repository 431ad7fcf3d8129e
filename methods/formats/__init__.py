"""File formats of plain Gaussians with spherical harmonics, which viewers of splats open."""
