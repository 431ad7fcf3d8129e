// The kernels in use, and memory that is used again.
#pragma once

#include <cstddef>
#include <vector>

#include "kernels/table.h"
#include "threads.h"

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
  T* as() const {
    return static_cast<T*>(data_);
  }

 private:
  void* data_ = nullptr;
  size_t bytes_ = 0;
};

// Floats for each thread's own use, not cleared.
class Scratch {
 public:
  explicit Scratch(int64_t floats) : stride_((floats + 15) / 16 * 16), memory_(threads() * stride_ * sizeof(float)) {}
  float* of(int thread) const { return memory_.as<float>() + thread * stride_; }

 private:
  int64_t stride_;
  Buffer memory_;
};

}  // namespace econgs
