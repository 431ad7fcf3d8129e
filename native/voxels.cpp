#include "voxels.h"

#include <algorithm>
#include <cmath>
#include <cstring>

namespace econgs {
namespace {

constexpr int64_t CHUNK = 16;
constexpr int64_t GROUPS = 8;  // ranges of chunks that are sorted at the same time; results do not depend on it

void fill_tile(const float* direction, float* tile) {
  std::fill(tile, tile + VOXEL_TILE, 0.0f);
  const float x = direction[0], y = direction[1], z = direction[2];
  const float c1 = 0.48860251f, c2 = 1.09254843f, c20 = 0.31539157f, c22 = 0.54627422f;
  const float basis[VOXEL_SH] = {0.28209479f,
                                 -c1 * y,
                                 c1 * z,
                                 -c1 * x,
                                 c2 * x * y,
                                 -c2 * y * z,
                                 c20 * (2.0f * z * z - x * x - y * y),
                                 -c2 * x * z,
                                 c22 * (x * x - y * y)};
  std::copy(basis, basis + VOXEL_SH, tile + TILE_MIDDLE);
}

// Most samples that a ray can have in a grid: those of its diagonal.
int64_t most_samples(const March& march) {
  double most = 0;
  for (int g = 0; g < march.count; ++g) {
    const VoxelGrid& grid = march.grids[g];
    double square = 0;
    for (const int n : grid.size) square += static_cast<double>(n - 1) * (n - 1);
    most = std::max(most, std::sqrt(square) / (grid.inverse * march.step));
  }
  return static_cast<int64_t>(most) + 8;
}

// Of one sample: the gradient by its density, once the sum over all samples behind it is known.
void ray_gradients(const VoxelSample* samples, int64_t count, int32_t ray, const float* grad_color, float grad_alpha,
                   float depth, VoxelGradient* const* to) {
  float behind = 0;
  for (int64_t n = count - 1; n >= 0; --n) {
    const VoxelSample& s = samples[n];
    const float value =
        grad_color[0] * s.color[0] + grad_color[1] * s.color[1] + grad_color[2] * s.color[2] + grad_alpha;
    VoxelGradient& g = *to[n];
    g = {s.x, s.y, s.z, 0, s.fx, s.fy, s.fz, ray, depth * (s.through * value - behind), {}};
    for (int c = 0; c < 3; ++c) g.color[c] = s.color[c] > 0.0f ? s.weight * grad_color[c] : 0.0f;
    behind += s.weight * value;
  }
}

}  // namespace

std::unique_ptr<MarchFrame> march(const March& march, const RayBatch& rays, float* colors, float* alpha, bool keep) {
  auto frame = std::make_unique<MarchFrame>();
  frame->count = rays.count;
  const int64_t chunks = (rays.count + CHUNK - 1) / CHUNK, room = most_samples(march);
  if (keep) {
    frame->chunks.resize(chunks);
    frame->samples.resize(rays.count);
    frame->tiles = Buffer(rays.count * VOXEL_TILE * sizeof(float));
  }
  const Scratch scratch(keep ? CHUNK * room * static_cast<int64_t>(sizeof(VoxelSample) / sizeof(float)) : 16);
  parallel(chunks, [&](int64_t chunk, int thread) {
    VoxelSample* const kept = keep ? reinterpret_cast<VoxelSample*>(scratch.of(thread)) : nullptr;
    int64_t total = 0;
    for (int64_t n = chunk * CHUNK; n < std::min(rays.count, (chunk + 1) * CHUNK); ++n) {
      float own[VOXEL_TILE];
      float* const tile = keep ? frame->tiles.as<float>() + n * VOXEL_TILE : own;
      fill_tile(rays.directions + 3 * n, tile);
      const int64_t count =
          kernels().march_ray(march, rays.origins + 3 * n, rays.directions + 3 * n, rays.near[n], tile, colors + 3 * n,
                              alpha + n, kept ? kept + total : nullptr, nullptr);
      if (keep) frame->samples[n] = static_cast<int32_t>(count);
      total += count;
    }
    if (keep) frame->chunks[chunk].assign(kept, kept + total);
  });
  return frame;
}

// Samples are sorted by patches of cells, in the order of rays within a patch. Patches of which none shares a vertex
// with another are summed at the same time, each by one thread: sums do not depend on the threads.
void march_backward(const MarchFrame& frame, const VoxelGrid& grid, const float* grad_colors, const float* grad_alpha,
                    const VoxelArrays& to) {
  int64_t across[3];
  for (int i = 0; i < 3; ++i) across[i] = (grid.size[i] - 1 + VOXEL_PATCH - 1) / VOXEL_PATCH;
  const int64_t patches = across[0] * across[1] * across[2], chunks = static_cast<int64_t>(frame.chunks.size());
  const auto patch_of = [&](const VoxelSample& s) {
    return (s.z / VOXEL_PATCH * across[1] + s.y / VOXEL_PATCH) * across[0] + s.x / VOXEL_PATCH;
  };
  const int64_t part = (chunks + GROUPS - 1) / GROUPS;
  std::vector<int64_t> places(GROUPS * patches, 0), starts(patches + 1, 0);
  parallel(GROUPS, [&](int64_t group, int) {
    int64_t* const counts = places.data() + group * patches;
    for (int64_t c = group * part; c < std::min(chunks, (group + 1) * part); ++c)
      for (const VoxelSample& s : frame.chunks[c]) ++counts[patch_of(s)];
  });
  int64_t total = 0;
  for (int64_t p = 0; p < patches; ++p) {
    starts[p] = total;
    for (int64_t group = 0; group < GROUPS; ++group) {
      const int64_t count = places[group * patches + p];
      places[group * patches + p] = total;
      total += count;
    }
  }
  starts[patches] = total;
  const Buffer memory(total * sizeof(VoxelGradient));
  VoxelGradient* const sorted = memory.as<VoxelGradient>();
  parallel(GROUPS, [&](int64_t group, int) {
    int64_t* const next = places.data() + group * patches;
    std::vector<VoxelGradient*> targets;
    for (int64_t c = group * part; c < std::min(chunks, (group + 1) * part); ++c) {
      const VoxelSample* at = frame.chunks[c].data();
      for (int64_t n = c * CHUNK; n < std::min(frame.count, (c + 1) * CHUNK); ++n) {
        const int64_t count = frame.samples[n];
        targets.resize(count);
        for (int64_t i = 0; i < count; ++i) targets[i] = sorted + next[patch_of(at[i])]++;
        ray_gradients(at, count, static_cast<int32_t>(n), grad_colors + 3 * n, grad_alpha[n], grid.depth,
                      targets.data());
        at += count;
      }
    }
  });
  for (int parity = 0; parity < 8; ++parity) {
    std::vector<int64_t> turn;
    for (int64_t z = parity >> 2; z < across[2]; z += 2)
      for (int64_t y = parity >> 1 & 1; y < across[1]; y += 2)
        for (int64_t x = parity & 1; x < across[0]; x += 2) {
          const int64_t p = (z * across[1] + y) * across[0] + x;
          if (starts[p] < starts[p + 1]) turn.push_back(p);
        }
    parallel(static_cast<int64_t>(turn.size()), [&](int64_t item, int) {
      const int64_t p = turn[item];
      kernels().scatter_voxels(grid, sorted + starts[p], starts[p + 1] - starts[p], frame.tiles.as<float>(), to);
    });
  }
}

void voxel_weights(const March& march, const RayBatch& rays, int64_t count, float* most) {
  const int many = threads();
  std::vector<float> each(static_cast<size_t>(many - 1) * count, 0.0f);  // the first thread's are the result itself
  parallel_ranges(rays.count, CHUNK, [&](int64_t begin, int64_t end, int thread) {
    float* const own = thread == 0 ? most : each.data() + (thread - 1) * count;
    float color[3], alpha;
    for (int64_t n = begin; n < end; ++n)
      kernels().march_ray(march, rays.origins + 3 * n, rays.directions + 3 * n, rays.near[n], nullptr, color, &alpha,
                          nullptr, own);
  });
  for (int thread = 1; thread < many; ++thread)
    for (int64_t n = 0; n < count; ++n) most[n] = std::max(most[n], each[(thread - 1) * count + n]);
}

double variation(const VoxelGrid& grid, int64_t begin, int64_t count, const float* factors, float spread,
                 const VoxelArrays& to) {
  double parts[3];
  parallel(3, [&](int64_t part, int) {
    const float factor = factors[part == 0 ? 0 : 1];
    parts[part] = kernels().voxel_variation(grid, begin, count, factor, spread, static_cast<int>(part), to);
  });
  return parts[0] + (parts[1] + parts[2]);
}

void rms_step(const VoxelArrays& values, const VoxelArrays& grads, const VoxelArrays& moments, int64_t count,
              const float* rates, float beta, float eps) {
  parallel_ranges(count, 1024, [&](int64_t begin, int64_t end, int) {
    kernels().voxel_step(values, grads, moments, begin, end, rates[0], rates[1], beta, eps);
  });
}

}  // namespace econgs
