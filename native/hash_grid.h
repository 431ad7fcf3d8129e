// Lookup in binary hash grids with four values per entry (econgs/context/hash_grid.py).
#pragma once

#include <cstdint>

namespace econgs {

struct HashGrid {
  const float* table;     // entries x 4, of which the signs count
  const int32_t* index;   // positions x vertices: entry, over all levels
  const float* weights;   // positions x vertices
  const int64_t* rows;    // of the positions asked for; may be null: all
  int64_t entries, vertices, count;
  int levels;
  const int* corners;     // per level: 8 (volume) or 4 (plane)
  const int64_t* sizes;   // per level: entries
};

void hash_grid(const HashGrid& grid, float* out);                            // count x levels x 4
void hash_grid_backward(const HashGrid& grid, const float* grad, float* to);  // to: entries x 4

}  // namespace econgs
