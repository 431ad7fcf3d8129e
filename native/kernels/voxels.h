// Rays through sparse voxel grids: forward, sums of gradients, total variation, RMSProp.
//
// Densities are looked up for LANES samples of a ray at a time; a sample's color is the sum of eight rows, each
// VOXEL_ROW / LANES vectors, in which the harmonics of the ray stand beside their coefficients.
#pragma once

#include "simd.h"
#include "voxel_types.h"

namespace ECONGS_ISA {

using namespace econgs;

constexpr int ROW_VECTORS = VOXEL_ROW / LANES;

// A ray in vertices of a grid: sample k lies at from + k * by, and in the grid for first <= k <= last.
struct Line {
  float from[3], by[3];
  int first, last, next;  // next: the first sample not known to be in an empty brick
};

INLINE Line line_of(const VoxelGrid& grid, double step, const float* origin, const float* direction, double near) {
  Line line;
  double low = near / step - 0.5, high = MAX_STEPS;
  if (!(low > 0.0)) low = 0.0;
  for (int i = 0; i < 3; ++i) {
    const double by = step * grid.inverse * direction[i];
    const double from = (origin[i] - grid.origin[i]) * grid.inverse + 0.5 * by, end = grid.size[i] - 1;
    line.from[i] = (float)from;
    line.by[i] = (float)by;
    if (by != 0.0) {
      const double one = -from / by, other = (end - from) / by;
      const double enter = one < other ? one : other, leave = one < other ? other : one;
      if (enter > low) low = enter;
      if (leave < high) high = leave;
    } else if (from < 0.0 || from > end) {
      high = -1.0;
    }
  }
  line.first = low < MAX_STEPS ? (int)__builtin_ceil(low) : MAX_STEPS;
  line.last = high >= 0.0 ? (int)__builtin_floor(high) : -1;
  line.next = line.first;
  return line;
}

// Moves `next` to the first sample from there on that lies in a brick that is not empty; past `last` if none does.
static void advance(const VoxelGrid& grid, Line& line) {
  int k = line.next;
  while (k <= line.last) {
    int brick[3];
    for (int i = 0; i < 3; ++i) {
      const float at = line.from[i] + (float)k * line.by[i];
      int cell = at > 0.0f ? (int)at : 0;
      if (cell > grid.size[i] - 2) cell = grid.size[i] - 2;
      brick[i] = cell / VOXEL_BRICK;
    }
    if (grid.bricks[((int64_t)brick[2] * grid.bricks_across[1] + brick[1]) * grid.bricks_across[0] + brick[0]]) break;
    float exit = (float)line.last + 1.0f;
    for (int i = 0; i < 3; ++i) {
      if (line.by[i] == 0.0f) continue;
      const float side = (float)((brick[i] + (line.by[i] > 0.0f)) * VOXEL_BRICK);
      const float leave = (side - line.from[i]) / line.by[i];
      if (leave < exit) exit = leave;
    }
    const int there = (int)__builtin_ceilf(exit);
    k = there > k ? there : k + 1;
  }
  line.next = k;
}

// The LANES samples from k on in one grid.
struct Samples {
  int32_t corner[8][LANES];
  alignas(64) float fraction[3][LANES];
  int32_t cell[3][LANES];
  alignas(64) float density[LANES];
};

// Densities (zero outside), and all that colors need.
INLINE void look_up(const VoxelGrid& grid, const Line& line, int k, Samples& s) {
  vf lane;
  for (int l = 0; l < LANES; ++l) lane[l] = (float)l;
  const vf steps = lane + (float)k;
  vi inside = (steps >= (float)line.first) & (steps <= (float)line.last);
  vf at[3];
  for (int i = 0; i < 3; ++i) {
    at[i] = line.from[i] + steps * line.by[i];
    inside &= (at[i] >= 0.0f) & (at[i] < (float)(grid.size[i] - 1));
  }
  vf f[3];
  for (int i = 0; i < 3; ++i) {
    const vf place = where(inside, at[i]);
    const vi whole = __builtin_convertvector(place, vi);
    f[i] = place - __builtin_convertvector(whole, vf);
    store(s.fraction[i], f[i]);
    for (int l = 0; l < LANES; ++l) s.cell[i][l] = whole[l];
  }
  const int64_t nx = grid.size[0], plane = nx * grid.size[1];
  alignas(64) float value[8][LANES];
  for (int l = 0; l < LANES; ++l) {
    const int32_t* const base = grid.links + s.cell[2][l] * plane + s.cell[1][l] * nx + s.cell[0][l];
    for (int c = 0; c < 8; ++c) {
      const int32_t link = base[(c & 1) + (c >> 1 & 1) * nx + (c >> 2) * plane];
      s.corner[c][l] = link;
      const float density = grid.densities[link < 0 ? 0 : link];
      value[c][l] = link < 0 ? 0.0f : density;
    }
  }
  vf v[8];
  for (int c = 0; c < 8; ++c) v[c] = load(value[c]);
  for (int c = 0; c < 8; c += 2) v[c] = fma(f[0], v[c + 1] - v[c], v[c]);
  for (int c = 0; c < 8; c += 4) v[c] = fma(f[1], v[c + 2] - v[c], v[c]);
  const vf density = fma(f[2], v[4] - v[0], v[0]);
  store(s.density, where(inside & (density > LEAST_DENSITY), density));
}

INLINE float corner_weight(int c, float fx, float fy, float fz) {
  return (c & 1 ? fx : 1.0f - fx) * (c & 2 ? fy : 1.0f - fy) * (c & 4 ? fz : 1.0f - fz);
}

// max(0, 1/2 + SH) of one sample, in the first three lanes.
INLINE v4 color_of(const VoxelGrid& grid, const Samples& s, int l, const float* tile) {
  vf sum[ROW_VECTORS] = {};
  for (int c = 0; c < 8; ++c) {
    const int32_t link = s.corner[c][l];
    if (link < 0) continue;
    const float w = corner_weight(c, s.fraction[0][l], s.fraction[1][l], s.fraction[2][l]);
    const float* const row = grid.rows + (int64_t)link * VOXEL_ROW;
    for (int j = 0; j < ROW_VECTORS; ++j) sum[j] = fma(load(row + j * LANES), w, sum[j]);
  }
  vf channel[3] = {};
  for (int c = 0; c < 3; ++c)
    for (int j = 0; j < ROW_VECTORS; ++j)
      channel[c] = fma(load(tile + TILE_MIDDLE - VOXEL_SH * c + j * LANES), sum[j], channel[c]);
  v4 color = sums(channel[0], channel[1], channel[2], vf{}) + 0.5f;
  for (int c = 0; c < 3; ++c) color[c] = color[c] > 0.0f ? color[c] : color[c] <= 0.0f ? 0.0f : color[c];
  return color;
}

// Marches one ray; returns the number of samples kept. `kept`: null, or room for them (of one grid). `most`: null,
// or the largest weight that any ray gave each row so far (of one grid); colors are not computed then.
static int64_t march_ray(const March& march, const float* origin, const float* direction, float near, const float* tile,
                         float* color, float* alpha, VoxelSample* kept, float* most) {
  Line lines[MAX_GRIDS];
  Samples samples[MAX_GRIDS];
  float through = 1.0f;
  float rgb[3] = {0.0f, 0.0f, 0.0f};
  int64_t count = 0;
  int k = MAX_STEPS;
  for (int g = 0; g < march.count; ++g) {
    lines[g] = line_of(march.grids[g], march.step, origin, direction, near);
    advance(march.grids[g], lines[g]);
    if (lines[g].next <= lines[g].last && lines[g].next < k) k = lines[g].next;
  }
  while (k < MAX_STEPS) {
    vf depth = {};
    bool used[MAX_GRIDS];
    for (int g = 0; g < march.count; ++g) {
      used[g] = lines[g].next < k + LANES && lines[g].next <= lines[g].last;
      if (!used[g]) continue;
      look_up(march.grids[g], lines[g], k, samples[g]);
      depth += load(samples[g].density) * march.grids[g].depth;
    }
    uint32_t active = signs(depth > 0.0f);
    if (active) {
      alignas(64) float passes[LANES];
      store(passes, exp2(max(depth * -1.44269504f, set(-99.0f))));
      do {
        const int l = __builtin_ctz(active);
        active &= active - 1;
        if (active && !most && march.count == 1) {
          const int soon = __builtin_ctz(active);
          for (int c = 0; c < 8; ++c) {
            const int32_t link = samples[0].corner[c][soon];
            if (link < 0) continue;
            __builtin_prefetch(march.grids[0].rows + (int64_t)link * VOXEL_ROW);
            __builtin_prefetch(march.grids[0].rows + (int64_t)link * VOXEL_ROW + VOXEL_ROW / 2);
          }
        }
        const float behind = through * passes[l], weight = through - behind;
        v4 shade = {};
        if (most) {
          for (int c = 0; c < 8; ++c) {
            const int32_t link = samples[0].corner[c][l];
            if (link >= 0 && weight > most[link]) most[link] = weight;
          }
        } else if (march.count == 1) {
          shade = color_of(march.grids[0], samples[0], l, tile);
        } else {  // densities add, colors mix by density
          for (int g = 0; g < march.count; ++g) {
            if (!used[g] || !(samples[g].density[l] > 0.0f)) continue;
            const float share = samples[g].density[l] * march.grids[g].depth / depth[l];
            shade += share * color_of(march.grids[g], samples[g], l, tile);
          }
        }
        for (int c = 0; c < 3; ++c) rgb[c] += weight * shade[c];
        if (kept) {
          const Samples& s = samples[0];
          kept[count++] = {(uint16_t)s.cell[0][l],
                           (uint16_t)s.cell[1][l],
                           (uint16_t)s.cell[2][l],
                           0,
                           s.fraction[0][l],
                           s.fraction[1][l],
                           s.fraction[2][l],
                           weight,
                           behind,
                           {shade[0], shade[1], shade[2]}};
        }
        through = behind;
      } while (active && through >= LEAST_THROUGH);
      if (through < LEAST_THROUGH) break;
    }
    const int behind = k + LANES;
    k = MAX_STEPS;
    for (int g = 0; g < march.count; ++g) {
      if (lines[g].next < behind) {
        lines[g].next = behind;
        advance(march.grids[g], lines[g]);
      }
      if (lines[g].next <= lines[g].last && lines[g].next < k) k = lines[g].next;
    }
  }
  for (int c = 0; c < 3; ++c) color[c] = rgb[c];
  *alpha = 1.0f - through;
  return count;
}

// Adds the gradients of the samples of one patch to the rows of their corners.
static void scatter_voxels(const VoxelGrid& grid, const VoxelGradient* from, int64_t count, const float* tiles,
                           const VoxelArrays& to) {
  const int64_t nx = grid.size[0], plane = nx * grid.size[1];
  for (int64_t n = 0; n < count; ++n) {
    const VoxelGradient& g = from[n];
    const float* const tile = tiles + (int64_t)g.ray * VOXEL_TILE + TILE_MIDDLE;
    vf row[ROW_VECTORS];
    for (int j = 0; j < ROW_VECTORS; ++j) {
      vf sum = load(tile + j * LANES) * g.color[0];
      sum = fma(load(tile - VOXEL_SH + j * LANES), g.color[1], sum);
      row[j] = fma(load(tile - 2 * VOXEL_SH + j * LANES), g.color[2], sum);
    }
    const int32_t* const base = grid.links + g.z * plane + g.y * nx + g.x;
    for (int c = 0; c < 8; ++c) {
      const int32_t link = base[(c & 1) + (c >> 1 & 1) * nx + (c >> 2) * plane];
      if (link < 0) continue;
      const float w = corner_weight(c, g.fx, g.fy, g.fz);
      to.densities[link] += w * g.density;
      float* const at = to.rows + (int64_t)link * VOXEL_ROW;
      for (int j = 0; j < ROW_VECTORS; ++j) store(at + j * LANES, fma(row[j], w, load(at + j * LANES)));
    }
  }
}

// Adds the gradients of the total variation of `count` vertices from `begin` on, of densities (part 0) or of one half
// of the coefficients (1, 2), and returns its value: the sum over voxels and columns of factor * sqrt(1e-9 + sum of
// squared differences). The difference to a neighbour that is not there is zero.
static double voxel_variation(const VoxelGrid& grid, int64_t begin, int64_t count, float factor, float spread, int part,
                              const VoxelArrays& to) {
  const int64_t nx = grid.size[0], ny = grid.size[1], nz = grid.size[2], total = nx * ny * nz;
  constexpr int VECTORS = ROW_VECTORS / 2;
  double value = 0.0;
  for (int64_t n = 0; n < count; ++n) {
    const int64_t at = (begin + n) % total;
    const int32_t own = grid.links[at];
    if (own < 0) continue;
    const int64_t x = at % nx, y = at / nx % ny, z = at / (nx * ny);
    int32_t link[3];
    link[0] = x + 1 < nx ? grid.links[at + 1] : -1;
    link[1] = y + 1 < ny ? grid.links[at + nx] : -1;
    link[2] = z + 1 < nz ? grid.links[at + nx * ny] : -1;
    if (part == 0) {
      float apart[3], square = 1e-9f;
      for (int i = 0; i < 3; ++i) {
        apart[i] = link[i] < 0 ? 0.0f : (grid.densities[link[i]] - grid.densities[own]) * spread;
        square += apart[i] * apart[i];
      }
      const float root = __builtin_sqrtf(square);
      value += factor * root;
      for (int i = 0; i < 3; ++i) {
        if (link[i] < 0) continue;
        const float change = factor * spread / root * apart[i];
        to.densities[link[i]] += change;
        to.densities[own] -= change;
      }
      continue;
    }
    for (int v = 0; v < VECTORS; ++v) {
      const int64_t j = ((part - 1) * VECTORS + v) * LANES;
      const vf here = load(grid.rows + (int64_t)own * VOXEL_ROW + j);
      vf apart[3], square = set(1e-9f);
      for (int i = 0; i < 3; ++i) {
        apart[i] = link[i] < 0 ? vf{} : (load(grid.rows + (int64_t)link[i] * VOXEL_ROW + j) - here) * spread;
        square = fma(apart[i], apart[i], square);
      }
      const vf root = sqrt(square), slope = factor * spread / root;
      vf roots = root;
      for (int l = 0; l < LANES; ++l)
        if (j + l >= 3 * VOXEL_SH) roots[l] = 0.0f;
      value += factor * sum(roots);
      vf away = {};
      for (int i = 0; i < 3; ++i) {
        if (link[i] < 0) continue;
        const vf change = slope * apart[i];
        away += change;
        float* const there = to.rows + (int64_t)link[i] * VOXEL_ROW + j;
        store(there, load(there) + change);
      }
      float* const mine = to.rows + (int64_t)own * VOXEL_ROW + j;
      store(mine, load(mine) - away);
    }
  }
  return value;
}

// RMSProp on the voxels [begin, end) that have a gradient, which is cleared.
static void voxel_step(const VoxelArrays& values, const VoxelArrays& grads, const VoxelArrays& moments, int64_t begin,
                       int64_t end, float density_rate, float row_rate, float beta, float eps) {
  const Flush flush;
  for (int64_t n = begin; n < end; ++n) {
    const int64_t at = n * VOXEL_ROW;
    const float slope = grads.densities[n];
    if (slope != 0.0f) {
      const float before = moments.densities[n], square = slope * slope;
      const float moment = before == 0.0f ? square : (before - square) * beta + square;
      moments.densities[n] = moment;
      values.densities[n] -= density_rate * slope / (__builtin_sqrtf(moment) + eps);
      grads.densities[n] = 0.0f;
    }
    vi any = {};
    for (int j = 0; j < ROW_VECTORS; ++j) any |= (vi)load(grads.rows + at + j * LANES) & 0x7fffffff;
    if (signs(any != 0) == 0) continue;
    for (int j = 0; j < ROW_VECTORS; ++j) {
      const int64_t i = at + j * LANES;
      const vf grad = load(grads.rows + i), before = load(moments.rows + i), square = grad * grad;
      const vf usual = fma(before - square, set(beta), square);
      const vi fresh = before == 0.0f;
      const vf moment = (vf)(((vi)square & fresh) | ((vi)usual & ~fresh));
      store(moments.rows + i, moment);
      store(values.rows + i, load(values.rows + i) - row_rate * grad / (sqrt(moment) + eps));
      store(grads.rows + i, vf{});
    }
  }
}

}  // namespace ECONGS_ISA
