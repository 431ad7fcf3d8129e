// Products of interpolated lines of factors, summed over ranks or weighted for three channels, and their gradients.
#pragma once

#include "factor_types.h"
#include "simd.h"

namespace ECONGS_ISA {

using namespace econgs;

// The rows on both sides of a place, and the fraction between them.
struct Between {
  int64_t row[3];  // floats before the lower row
  float fraction[3];
};

INLINE Between between(const Lines& lines, const float* place) {
  Between at;
  for (int i = 0; i < 3; ++i) {
    const float x = place[i] * (float)(lines.size[i] - 1);
    int cell = x > 0.0f ? (int)x : 0;
    if (cell > lines.size[i] - 2) cell = lines.size[i] - 2;
    at.row[i] = cell * lines.stride;
    at.fraction[i] = x - (float)cell;
  }
  return at;
}

INLINE vf interpolated(const Lines& lines, const Between& at, int i, int column) {
  const float* const low = lines.line[i] + at.row[i] + column;
  const vf first = load(low);
  return fma(load(low + lines.stride) - first, at.fraction[i], first);
}

// out: one number (three, if mixed) per sample [begin, end), `apart` floats from one sample to the next.
static void line_products(const Lines& lines, const LineSamples& samples, int64_t begin, int64_t end, int64_t apart,
                          float* out) {
  const Flush flush;
  for (int64_t n = begin; n < end; ++n) {
    const Between at = between(lines, samples.places + 3 * n);
    float* const to = out + n * apart;
    if (!samples.mixing) {
      vf sum = {};
      for (int r = 0; r < lines.ranks; r += LANES)
        sum = fma(interpolated(lines, at, 0, r) * interpolated(lines, at, 1, r), interpolated(lines, at, 2, r), sum);
      *to = ECONGS_ISA::sum(sum);
      continue;
    }
    const float* const mix = samples.mixing + 3 * samples.rays[n] * lines.stride;
    vf channel[3] = {};
    for (int r = 0; r < lines.ranks; r += LANES) {
      const vf value = interpolated(lines, at, 0, r) * interpolated(lines, at, 1, r) * interpolated(lines, at, 2, r);
      for (int c = 0; c < 3; ++c) channel[c] = fma(load(mix + c * lines.stride + r), value, channel[c]);
    }
    const v4 all = sums(channel[0], channel[1], channel[2], vf{});
    for (int c = 0; c < 3; ++c) to[c] = all[c];
  }
}

// Adds the gradients of lines (as `lines`) and of mixing (null where values are summed).
static void line_products_backward(const Lines& lines, const LineSamples& samples, int64_t count, int64_t apart,
                                   const float* grad, float* const* to_lines, float* to_mixing) {
  const Flush flush;
  for (int64_t n = 0; n < count; ++n) {
    const Between at = between(lines, samples.places + 3 * n);
    const float* const g = grad + n * apart;
    const int64_t ray = samples.mixing ? 3 * samples.rays[n] * lines.stride : 0;
    for (int r = 0; r < lines.ranks; r += LANES) {
      const vf value[3] = {interpolated(lines, at, 0, r), interpolated(lines, at, 1, r), interpolated(lines, at, 2, r)};
      const vf pair = value[0] * value[1];
      vf slope;
      if (samples.mixing) {
        const vf product = pair * value[2];
        slope = vf{};
        for (int c = 0; c < 3; ++c) {
          const int64_t place = ray + c * lines.stride + r;
          slope = fma(load(samples.mixing + place), g[c], slope);
          store(to_mixing + place, fma(product, g[c], load(to_mixing + place)));
        }
      } else {
        slope = set(g[0]);
      }
      const vf rest = slope * value[2];
      const vf change[3] = {rest * value[1], rest * value[0], slope * pair};
      for (int i = 0; i < 3; ++i) {
        float* const low = to_lines[i] + at.row[i] + r;
        float* const high = low + lines.stride;
        const vf share = change[i] * at.fraction[i];
        store(high, load(high) + share);
        store(low, load(low) + (change[i] - share));
      }
    }
  }
}

}  // namespace ECONGS_ISA
