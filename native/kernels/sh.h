// Colors from real spherical harmonics, max(0, 1/2 + sum c_k Y_k(d)), and their gradients.
#pragma once

#include "simd.h"
#include "table.h"

namespace ECONGS_ISA {

using namespace econgs;

// Y_k and, with `slopes`, its partial derivatives with respect to an unconstrained direction.
INLINE void harmonics(int degree, vf x, vf y, vf z, vf* Y, vf* X, vf* D, vf* Z, bool slopes) {
  const auto slope = [&](int k, vf along_x, vf along_y, vf along_z) __attribute__((always_inline)) {
    if (!slopes) return;
    X[k] = along_x;
    D[k] = along_y;
    Z[k] = along_z;
  };
  Y[0] = set(0.28209479f);
  slope(0, vf{}, vf{}, vf{});
  if (degree < 1) return;
  const float c1 = 0.48860251f;
  Y[1] = -c1 * y;
  Y[2] = c1 * z;
  Y[3] = -c1 * x;
  slope(1, vf{}, set(-c1), vf{});
  slope(2, vf{}, vf{}, set(c1));
  slope(3, set(-c1), vf{}, vf{});
  if (degree < 2) return;
  const float c2 = 1.09254843f, c20 = 0.31539157f, c22 = 0.54627422f;
  Y[4] = c2 * x * y;
  Y[5] = -c2 * y * z;
  Y[6] = c20 * (2.0f * z * z - x * x - y * y);
  Y[7] = -c2 * x * z;
  Y[8] = c22 * (x * x - y * y);
  slope(4, c2 * y, c2 * x, vf{});
  slope(5, vf{}, -c2 * z, -c2 * y);
  slope(6, -2.0f * c20 * x, -2.0f * c20 * y, 4.0f * c20 * z);
  slope(7, -c2 * z, vf{}, -c2 * x);
  slope(8, 2.0f * c22 * x, -2.0f * c22 * y, vf{});
  if (degree < 3) return;
  const float c33 = 0.59004359f, c32 = 2.89061144f, c31 = 0.45704580f, c30 = 0.37317633f, c3 = 1.44530572f;
  const vf xx = x * x, yy = y * y, zz = z * z;
  Y[9] = -c33 * y * (3.0f * xx - yy);
  Y[10] = c32 * x * y * z;
  Y[11] = -c31 * y * (4.0f * zz - xx - yy);
  Y[12] = c30 * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  Y[13] = -c31 * x * (4.0f * zz - xx - yy);
  Y[14] = c3 * z * (xx - yy);
  Y[15] = -c33 * x * (xx - 3.0f * yy);
  slope(9, -6.0f * c33 * x * y, -3.0f * c33 * (xx - yy), vf{});
  slope(10, c32 * y * z, c32 * x * z, c32 * x * y);
  slope(11, 2.0f * c31 * x * y, -c31 * (4.0f * zz - xx - 3.0f * yy), -8.0f * c31 * y * z);
  slope(12, -6.0f * c30 * x * z, -6.0f * c30 * y * z, c30 * (6.0f * zz - 3.0f * xx - 3.0f * yy));
  slope(13, -c31 * (4.0f * zz - 3.0f * xx - yy), 2.0f * c31 * x * y, -8.0f * c31 * x * z);
  slope(14, 2.0f * c3 * x * z, -2.0f * c3 * y * z, c3 * (xx - yy));
  slope(15, -3.0f * c33 * (xx - yy), 6.0f * c33 * x * y, vf{});
}

// Unit directions from the camera to Gaussians [start, start + LANES); lanes past the end repeat the last one.
struct Directions {
  vf x, y, z, inverse;  // 1 / distance; 0 for a mean in the eye, which has no direction
};

INLINE Directions toward(const float* means, const float* position, int64_t start, int64_t end) {
  float d[3][LANES];
  for (int l = 0; l < LANES; ++l) {
    const int64_t n = start + l < end ? start + l : end - 1;
    for (int k = 0; k < 3; ++k) d[k][l] = means[3 * n + k] - position[k];
  }
  Directions to = {load(d[0]), load(d[1]), load(d[2]), vf{}};
  const vf length = sqrt(to.x * to.x + to.y * to.y + to.z * to.z);
  to.inverse = length > vf{} ? 1.0f / length : vf{};
  to.x *= to.inverse;
  to.y *= to.inverse;
  to.z *= to.inverse;
  return to;
}

// Harmonics are evaluated for LANES Gaussians at a time; then each Gaussian's row of coefficients is walked with
// 4-vectors, of which the fourth lane belongs to the next coefficient and counts for nothing.
static void sh(int degree, const Coefficients& in, const float* means, const float* position, float* colors,
               int64_t begin, int64_t end) {
  const int used = (degree + 1) * (degree + 1);
  for (int64_t start = begin; start < end; start += LANES) {
    const Directions to = toward(means, position, start, end);
    vf Y[16];
    harmonics(degree, to.x, to.y, to.z, Y, nullptr, nullptr, nullptr, false);
    const float* const y = (const float*)Y;
    for (int l = 0; l < LANES && start + l < end; ++l) {
      const int64_t n = start + l;
      v4 color = 0.5f + y[l] * load3(in.first + n * in.first_stride);
      if (used > 1) {
        const float* const c = in.rest + n * in.rest_stride;
        for (int k = 1; k < used - 1; ++k) color += y[k * LANES + l] * load4(c + 3 * (k - 1));
        color += y[(used - 1) * LANES + l] * load3(c + 3 * (used - 2));
      }
      for (int k = 0; k < 3; ++k)  // NaN stays NaN, to be refused by name later
        colors[3 * n + k] = color[k] > 0.0f ? color[k] : color[k] <= 0.0f ? 0.0f : color[k];
    }
  }
}

static void sh_backward(int degree, const Coefficients& in, const float* means, const float* position,
                        const float* colors, const float* grad, float* grad_means, const MutableCoefficients& out,
                        int64_t begin, int64_t end) {
  const int used = (degree + 1) * (degree + 1), rest = out.rest ? in.rest_bands : 0;
  for (int64_t start = begin; start < end; start += LANES) {
    const Directions to = toward(means, position, start, end);
    vf Y[16], X[16], D[16], Z[16];
    harmonics(degree, to.x, to.y, to.z, Y, X, D, Z, true);
    const float *const y = (const float*)Y, *const slope_x = (const float*)X, *const slope_y = (const float*)D,
                       *const slope_z = (const float*)Z;
    for (int l = 0; l < LANES && start + l < end; ++l) {
      const int64_t n = start + l;
      float* const mean = grad_means + 3 * n;
      float* const to_first = out.first + n * in.first_stride;
      float* const to_rest = out.rest + n * in.rest_stride;
      v4 g = load3(grad + 3 * n);
      for (int k = 0; k < 3; ++k) g[k] = colors[3 * n + k] > 0.0f ? g[k] : 0.0f;
      if (g[0] == 0.0f && g[1] == 0.0f && g[2] == 0.0f) {  // not visible in this view
        for (int k = 0; k < 3; ++k) to_first[k] = mean[k] = 0.0f;
        for (int k = 0; k < 3 * rest; ++k) to_rest[k] = 0.0f;
        continue;
      }
      for (int k = 0; k < 3; ++k) to_first[k] = y[l] * g[k];
      v4 dx = {}, dy = {}, dz = {};
      const float* const c = in.rest + n * in.rest_stride;
      for (int k = 1; k < used; ++k) {
        const int at = k * LANES + l;
        const v4 through = (k < used - 1 ? load4(c + 3 * (k - 1)) : load3(c + 3 * (k - 1))) * g;
        dx += slope_x[at] * through;
        dy += slope_y[at] * through;
        dz += slope_z[at] * through;
      }
      // Each store of four spills one float into the next coefficient, which is written afterwards.
      for (int k = 1; k < used - 1; ++k) *(v4_unaligned*)(to_rest + 3 * (k - 1)) = y[k * LANES + l] * g;
      if (used > 1)
        for (int k = 0; k < 3; ++k) to_rest[3 * (used - 2) + k] = y[(used - 1) * LANES + l] * g[k];
      for (int k = 3 * (used - 1); k < 3 * rest; ++k) to_rest[k] = 0.0f;
      const float slope[3] = {dx[0] + dx[1] + dx[2], dy[0] + dy[1] + dy[2], dz[0] + dz[1] + dz[2]};
      const float d[3] = {to.x[l], to.y[l], to.z[l]};
      const float along = slope[0] * d[0] + slope[1] * d[1] + slope[2] * d[2];
      for (int k = 0; k < 3; ++k) mean[k] = (slope[k] - along * d[k]) * to.inverse[l];
    }
  }
}

}  // namespace ECONGS_ISA
