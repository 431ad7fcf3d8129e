// Splatting one frame: what drives the kernels.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "runtime.h"

namespace econgs {

struct FrameStatistics {
  double project = 0, sort = 0, bin = 0, blend = 0, blend_backward = 0, project_backward = 0;  // seconds
  int64_t visible = 0, intersections = 0, evaluations = 0;
};

// What the backward pass needs of a forward pass.
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
};

FrameStatistics& last_frame();

// Returns null if `project` met unusable input. Throws std::length_error on absurd numbers of intersections.
std::unique_ptr<Frame> forward(const Inputs&, const View&, const Images&, int32_t* radii, bool keep);
void backward(const Frame&, const Inputs&, const ConstImages& out, const ConstImages& grad, const Gradients&);

double photometric(const float* x, const float* y, int64_t height, int64_t width, int channels, float absolute,
                   float structural, float* grad, double* ssim);
double reference_kernel();
double bench_blend(int channels, bool backward);

}  // namespace econgs
