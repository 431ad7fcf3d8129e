// SSIM of two H x W x C images (Wang et al. 2004; 11 x 11 window, sigma 1.5, zero padding) and its gradient.
//
// The window is separable and channels lie side by side, so a row is one array of n = W * C floats and the
// horizontal filter has a stride of C. Filtering s = x + y and d = x - y and their squares gives all that SSIM
// needs of x and y from four sums instead of five. Images are shifted by -1/2 (padding included), which changes no
// variance but spares float most of the cancellation in flat bright regions. Three sweeps over bands of rows:
//   1 filter along the rows: s, d, s^2, d^2
//   2 filter down, SSIM and its partial derivatives by mean, square and product, filter these along the rows
//   3 filter these down and put the gradient together
// What is filtered down lies in planes with SSIM_RADIUS more rows above and below, which hold the padding.
#pragma once

#include "simd.h"
#include "table.h"

namespace ECONGS_ISA {

using namespace econgs;

constexpr int TAPS = 2 * SSIM_RADIUS + 1;
// exp(-k^2 / 4.5) / sum, k = 0..5
constexpr float TAP[SSIM_RADIUS + 1] = {0.26601172f,  0.21300553f,   0.10936069f,
                                        0.036000773f, 0.0075987582f, 0.0010283801f};

INLINE vf along(const float* p, int stride) {
  vf r = TAP[0] * load(p);
  for (int k = 1; k <= SSIM_RADIUS; ++k) r = fma(load(p - k * stride) + load(p + k * stride), set(TAP[k]), r);
  return r;
}

// The padding of s, d, s^2 and d^2 after the shift.
constexpr float PADDING[4] = {-1.0f, 0.0f, 1.0f, 0.0f};

// p: the middle row.
INLINE vf down(const float* p, int64_t step) {
  vf r = TAP[0] * load(p);
  const float *above = p, *below = p;
  for (int k = 1; k <= SSIM_RADIUS; ++k) {
    above -= step;
    below += step;
    r = fma(load(above) + load(below), set(TAP[k]), r);
  }
  return r;
}

// Rows of all planes are padded to a multiple of LANES by the caller's `pitch`.
INLINE int64_t pitch(int64_t n) { return (n + 15) / 16 * 16; }

// Row `row` of plane `plane`; from -SSIM_RADIUS to height + SSIM_RADIUS - 1.
template <class T>
INLINE T* row_of(T* planes, int plane, int64_t row, int64_t n, int64_t height) {
  return planes + (plane * (height + 2 * SSIM_RADIUS) + row + SSIM_RADIUS) * pitch(n);
}

INLINE void fill(float* p, int64_t n, float value) {
  for (int64_t i = 0; i < n; ++i) p[i] = value;
}

// Floats of a row with its margins.
INLINE int64_t wide_row(int64_t n, int channels) { return pitch(n) + 2 * SSIM_RADIUS * channels + LANES; }

static int64_t ssim_scratch(int64_t n, int channels) { return 3 * SSIM_BAND * wide_row(n, channels); }

static void ssim_rows(const float* x, const float* y, float* moments, int64_t n, int64_t height, int channels,
                      int64_t begin, int64_t end, float* scratch) {
  const int64_t step = pitch(n), margin = SSIM_RADIUS * channels, wide = wide_row(n, channels);
  for (int plane = 0; plane < 4; ++plane) {
    fill(scratch + plane * wide, margin, PADDING[plane]);
    fill(scratch + plane * wide + margin + n, wide - margin - n, PADDING[plane]);
  }
  float* const s = scratch + margin;
  for (int64_t row = begin; row < end; ++row) {
    if (row < 0 || row >= height) {
      for (int plane = 0; plane < 4; ++plane) fill(row_of(moments, plane, row, n, height), step, PADDING[plane]);
      continue;
    }
    const float *const p = x + row * n, *const q = y + row * n;
    int64_t i = 0;
    for (; i + LANES <= n; i += LANES) {
      const vf a = (load(p + i) - 0.5f) + (load(q + i) - 0.5f), b = load(p + i) - load(q + i);
      store(s + i, a);
      store(s + wide + i, b);
      store(s + 2 * wide + i, a * a);
      store(s + 3 * wide + i, b * b);
    }
    for (; i < n; ++i) {
      const float a = (p[i] - 0.5f) + (q[i] - 0.5f), b = p[i] - q[i];
      s[i] = a;
      s[wide + i] = b;
      s[2 * wide + i] = a * a;
      s[3 * wide + i] = b * b;
    }
    for (int plane = 0; plane < 4; ++plane) {
      float* const to = row_of(moments, plane, row, n, height);
      for (i = 0; i < step; i += LANES) store(to + i, along(s + plane * wide + i, channels));
    }
  }
}

// SSIM at one vector of pixels from the four filtered moments, and its partial derivatives by the window's mean of
// x, of x^2 and of x y.
INLINE vf ssim_of(const vf* f, vf* partials) {
  const vf shifted_x = 0.5f * (f[0] + f[1]), shifted_y = 0.5f * (f[0] - f[1]);
  const vf variances = 0.5f * (f[2] + f[3]) - (shifted_x * shifted_x + shifted_y * shifted_y);
  const vf covariance = 0.25f * (f[2] - f[3]) - shifted_x * shifted_y;
  const vf mx = shifted_x + 0.5f, my = shifted_y + 0.5f;
  const vf a1 = 2.0f * mx * my + 1e-4f, b1 = mx * mx + my * my + 1e-4f;
  const vf a2 = 2.0f * covariance + 9e-4f, b2 = variances + 9e-4f;
  const vf inverse = 1.0f / (b1 * b2);
  const vf value = a1 * a2 * inverse;
  partials[0] = 2.0f * (my * (a2 - a1) * inverse + value * mx * (b1 - b2) * inverse);
  partials[1] = -value * b1 * inverse;
  partials[2] = 2.0f * a1 * inverse;
  return value;
}

// At most SSIM_BAND rows; `values` gets the sum of each.
static void ssim_map(const float* moments, float* partials, int64_t n, int64_t height, int channels, int64_t begin,
                     int64_t end, double* values, float* scratch) {
  const int64_t step = pitch(n), margin = SSIM_RADIUS * channels, wide = wide_row(n, channels);
  const auto maps = [&](int plane, int64_t row) { return scratch + (plane * SSIM_BAND + row - begin) * wide; };
  const int64_t first = begin < 0 ? 0 : begin, last = end < height ? end : height;
  for (int64_t row = first; row < last; ++row) {
    vf total = {};
    for (int64_t i = 0; i < n; i += LANES) {
      vf f[4], keep[3];
      for (int plane = 0; plane < 4; ++plane) f[plane] = down(row_of(moments, plane, row, n, height) + i, step);
      vf value = ssim_of(f, keep);
      if (i + LANES > n)
        for (int l = 0; l < LANES; ++l)
          if (i + l >= n) value[l] = keep[0][l] = keep[1][l] = keep[2][l] = 0.0f;
      total += value;
      for (int plane = 0; plane < 3; ++plane) store(maps(plane, row) + margin + i, keep[plane]);
    }
    double sum = 0.0;
    for (int l = 0; l < LANES; ++l) sum += total[l];
    values[row] = sum;
  }
  if (!partials) return;
  for (int plane = 0; plane < 3; ++plane)
    for (int64_t row = begin; row < end; ++row) {
      float* const to = row_of(partials, plane, row, n, height);
      if (row < first || row >= last) {
        fill(to, step, 0.0f);
        continue;
      }
      float* const map = maps(plane, row);
      fill(map, margin, 0.0f);
      fill(map + margin + n, wide - margin - n, 0.0f);
      for (int64_t i = 0; i < step; i += LANES) store(to + i, along(map + margin + i, channels));
    }
}

// grad = absolute * sign(x - y) + structural * dSSIM/dx; partials may be null where structural is 0.
static void ssim_gradient(const float* x, const float* y, const float* partials, float* grad, int64_t n, int64_t height,
                          int64_t begin, int64_t end, float absolute, float structural) {
  const int64_t step = pitch(n);
  for (int64_t row = begin; row < end; ++row)
    for (int64_t i = 0; i < n; i += LANES) {
      const bool whole = i + LANES <= n;
      const float *const p = x + row * n + i, *const q = y + row * n + i;
      float* const to = grad + row * n + i;
      const vf a = whole ? load(p) : load(p, n - i), b = whole ? load(q) : load(q, n - i);
      const vf apart = a - b;
      vf g = apart > vf{} ? set(absolute) : apart < vf{} ? set(-absolute) : vf{};
      if (partials) {
        vf f[3];
        for (int plane = 0; plane < 3; ++plane) f[plane] = down(row_of(partials, plane, row, n, height) + i, step);
        g += structural * (f[0] + 2.0f * a * f[1] + b * f[2]);
      }
      if (whole) store(to, g);
      else store(to, g, n - i);
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
