// Pictures over a background, and gradients by their alpha.
#pragma once

#include "simd.h"
#include "table.h"

namespace ECONGS_ISA {

// As `fma` of vectors: rounded once where the ISA can. The compiler vectorises the loops.
INLINE float fused(float a, float b, float c) {
#ifdef __FMA__
  return __builtin_fmaf(a, b, c);
#else
  return a * b + c;
#endif
}

template <int COLORS, int ALPHAS>
INLINE void over(const float* color, const float* alpha, const float* back, float* to, int64_t pixels) {
  const float red = back[0], green = back[1], blue = back[2];
  for (int64_t i = 0; i < pixels; ++i) {
    const float clear = 1.0f - alpha[i * ALPHAS];
    to[3 * i] = fused(clear, red, color[i * COLORS]);
    to[3 * i + 1] = fused(clear, green, color[i * COLORS + 1]);
    to[3 * i + 2] = fused(clear, blue, color[i * COLORS + 2]);
  }
}

static void composite(const float* color, const float* alpha, const float* truth, const float* back, float* drawn,
                      float* target, int64_t pixels) {
  over<3, 1>(color, alpha, back, drawn, pixels);
  over<4, 4>(truth, truth + 3, back, target, pixels);
}

static void alpha_sums(const float* alpha, const float* truth, int64_t pixels, double* sums) {
  double drawn = 0.0, there = 0.0, apart = 0.0;
  for (int64_t i = 0; i < pixels; ++i) {
    drawn += alpha[i];
    there += truth[4 * i + 3];
    apart += __builtin_fabsf(alpha[i] - truth[4 * i + 3]);
  }
  sums[0] = drawn;
  sums[1] = there;
  sums[2] = apart;
}

static void alpha_gradient(const float* grad, const float* alpha, const float* truth, const float* back, float weight,
                           float* to, int64_t pixels) {
  const float red = back[0], green = back[1], blue = back[2];
  for (int64_t i = 0; i < pixels; ++i) {
    const float apart = alpha[i] - truth[4 * i + 3];
    const float own = apart > 0.0f ? weight : apart < 0.0f ? -weight : 0.0f;
    to[i] = own - (grad[3 * i] * red + grad[3 * i + 1] * green + grad[3 * i + 2] * blue);
  }
}

}  // namespace ECONGS_ISA
