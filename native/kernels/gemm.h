// Products of small matrices that lie in the cache: lanes along the columns of the right-hand matrix.
#pragma once

#include "simd.h"

namespace ECONGS_ISA {

// What becomes of a sum: BIAS starts it from a row, RELU cuts it off after that, ADD adds it to what was there,
// GATE keeps it where `gate` is positive.
enum Finish { PLAIN, BIAS, RELU, ADD, GATE };

struct Left {
  const float* p;
  int64_t row, column;  // strides: a matrix or its transpose
};

template <int ROWS, int VECTORS, Finish FINISH>
INLINE void product_tile(int depth, const Left& a, const float* b, int64_t b_stride, float* c, int64_t c_stride,
                         const float* extra) {
  vf sum[ROWS][VECTORS];
  for (int r = 0; r < ROWS; ++r)
    for (int v = 0; v < VECTORS; ++v) sum[r][v] = FINISH == BIAS || FINISH == RELU ? load(extra + v * LANES) : vf{};
  const float* left = a.p;
  for (int k = 0; k < depth; ++k, left += a.column, b += b_stride) {
    vf right[VECTORS];
    for (int v = 0; v < VECTORS; ++v) right[v] = load(b + v * LANES);
    for (int r = 0; r < ROWS; ++r) {
      const vf one = set(left[r * a.row]);
      for (int v = 0; v < VECTORS; ++v) sum[r][v] = fma(one, right[v], sum[r][v]);
    }
  }
  for (int r = 0; r < ROWS; ++r)
    for (int v = 0; v < VECTORS; ++v) {
      float* const to = c + r * c_stride + v * LANES;
      vf value = sum[r][v];
      if (FINISH == RELU) value = max(value, vf{});
      if (FINISH == ADD) value += load(to);
      if (FINISH == GATE) value = load(extra + r * c_stride + v * LANES) > vf{} ? value : vf{};
      store(to, value);
    }
}

template <int VECTORS, Finish FINISH>
static void product_columns(int rows, int depth, Left a, const float* b, int64_t b_stride, float* c, int64_t c_stride,
                            const float* extra) {
  while (rows > 0) {
    // Never one row alone where it can be helped: its few sums would wait for each other.
    const int take = rows >= 8 || rows == 4 || rows == 7 ? 4 : rows >= 5 ? 3 : rows;
    switch (take) {
      case 4: product_tile<4, VECTORS, FINISH>(depth, a, b, b_stride, c, c_stride, extra); break;
      case 3: product_tile<3, VECTORS, FINISH>(depth, a, b, b_stride, c, c_stride, extra); break;
      case 2: product_tile<2, VECTORS, FINISH>(depth, a, b, b_stride, c, c_stride, extra); break;
      default: product_tile<1, VECTORS, FINISH>(depth, a, b, b_stride, c, c_stride, extra);
    }
    rows -= take;
    a.p += take * a.row;
    c += take * c_stride;
    if (FINISH == GATE) extra += take * c_stride;
  }
}

// c (rows x columns) = a (rows x depth) b (depth x columns); columns are rounded up to whole vectors, which the pads
// of b, c and extra must allow. `extra`: the bias, or the gate with the stride of c.
template <Finish FINISH>
static void product(int rows, int columns, int depth, const Left& a, const float* b, int64_t b_stride, float* c,
                    int64_t c_stride, const float* extra) {
  for (int left = (columns + LANES - 1) / LANES; left > 0;) {
    const int take = left == 4 || left == 2 ? 2 : left >= 3 ? 3 : 1;
    if (take == 3) product_columns<3, FINISH>(rows, depth, a, b, b_stride, c, c_stride, extra);
    else if (take == 2) product_columns<2, FINISH>(rows, depth, a, b, b_stride, c, c_stride, extra);
    else product_columns<1, FINISH>(rows, depth, a, b, b_stride, c, c_stride, extra);
    left -= take;
    b += take * LANES;
    c += take * LANES;
    if (extra) extra += take * LANES;
  }
}

}  // namespace ECONGS_ISA
