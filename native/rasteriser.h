// Splatting one frame: the driver of kernels/project.h and kernels/blend.h. N Gaussians, T tiles of 16 x 16 pixels,
// E entries (a Gaussian in one tile).
//
//   means, quats, scales, opacities                                            features
//        | project, by Gaussian                                                    |
//   splats [N] --- bin: spans of tiles, counted, then filled --> unsorted [E]      |
//        |                                                          | sort, by tile, near to far
//        |                                                      entries [E]        |
//        +----------------------------+-----------------------------+--------------+
//                                     | blend, by tile, front to back
//             features, alpha, depth [pixels]        blocks [E]: the parts of a tile in which the Gaussian counts
//
//   gradients of the images
//        | blend_backward, by tile, the same blocks front to back
//   slots [E]: sums per Gaussian and tile, all tiles of a Gaussian side by side (first_slot [N + 1])
//        | project_backward, by Gaussian: adds its slots in the order of the tiles
//   gradients of means, quats, scales, opacities, features, screen offset
//
// Nothing depends on the number of threads: every sum has one order.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "runtime.h"

namespace econgs {

struct FrameStatistics {
  double project = 0, sort = 0, bin = 0, blend = 0;  // seconds
  int64_t visible = 0, evaluations = 0;              // Gaussians; pixel x Gaussian, by lanes
};

// What the backward pass needs of a forward pass, and the statistics of that pass.
struct Frame {
  const Kernels* kernels;
  View view;
  int64_t count = 0, intersections = 0;
  int across = 0, down = 0;  // tiles
  Buffer splats;             // Splat by Gaussian
  Buffer first_slot;         // uint32 by Gaussian, count + 1
  Buffer entries;            // Entry by tile, near to far
  Buffer starts;             // int64 by tile, tiles + 1
  Buffer blocks;             // uint64 by entry
  std::vector<uint32_t> order;  // tiles, those with most entries first
  FrameStatistics statistics;
};

// Returns null if `project` met unusable input. Throws std::length_error on absurd numbers of intersections.
std::unique_ptr<Frame> forward(const Inputs&, const View&, const Images&, int32_t* radii, bool keep);
void backward(const Frame&, const Inputs&, const ConstImages& out, const ConstImages& grad, const Gradients&);

double photometric(const float* x, const float* y, int64_t height, int64_t width, int channels, float absolute,
                   float structural, float* grad, double* ssim);

// A drawn picture against a view, both over a background: mean distance and SSIM of the colors, which the gradients
// weigh as in `photometric`, and the mean distance of alpha, whose weight becomes `rescue` (if that is more) while less
// than `vanishing` of the view's alpha is drawn.
struct ViewLoss {
  double absolute, ssim, alpha;  // alpha: weighted
};
ViewLoss view_loss(const float* color, const float* alpha, const float* truth, const float* back, int64_t height,
                   int64_t width, float absolute, float structural, float alpha_weight, float vanishing, float rescue,
                   float* grad_color, float* grad_alpha);
double reference_kernel();
double bench_blend(int channels);

}  // namespace econgs
