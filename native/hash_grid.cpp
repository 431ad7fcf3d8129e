// Lookup in binary hash grids (econgs/context/hash_grid.py), forward and backward, four values per entry.
// Plain 4-float vectors: the work is fetching, which wider vectors would not hasten.
#include "hash_grid.h"

#include <algorithm>
#include <cstring>

#include "raster.h"
#include "threads.h"

namespace econgs {
namespace {

typedef float v4 __attribute__((vector_size(16)));
typedef int32_t i4 __attribute__((vector_size(16)));
typedef float v4_unaligned __attribute__((vector_size(16), aligned(4), may_alias));

// The sign bits of four values as flips of a weight's sign, for each of the 16 cases.
struct Flips {
  i4 of[16];
  Flips() {
    for (int bits = 0; bits < 16; ++bits)
      for (int k = 0; k < 4; ++k) of[bits][k] = bits >> k & 1 ? INT32_MIN : 0;
  }
};
const Flips flips;

template <int CORNERS>
inline v4 gather(const uint8_t* negative, const int32_t* index, const float* weights) {
  v4 sum = {};
  for (int c = 0; c < CORNERS; ++c) {
    const float w = weights[c];
    sum += (v4)((i4)v4{w, w, w, w} ^ flips.of[negative[index[c]]]);
  }
  return sum;
}

template <int CORNERS>
inline void scatter(float* to, const int32_t* index, const float* weights, v4 grad) {
  for (int c = 0; c < CORNERS; ++c) {
    v4_unaligned* const at = (v4_unaligned*)(to + 4 * static_cast<int64_t>(index[c]));
    *at += grad * weights[c];
  }
}

}  // namespace

void hash_grid(const HashGrid& grid, float* out) {
  Buffer packed(grid.entries);
  uint8_t* const negative = packed.as<uint8_t>();
  parallel_ranges(grid.entries, 16384, [&](int64_t begin, int64_t end, int) {
    for (int64_t e = begin; e < end; ++e) {
      const float* const p = grid.table + 4 * e;
      negative[e] = static_cast<uint8_t>((p[0] >= 0 ? 0 : 1) | (p[1] >= 0 ? 0 : 2) | (p[2] >= 0 ? 0 : 4) | (p[3] >= 0 ? 0 : 8));
    }
  });
  parallel_ranges(grid.count, 256, [&](int64_t begin, int64_t end, int) {
    for (int64_t m = begin; m < end; ++m) {
      const int64_t row = grid.rows ? grid.rows[m] : m;
      const int32_t* index = grid.index + row * grid.vertices;
      const float* weights = grid.weights + row * grid.vertices;
      float* to = out + m * grid.levels * 4;
      for (int l = 0; l < grid.levels; ++l, to += 4) {
        const int corners = grid.corners[l];
        *(v4_unaligned*)to =
            corners == 8 ? gather<8>(negative, index, weights) : gather<4>(negative, index, weights);
        index += corners;
        weights += corners;
      }
    }
  });
}

// A level's entries belong to one thread, which takes the rows in order: the sums do not depend on the threads.
void hash_grid_backward(const HashGrid& grid, const float* grad, float* to) {
  parallel(grid.levels, [&](int64_t level, int) {
    int64_t vertex = 0, begin = 0;
    for (int l = 0; l < level; ++l) {
      vertex += grid.corners[l];
      begin += grid.sizes[l];
    }
    const int64_t end = begin + grid.sizes[level];
    const int corners = grid.corners[level];
    std::memset(to + 4 * begin, 0, sizeof(float) * 4 * (end - begin));
    for (int64_t m = 0; m < grid.count; ++m) {
      const int64_t at = (grid.rows ? grid.rows[m] : m) * grid.vertices + vertex;
      const v4 outer = (v4) * (const v4_unaligned*)(grad + (m * grid.levels + level) * 4);
      if (corners == 8)
        scatter<8>(to, grid.index + at, grid.weights + at, outer);
      else
        scatter<4>(to, grid.index + at, grid.weights + at, outer);
    }
    for (int64_t i = 4 * begin; i < 4 * end; ++i) {
      const float p = grid.table[i];
      to[i] = p >= -1 && p <= 1 ? to[i] : 0;  // straight through where |p| <= 1
    }
  });
}

}  // namespace econgs
