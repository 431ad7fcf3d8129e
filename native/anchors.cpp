#include "anchors.h"

#include <algorithm>
#include <cmath>

#include "threads.h"

namespace econgs {

void visible_anchors(const AnchorView& view, const float* anchors, const float* scalings, int64_t count,
                     uint8_t* shown) {
  const float* const m = view.pose;
  parallel_ranges(count, 4096, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; ++i) {
      const float *const p = anchors + 3 * i, *const s = scalings + 6 * i;
      const float x = m[0] * p[0] + m[1] * p[1] + m[2] * p[2] + m[3];
      const float y = m[4] * p[0] + m[5] * p[1] + m[6] * p[2] + m[7];
      const float depth = m[8] * p[0] + m[9] * p[1] + m[10] * p[2] + m[11];
      const float reach = 3.0f * std::max(s[0], std::max(s[1], s[2]));
      shown[i] = depth > view.near && std::fabs(x + depth * view.offset[0]) <= reach + depth * view.edge[0] &&
                 std::fabs(y + depth * view.offset[1]) <= reach + depth * view.edge[1];
    }
  });
}

void record_view(const AnchorStatistics& to, const int64_t* rows, const float* opacity, int64_t seen,
                 const int64_t* slots, const float* gradients, const int32_t* radii, int64_t splats, float half_width,
                 float half_height) {
  const int many = to.offsets;
  for (int64_t v = 0; v < seen; ++v) {
    float sum = 0.0f;
    for (int k = 0; k < many; ++k) sum += std::max(opacity[v * many + k], 0.0f);
    to.opacities[rows[v]] += sum;
    to.visits[rows[v]] += 1.0f;
  }
  for (int64_t i = 0; i < splats; ++i) {
    if (radii[i] <= 0) continue;
    const int64_t at = rows[slots[i] / many] * many + slots[i] % many;
    const float x = half_width * gradients[2 * i], y = half_height * gradients[2 * i + 1];
    to.gradients[at] += std::sqrt(x * x + y * y);
    to.draws[at] += 1.0f;
  }
}

}  // namespace econgs
