// What the kernels of sparse voxel grids (methods/plenoxels) and the code that drives them share. No std:: here.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace econgs {

// A voxel's row of floats: nine SH coefficients of red, of green, of blue, and five that are unused. Densities are
// apart: most samples need nothing else, and those of a whole scene fit in a cache.
constexpr int VOXEL_ROW = 32;
constexpr int VOXEL_SH = 9;
constexpr int VOXEL_BRICK = 4;       // cells along a side of a brick that is skipped where it is empty
constexpr int VOXEL_PATCH = 8;       // cells along a side of a patch whose gradients are summed by one thread
constexpr int MAX_GRIDS = 64;        // drawn together
constexpr int MAX_STEPS = 1 << 22;   // along a ray
constexpr float LEAST_DENSITY = 1e-8f;
constexpr float LEAST_THROUGH = 1e-7f;

struct VoxelGrid {
  const int32_t* links;   // nz x ny x nx vertices: row, or negative
  const float *densities, *rows;
  const uint8_t* bricks;  // whether any cell of a brick has a voxel at a corner
  int size[3];            // vertices along x, y, z
  int bricks_across[3];
  double origin[3], inverse;  // vertices = (position - origin) * inverse
  float depth;            // optical depth of a step at density 1
};

struct March {
  const VoxelGrid* grids;
  int count;
  double step;  // between samples, whose distances from the eye are (k + 1/2) * step
};

// What a ray keeps for its gradients, one per sample that was not empty.
struct VoxelSample {
  uint16_t x, y, z, unused;  // cell
  float fx, fy, fz;
  float weight, through;     // transmittance behind the sample
  float color[3];
};

// The same, in the order of patches.
struct VoxelGradient {
  uint16_t x, y, z, unused;
  float fx, fy, fz;
  int32_t ray;
  float density, color[3];
};

// Spherical harmonics of a ray with zeros on both sides: at TILE_MIDDLE - 9 c begins a row in which the
// coefficients of channel c have their factors and all others have zero.
constexpr int TILE_MIDDLE = 32;
constexpr int VOXEL_TILE = 80;

// Gradients, moments or rows of voxels that are written.
struct VoxelArrays {
  float *densities, *rows;
};

}  // namespace econgs
