// Splatting one frame: what drives the kernels.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "kernels.h"

namespace econgs {

// Instruction sets: those built in, those this processor has, and the one in use.
const std::vector<const Kernels*>& built_kernels();
bool supported(const Kernels&);
const Kernels& kernels();
void use_kernels(const Kernels&);

// Memory that is handed round: a training run asks for the same few sizes in every iteration, and fresh pages
// from the system would cost as much as the work on them.
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(size_t bytes);
  ~Buffer();
  Buffer(Buffer&& other) noexcept;
  Buffer& operator=(Buffer&& other) noexcept;
  template <class T>
  T* as() const { return static_cast<T*>(data_); }

 private:
  void* data_ = nullptr;
  size_t bytes_ = 0;
};

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
