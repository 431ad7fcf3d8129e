// Batches of rays through sparse voxel grids (methods/plenoxels), forward and backward.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "kernels/voxel_types.h"
#include "runtime.h"

namespace econgs {

struct RayBatch {
  const float *origins, *directions, *near;  // count x 3, count x 3 (unit vectors), count
  int64_t count;
};

// What the backward pass needs of a batch.
struct MarchFrame {
  int64_t count = 0;                             // rays
  std::vector<std::vector<VoxelSample>> chunks;  // of CHUNK rays each
  std::vector<int32_t> samples;                  // of each ray
  Buffer tiles;                                  // count x VOXEL_TILE
};

// Premultiplied colors (count x 3) and alpha (count).
std::unique_ptr<MarchFrame> march(const March&, const RayBatch&, float* colors, float* alpha, bool keep);
// Adds the gradients of one grid's voxels to `to`.
void march_backward(const MarchFrame&, const VoxelGrid&, const float* grad_colors, const float* grad_alpha,
                    const VoxelArrays& to);
// most: the largest weight that any of the rays gives each of `count` voxels, at least what it was.
void voxel_weights(const March&, const RayBatch&, int64_t count, float* most);
// factors: of densities and of coefficients.
double variation(const VoxelGrid&, int64_t begin, int64_t count, const float* factors, float spread,
                 const VoxelArrays& to);
// rates: of densities and of coefficients.
void rms_step(const VoxelArrays& values, const VoxelArrays& grads, const VoxelArrays& moments, int64_t count,
              const float* rates, float beta, float eps);

}  // namespace econgs
