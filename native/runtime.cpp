#include "runtime.h"

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <mutex>
#include <new>
#include <utility>

#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

// Defined once per ISA by kernels/isa.cpp.
namespace baseline { extern const econgs::Kernels kernels; }
#ifdef ECONGS_X86
namespace avx512 { extern const econgs::Kernels kernels; }
namespace avx2 { extern const econgs::Kernels kernels; }
namespace avx2x16 { extern const econgs::Kernels kernels; }
#endif

namespace econgs {
namespace {

std::atomic<const Kernels*> current{nullptr};

struct Shelf {
  static constexpr size_t PLACES = 48;
  std::mutex mutex;
  struct Piece {
    void* data;
    size_t bytes;
  };
  Piece free[PLACES];  // oldest first
  size_t count = 0;

  void remove(size_t place) { std::move(free + place + 1, free + count--, free + place); }
};

Shelf& shelf() {
  static Shelf*& one = *new Shelf*(new Shelf);  // never freed: frames may outlive the module
  static const int registered = [] {
#if defined(__unix__) || defined(__APPLE__)
    // A forked child may find the mutex locked by a thread that it does not have.
    return pthread_atfork(nullptr, nullptr, [] { one = new Shelf; });
#else
    return 0;
#endif
  }();
  (void)registered;
  return *one;
}

}  // namespace

const std::vector<const Kernels*>& built_kernels() {
  static const std::vector<const Kernels*> all = {
#ifdef ECONGS_X86
      &::avx512::kernels,
      &::avx2::kernels,
#endif
      &::baseline::kernels,
#ifdef ECONGS_X86
      &::avx2x16::kernels,  // for tests only, hence last
#endif
  };
  return all;
}

bool supported(const Kernels& one) {
#ifdef ECONGS_X86
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                    __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt");
  if (&one == &::avx512::kernels)
    return avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
  if (&one == &::avx2::kernels || &one == &::avx2x16::kernels) return avx2;
#endif
  return &one == &::baseline::kernels;
}

const Kernels& kernels() {
  if (!current.load())
    current = *std::find_if(built_kernels().begin(), built_kernels().end(), [](auto one) { return supported(*one); });
  return *current.load();
}

void use_kernels(const Kernels& one) { current = &one; }

Buffer::Buffer(size_t bytes) {
  bytes = (std::max<size_t>(bytes, 1) + 4095) / 4096 * 4096;
  {
    Shelf& all = shelf();
    std::lock_guard<std::mutex> lock(all.mutex);
    size_t best = all.count;
    for (size_t i = 0; i < all.count; ++i) {
      const size_t has = all.free[i].bytes;
      // Not one that is far too large: it would be missed elsewhere.
      if (has >= bytes && has <= 2 * bytes + 65536 && (best == all.count || has < all.free[best].bytes)) best = i;
    }
    if (best < all.count) {
      data_ = all.free[best].data;
      bytes_ = all.free[best].bytes;
      all.remove(best);
      return;
    }
  }
  bytes_ = bytes + bytes / 8 / 4096 * 4096;  // some room, so that a growing scene finds its buffers again
  data_ = std::aligned_alloc(4096, bytes_);
  if (!data_) throw std::bad_alloc();
}

Buffer::~Buffer() {
  if (!data_) return;
  Shelf& all = shelf();
  void* drop = nullptr;
  {
    std::lock_guard<std::mutex> lock(all.mutex);
    if (all.count == Shelf::PLACES) {  // the oldest goes
      drop = all.free[0].data;
      all.remove(0);
    }
    all.free[all.count++] = {data_, bytes_};
  }
  std::free(drop);
}

Buffer::Buffer(Buffer&& other) noexcept
    : data_(std::exchange(other.data_, nullptr)), bytes_(std::exchange(other.bytes_, 0)) {}

Buffer& Buffer::operator=(Buffer&& other) noexcept {
  std::swap(data_, other.data_);
  std::swap(bytes_, other.bytes_);
  return *this;
}

}  // namespace econgs
