// Colors from real spherical harmonics, max(0, 1/2 + sum c_k Y_k(d)), and their gradients.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace ECONGS_ISA {

// Y_k and, where asked for, its partial derivatives with respect to an unconstrained direction.
INLINE void harmonics(int degree, float x, float y, float z, float* Y, float* X, float* D, float* Z, bool slopes) {
  Y[0] = 0.28209479f;
  if (slopes) X[0] = D[0] = Z[0] = 0.0f;
  if (degree < 1) return;
  const float c1 = 0.48860251f;
  Y[1] = -c1 * y; Y[2] = c1 * z; Y[3] = -c1 * x;
  if (slopes) {
    X[1] = 0; D[1] = -c1; Z[1] = 0;
    X[2] = 0; D[2] = 0; Z[2] = c1;
    X[3] = -c1; D[3] = 0; Z[3] = 0;
  }
  if (degree < 2) return;
  const float c2 = 1.09254843f, c20 = 0.31539157f, c22 = 0.54627422f;
  Y[4] = c2 * x * y; Y[5] = -c2 * y * z; Y[6] = c20 * (2 * z * z - x * x - y * y); Y[7] = -c2 * x * z;
  Y[8] = c22 * (x * x - y * y);
  if (slopes) {
    X[4] = c2 * y; D[4] = c2 * x; Z[4] = 0;
    X[5] = 0; D[5] = -c2 * z; Z[5] = -c2 * y;
    X[6] = -2 * c20 * x; D[6] = -2 * c20 * y; Z[6] = 4 * c20 * z;
    X[7] = -c2 * z; D[7] = 0; Z[7] = -c2 * x;
    X[8] = 2 * c22 * x; D[8] = -2 * c22 * y; Z[8] = 0;
  }
  if (degree < 3) return;
  const float c33 = 0.59004359f, c32 = 2.89061144f, c31 = 0.45704580f, c30 = 0.37317633f, c3 = 1.44530572f;
  const float xx = x * x, yy = y * y, zz = z * z;
  Y[9] = -c33 * y * (3 * xx - yy); Y[10] = c32 * x * y * z; Y[11] = -c31 * y * (4 * zz - xx - yy);
  Y[12] = c30 * z * (2 * zz - 3 * xx - 3 * yy); Y[13] = -c31 * x * (4 * zz - xx - yy);
  Y[14] = c3 * z * (xx - yy); Y[15] = -c33 * x * (xx - 3 * yy);
  if (slopes) {
    X[9] = -6 * c33 * x * y; D[9] = -3 * c33 * (xx - yy); Z[9] = 0;
    X[10] = c32 * y * z; D[10] = c32 * x * z; Z[10] = c32 * x * y;
    X[11] = 2 * c31 * x * y; D[11] = -c31 * (4 * zz - xx - 3 * yy); Z[11] = -8 * c31 * y * z;
    X[12] = -6 * c30 * x * z; D[12] = -6 * c30 * y * z; Z[12] = c30 * (6 * zz - 3 * xx - 3 * yy);
    X[13] = -c31 * (4 * zz - 3 * xx - yy); D[13] = 2 * c31 * x * y; Z[13] = -8 * c31 * x * z;
    X[14] = 2 * c3 * x * z; D[14] = -2 * c3 * y * z; Z[14] = c3 * (xx - yy);
    X[15] = -3 * c33 * (xx - yy); D[15] = 6 * c33 * x * y; Z[15] = 0;
  }
}

INLINE float toward(const float* mean, const float* position, float* d) {
  float length = 0.0f;
  for (int k = 0; k < 3; ++k) {
    d[k] = mean[k] - position[k];
    length += d[k] * d[k];
  }
  length = __builtin_sqrtf(length);
  const float inverse = length > 0.0f ? 1.0f / length : 0.0f;  // a mean in the eye has no direction
  for (int k = 0; k < 3; ++k) d[k] *= inverse;
  return inverse;
}

static void sh(int degree, int bands, const float* means, const float* position, const float* coefficients,
               float* colors, int64_t begin, int64_t end) {
  const int used = (degree + 1) * (degree + 1);
  for (int64_t n = begin; n < end; ++n) {
    float d[3], Y[16];
    toward(means + 3 * n, position, d);
    harmonics(degree, d[0], d[1], d[2], Y, nullptr, nullptr, nullptr, false);
    const float* const c = coefficients + n * bands * 3;
    float r = 0.5f, g = 0.5f, b = 0.5f;
    for (int k = 0; k < used; ++k) {
      r += Y[k] * c[3 * k];
      g += Y[k] * c[3 * k + 1];
      b += Y[k] * c[3 * k + 2];
    }
    colors[3 * n] = r > 0.0f ? r : r <= 0.0f ? 0.0f : r;  // NaN stays NaN, to be refused by name later
    colors[3 * n + 1] = g > 0.0f ? g : g <= 0.0f ? 0.0f : g;
    colors[3 * n + 2] = b > 0.0f ? b : b <= 0.0f ? 0.0f : b;
  }
}

static void sh_backward(int degree, int bands, const float* means, const float* position,
                        const float* coefficients, const float* colors, const float* grad, float* grad_means,
                        float* grad_coefficients, int64_t begin, int64_t end) {
  const int used = (degree + 1) * (degree + 1);
  for (int64_t n = begin; n < end; ++n) {
    float* const out = grad_coefficients + n * bands * 3;
    float* const mean = grad_means + 3 * n;
    float g[3];
    for (int k = 0; k < 3; ++k) g[k] = colors[3 * n + k] > 0.0f ? grad[3 * n + k] : 0.0f;
    if (g[0] == 0.0f && g[1] == 0.0f && g[2] == 0.0f) {  // not visible in this view
      for (int k = 0; k < 3 * bands; ++k) out[k] = 0.0f;
      mean[0] = mean[1] = mean[2] = 0.0f;
      continue;
    }
    float d[3], Y[16], X[16], D[16], Z[16];
    const float inverse = toward(means + 3 * n, position, d);
    harmonics(degree, d[0], d[1], d[2], Y, X, D, Z, true);
    const float* const c = coefficients + n * bands * 3;
    float dx = 0, dy = 0, dz = 0;
    for (int k = 0; k < used; ++k) {
      const float through = c[3 * k] * g[0] + c[3 * k + 1] * g[1] + c[3 * k + 2] * g[2];
      dx += through * X[k];
      dy += through * D[k];
      dz += through * Z[k];
      out[3 * k] = Y[k] * g[0];
      out[3 * k + 1] = Y[k] * g[1];
      out[3 * k + 2] = Y[k] * g[2];
    }
    for (int k = 3 * used; k < 3 * bands; ++k) out[k] = 0.0f;
    const float along = dx * d[0] + dy * d[1] + dz * d[2];
    mean[0] = (dx - along * d[0]) * inverse;
    mean[1] = (dy - along * d[1]) * inverse;
    mean[2] = (dz - along * d[2]) * inverse;
  }
}

}  // namespace ECONGS_ISA
