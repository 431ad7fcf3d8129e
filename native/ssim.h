// SSIM of two H x W x C images (Wang et al. 2004; 11 x 11 window, sigma 1.5, zero padding) and its gradient.
//
// The window is separable and channels lie side by side, so a row is one array of n = W * C floats and the
// horizontal filter has a stride of C. Filtering s = x + y and d = x - y and their squares gives all that SSIM
// needs of x and y from four sums instead of five. Images are shifted by -1/2 (padding included), which changes no
// variance but spares float most of the cancellation in flat bright regions. Three sweeps over rows, each row on its own:
//   1 filter along the row: s, d, s^2, d^2
//   2 filter down, SSIM and its partial derivatives by mean, square and product, filter these along the row
//   3 filter these down and put the gradient together
#pragma once

#include "kernels.h"
#include "simd.h"

namespace ECONGS_ISA {

using namespace econgs;

constexpr int TAPS = 2 * SSIM_RADIUS + 1;
// exp(-k^2 / 4.5) / sum, k = 0..5
constexpr float TAP[SSIM_RADIUS + 1] = {0.26601172f, 0.21300553f, 0.10936069f, 0.036000773f, 0.0075987582f,
                                        0.0010283801f};

INLINE vf along(const float* p, int stride) {
  vf r = TAP[0] * load(p);
  for (int k = 1; k <= SSIM_RADIUS; ++k) r = fma(load(p - k * stride) + load(p + k * stride), set(TAP[k]), r);
  return r;
}

// The padding of s, d, s^2 and d^2 after the shift.
constexpr float PADDING[4] = {-1.0f, 0.0f, 1.0f, 0.0f};

// Rows outside the image have null pointers and hold `outside` throughout.
INLINE vf down(const float* const* rows, int64_t i, float outside) {
  vf r = {};
  for (int k = 0; k < TAPS; ++k)
    r = fma(rows[k] ? load(rows[k] + i) : set(outside),
            set(TAP[k < SSIM_RADIUS ? SSIM_RADIUS - k : k - SSIM_RADIUS]), r);
  return r;
}

INLINE vf down_inside(const float* const* rows, int64_t i) {
  vf r = TAP[0] * load(rows[SSIM_RADIUS] + i);
  for (int k = 1; k <= SSIM_RADIUS; ++k)
    r = fma(load(rows[SSIM_RADIUS - k] + i) + load(rows[SSIM_RADIUS + k] + i), set(TAP[k]), r);
  return r;
}

// Rows of all planes are padded to a multiple of LANES by the caller's `pitch`.
INLINE int64_t pitch(int64_t n) { return (n + 15) / 16 * 16; }

INLINE bool neighbours(const float* plane, int64_t stride, int64_t height, int64_t row, const float** rows) {
  for (int k = 0; k < TAPS; ++k) {
    const int64_t at = row + k - SSIM_RADIUS;
    rows[k] = at >= 0 && at < height ? plane + at * stride : nullptr;
  }
  return row >= SSIM_RADIUS && row + SSIM_RADIUS < height;
}

// scratch: 4 rows with a margin of 5 * channels floats on both sides
static void ssim_rows(const float* x, const float* y, float* moments, int64_t n, int64_t height, int channels,
                      int64_t row, float* scratch) {
  const int64_t step = pitch(n), margin = SSIM_RADIUS * channels, wide = step + 2 * margin + LANES;
  for (int plane = 0; plane < 4; ++plane) {
    float* const p = scratch + plane * wide;
    for (int64_t i = 0; i < margin; ++i) p[i] = PADDING[plane];
    for (int64_t i = margin + n; i < wide; ++i) p[i] = PADDING[plane];
  }
  float* const s = scratch + margin;
  x += row * n;
  y += row * n;
  int64_t i = 0;
  for (; i + LANES <= n; i += LANES) {
    const vf a = (load(x + i) - 0.5f) + (load(y + i) - 0.5f), b = load(x + i) - load(y + i);
    store(s + i, a);
    store(s + wide + i, b);
    store(s + 2 * wide + i, a * a);
    store(s + 3 * wide + i, b * b);
  }
  for (; i < n; ++i) {
    const float a = (x[i] - 0.5f) + (y[i] - 0.5f), b = x[i] - y[i];
    s[i] = a;
    s[wide + i] = b;
    s[2 * wide + i] = a * a;
    s[3 * wide + i] = b * b;
  }
  for (int plane = 0; plane < 4; ++plane) {
    float* const to = moments + (plane * height + row) * step;
    const float* const from = s + plane * wide;
    for (i = 0; i < step; i += LANES) store(to + i, along(from + i, channels));
  }
}

template <bool INSIDE>
INLINE vf ssim_row(const float* const (*rows)[TAPS], int64_t n, float* s, int64_t wide) {
  vf total = {};
  for (int64_t i = 0; i < n; i += LANES) {
    vf f[4];
    for (int plane = 0; plane < 4; ++plane)
      f[plane] = INSIDE ? down_inside(rows[plane], i) : down(rows[plane], i, PADDING[plane]);
    const vf shifted_x = 0.5f * (f[0] + f[1]), shifted_y = 0.5f * (f[0] - f[1]);
    const vf variances = 0.5f * (f[2] + f[3]) - (shifted_x * shifted_x + shifted_y * shifted_y);
    const vf covariance = 0.25f * (f[2] - f[3]) - shifted_x * shifted_y;
    const vf mx = shifted_x + 0.5f, my = shifted_y + 0.5f;
    const vf a1 = 2.0f * mx * my + 1e-4f, b1 = mx * mx + my * my + 1e-4f;
    const vf a2 = 2.0f * covariance + 9e-4f, b2 = variances + 9e-4f;
    const vf inverse = 1.0f / (b1 * b2);
    vf value = a1 * a2 * inverse;
    // Partial derivatives by the window's mean of x, of x^2 and of x y.
    const vf by_square = -value * b1 * inverse;
    const vf by_product = 2.0f * a1 * inverse;
    const vf by_mean = 2.0f * (my * (a2 - a1) * inverse + value * mx * (b1 - b2) * inverse);
    vf keep[3] = {by_mean, by_square, by_product};
    if (i + LANES > n)
      for (int l = 0; l < LANES; ++l)
        if (i + l >= n) value[l] = keep[0][l] = keep[1][l] = keep[2][l] = 0.0f;
    total += value;
    for (int plane = 0; plane < 3; ++plane) store(s + plane * wide + i, keep[plane]);
  }
  return total;
}

static void ssim_map(const float* moments, float* partials, int64_t n, int64_t height, int channels, int64_t row,
                     double* value, float* scratch) {
  const int64_t step = pitch(n), margin = SSIM_RADIUS * channels, wide = step + 2 * margin + LANES;
  const float* rows[4][TAPS];
  bool inside = false;
  for (int plane = 0; plane < 4; ++plane)
    inside = neighbours(moments + plane * height * step, step, height, row, rows[plane]);
  for (int plane = 0; plane < 3; ++plane) {
    float* const p = scratch + plane * wide;
    for (int64_t i = 0; i < margin; ++i) p[i] = 0.0f;
    for (int64_t i = margin + n; i < wide; ++i) p[i] = 0.0f;
  }
  float* const s = scratch + margin;
  const vf total = inside ? ssim_row<true>(rows, n, s, wide) : ssim_row<false>(rows, n, s, wide);
  double sum = 0.0;
  for (int l = 0; l < LANES; ++l) sum += total[l];
  value[row] = sum;
  if (!partials) return;
  for (int plane = 0; plane < 3; ++plane) {
    float* const to = partials + (plane * height + row) * step;
    for (int64_t i = 0; i < step; i += LANES) store(to + i, along(s + plane * wide + i, channels));
  }
}

// grad = absolute * sign(x - y) + structural * dSSIM/dx; partials may be null where structural is 0.
static void ssim_gradient(const float* x, const float* y, const float* partials, float* grad, int64_t n,
                          int64_t height, int64_t row, float absolute, float structural) {
  const int64_t step = pitch(n);
  x += row * n;
  y += row * n;
  grad += row * n;
  const float* rows[3][TAPS];
  bool inside = false;
  if (partials)
    for (int plane = 0; plane < 3; ++plane)
      inside = neighbours(partials + plane * height * step, step, height, row, rows[plane]);
  for (int64_t i = 0; i < n; i += LANES) {
    const bool whole = i + LANES <= n;
    vf a = {}, b = {};
    if (whole) {
      a = load(x + i);
      b = load(y + i);
    } else {
      for (int l = 0; i + l < n; ++l) {
        a[l] = x[i + l];
        b[l] = y[i + l];
      }
    }
    const vf apart = a - b;
    vf g = apart > vf{} ? set(absolute) : apart < vf{} ? set(-absolute) : vf{};
    if (partials) {
      vf f[3];
      for (int plane = 0; plane < 3; ++plane)
        f[plane] = inside ? down_inside(rows[plane], i) : down(rows[plane], i, 0.0f);
      g += structural * (f[0] + 2.0f * a * f[1] + b * f[2]);
    }
    if (whole) store(grad + i, g);
    else
      for (int l = 0; i + l < n; ++l) grad[i + l] = g[l];
  }
}

static double absolute(const float* x, const float* y, int64_t n) {
  vf total = {};
  int64_t i = 0;
  for (; i + LANES <= n; i += LANES) total += abs(load(x + i) - load(y + i));
  double sum = 0.0;
  for (int l = 0; l < LANES; ++l) sum += total[l];
  for (; i < n; ++i) sum += __builtin_fabsf(x[i] - y[i]);
  return sum;
}

}  // namespace ECONGS_ISA
