// Lookup in binary hash grids (econgs/codec/hash_grid.py), forward and backward, four values per entry.
// Plain 4-float vectors: the work is fetching, which wider vectors would not hasten.
#include "hash_grid.h"

#include <cstring>
#include <vector>

#include "runtime.h"

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

// Index and weights of one position's vertices lie `stride` apart.
template <int CORNERS>
inline v4 gather(const uint8_t* negative, const int32_t* index, const float* weights, int64_t stride) {
  v4 sum = {};
  for (int c = 0; c < CORNERS; ++c) {
    const float w = weights[c * stride];
    sum += (v4)((i4)v4{w, w, w, w} ^ flips.of[negative[index[c * stride]]]);
  }
  return sum;
}

template <int CORNERS>
inline void scatter(float* to, const int32_t* index, const float* weights, int64_t stride, v4 grad) {
  for (int c = 0; c < CORNERS; ++c) {
    v4_unaligned* const at = (v4_unaligned*)(to + 4 * static_cast<int64_t>(index[c * stride]));
    *at += grad * weights[c * stride];
  }
}

// First entry and first vertex of each level, and of what would follow the last.
struct Starts {
  std::vector<int64_t> entry{0}, vertex{0};
  explicit Starts(const HashGrid& grid) {
    for (int l = 0; l < grid.levels; ++l) {
      entry.push_back(entry.back() + grid.sizes[l]);
      vertex.push_back(vertex.back() + grid.corners[l]);
    }
  }
};

}  // namespace

void hash_grid(const HashGrid& grid, float* out, int64_t* positive) {
  const Starts starts(grid);
  Buffer packed(starts.entry.back());
  uint8_t* const negative = packed.as<uint8_t>();
  parallel(grid.levels, [&](int64_t level, int) {
    int64_t below = 0;
    for (int64_t e = starts.entry[level]; e < starts.entry[level + 1]; ++e) {
      const float* const p = grid.table + 4 * e;
      const int bits = (p[0] >= 0 ? 0 : 1) | (p[1] >= 0 ? 0 : 2) | (p[2] >= 0 ? 0 : 4) | (p[3] >= 0 ? 0 : 8);
      negative[e] = static_cast<uint8_t>(bits);
      below += (bits & 1) + (bits >> 1 & 1) + (bits >> 2 & 1) + (bits >> 3);
    }
    positive[level] = 4 * grid.sizes[level] - below;
  });
  const int64_t n = grid.positions;
  parallel_ranges(grid.count, 512, [&](int64_t begin, int64_t end, int) {
    for (int l = 0; l < grid.levels; ++l) {
      const int32_t* const index = grid.index + starts.vertex[l] * n;
      const float* const weights = grid.weights + starts.vertex[l] * n;
      for (int64_t m = begin; m < end; ++m) {
        const int64_t row = grid.rows ? grid.rows[m] : m;
        *(v4_unaligned*)(out + (m * grid.levels + l) * 4) = grid.corners[l] == 8
                                                                ? gather<8>(negative, index + row, weights + row, n)
                                                                : gather<4>(negative, index + row, weights + row, n);
      }
    }
  });
}

// A level's entries belong to one thread, which takes the rows in order: the sums do not depend on the threads.
void hash_grid_backward(const HashGrid& grid, const float* grad, const float* constant, float* to) {
  const Starts starts(grid);
  const int64_t n = grid.positions;
  parallel(grid.levels, [&](int64_t level, int) {
    const int64_t begin = starts.entry[level], end = starts.entry[level + 1];
    std::memset(to + 4 * begin, 0, sizeof(float) * 4 * (end - begin));
    const int32_t* const index = grid.index + starts.vertex[level] * n;
    const float* const weights = grid.weights + starts.vertex[level] * n;
    for (int64_t m = 0; m < grid.count; ++m) {
      const int64_t row = grid.rows ? grid.rows[m] : m;
      const v4 outer = (v4) * (const v4_unaligned*)(grad + (m * grid.levels + level) * 4);
      if (grid.corners[level] == 8) scatter<8>(to, index + row, weights + row, n, outer);
      else scatter<4>(to, index + row, weights + row, n, outer);
    }
    const float each = constant[level];
    for (int64_t i = 4 * begin; i < 4 * end; ++i) {
      const float p = grid.table[i];
      to[i] = p >= -1 && p <= 1 ? to[i] + each : 0;  // straight through where |p| <= 1
    }
  });
}

void add_noise(const NoiseShape& shape, const float* values, const float* noise, const float* steps, float* out) {
  const int part = shape.width / shape.groups;
  parallel_ranges(shape.count, 1024, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; ++i)
      for (int g = 0; g < shape.groups; ++g) {
        const float step = steps[i * shape.stride + g];
        const int64_t at = i * shape.width + g * part;
        for (int k = 0; k < part; ++k) out[at + k] = values[at + k] + step * noise[at + k];
      }
  });
}

void add_noise_backward(const NoiseShape& shape, const float* grad, const float* noise, float* to_steps) {
  const int part = shape.width / shape.groups;
  parallel_ranges(shape.count, 1024, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; ++i)
      for (int g = 0; g < shape.groups; ++g) {
        const int64_t at = i * shape.width + g * part;
        v4 sum = {};
        int k = 0;
        for (; k + 4 <= part; k += 4)
          sum += (v4) * (const v4_unaligned*)(grad + at + k) * (v4) * (const v4_unaligned*)(noise + at + k);
        float total = (sum[0] + sum[2]) + (sum[1] + sum[3]);
        for (; k < part; ++k) total += grad[at + k] * noise[at + k];
        to_steps[i * shape.groups + g] = total;
      }
  });
}

}  // namespace econgs
