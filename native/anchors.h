// Anchors in training: which a view may show, and statistics of what it showed (econgs/anchors/growing.py).
#pragma once

#include <cstdint>

namespace econgs {

struct AnchorView {
  float pose[12];  // world to camera, three rows
  float near;
  float offset[2], edge[2];  // by axis: shift of the image's middle and half its size, both over the focal length
};
// shown: 1 for an anchor that lies deeper than `near` and whose circle of three times its largest offset scaling
// meets the image, else 0.
void visible_anchors(const AnchorView& view, const float* anchors, const float* scalings, int64_t count,
                     uint8_t* shown);

// Statistics of all anchors with K offsets each.
struct AnchorStatistics {
  float *gradients, *draws;    // by anchor and offset
  float *opacities, *visits;   // by anchor
  int offsets;
};
// Adds a view: `rows` are its anchors, `opacity` (rows x K) those of their Gaussians before culling; each splatted
// Gaussian has its slot (place among the rows * K + offset), gradient by its centre in pixels, and radius.
void record_view(const AnchorStatistics& to, const int64_t* rows, const float* opacity, int64_t seen,
                 const int64_t* slots, const float* gradients, const int32_t* radii, int64_t splats, float half_width,
                 float half_height);

}  // namespace econgs
