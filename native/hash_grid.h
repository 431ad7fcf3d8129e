// Lookup in binary hash grids with four values per entry (econgs/codec/hash_grid.py), and noise of one step
// (econgs/codec/model.py).
#pragma once

#include <cstdint>

namespace econgs {

struct HashGrid {
  const float* table;     // entries x 4, of which the signs count
  const int32_t* index;   // vertices x positions: entry, over all levels
  const float* weights;   // vertices x positions
  const int64_t* rows;    // indices of positions; null: all
  int64_t positions, count;
  int levels;
  const int* corners;     // per level: 8 (volume) or 4 (plane)
  const int64_t* sizes;   // per level: entries
};

// out: count x levels x 4; positive: per level, how many of its values are +1.
void hash_grid(const HashGrid& grid, float* out, int64_t* positive);
// to: entries x 4, from the gradient of out plus a constant per level for all its values.
void hash_grid_backward(const HashGrid& grid, const float* grad, const float* constant, float* to);

// Columns of `width` values in `groups` equal parts, each with a step of its own, steps `stride` apart per row.
struct NoiseShape {
  int64_t count;
  int width, groups, stride;
};
void add_noise(const NoiseShape& shape, const float* values, const float* noise, const float* steps, float* out);
// to_steps: count x groups.
void add_noise_backward(const NoiseShape& shape, const float* grad, const float* noise, float* to_steps);

}  // namespace econgs
