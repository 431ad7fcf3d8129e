// A small pool of threads. OpenMP's spinning turns a 3 ms frame into 176 ms on a busy machine; these threads
// spin for some microseconds and then sleep.
#pragma once

#include <cstdint>
#include <functional>

namespace econgs {

int threads();
void set_threads(int count);

// Calls work(item, thread) for every item in [0, items), in any order, on up to `threads()` threads, of which the
// caller is one. Safe to call from several threads (they take turns) and after a fork.
void parallel(int64_t items, const std::function<void(int64_t item, int thread)>& work);

// Ranges of about equal size: calls work(begin, end, thread) for [0, count) in pieces of `grain`.
void parallel_ranges(int64_t count, int64_t grain,
                     const std::function<void(int64_t begin, int64_t end, int thread)>& work);

}  // namespace econgs
