// Adam (Kingma and Ba 2015), and the fixed piece of work that speeds of different moments are compared by.
#pragma once

#include "simd.h"
#include "table.h"

namespace ECONGS_ISA {

using namespace econgs;

static void adam(float* p, const float* g, float* m, float* v, int64_t n, const AdamRates& r) {
  const Flush flush;
  const auto update = [&](vf grad, vf& first, vf& second) __attribute__((always_inline)) {
    first = fma(grad - first, set(r.new1), first);
    second = fma(second, set(r.beta2), r.new2 * (grad * grad));
    return r.rate * first / (sqrt(second) * r.root2 + r.eps);
  };
  int64_t i = 0;
  for (; i + LANES <= n; i += LANES) {
    const vf grad = load(g + i);
    vf first = load(m + i), second = load(v + i);
    // Zero all along (inactive spherical harmonics): the update is exactly zero, so nothing is written.
    if (signs(((vi)grad | (vi)first | (vi)second) != 0) == 0) continue;
    const vf change = update(grad, first, second);
    store(m + i, first);
    store(v + i, second);
    store(p + i, load(p + i) - change);
  }
  if (i < n) {
    const vf grad = load(g + i, n - i);
    vf first = load(m + i, n - i), second = load(v + i, n - i);
    const vf change = where((grad != 0.0f) | (first != 0.0f), update(grad, first, second));
    store(m + i, first, n - i);
    store(v + i, second, n - i);
    store(p + i, load(p + i, n - i) - change, n - i);
  }
}

// Half arithmetic on registers, half a pass over memory. Values stay near 1.
static void reference(float* data, int64_t n, int rounds) {
  for (int64_t i = 0; i + 4 * LANES <= n; i += 4 * LANES) {
    vf a = load(data + i), b = load(data + i + LANES), c = load(data + i + 2 * LANES), d = load(data + i + 3 * LANES);
    for (int k = 0; k < rounds; ++k) {
      a = fma(a, set(0.5f), set(0.5f));
      b = fma(b, set(0.5f), set(0.5f));
      c = fma(c, set(0.5f), set(0.5f));
      d = fma(d, set(0.5f), set(0.5f));
    }
    store(data + i, a);
    store(data + i + LANES, b);
    store(data + i + 2 * LANES, c);
    store(data + i + 3 * LANES, d);
  }
}

}  // namespace ECONGS_ISA
