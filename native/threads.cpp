#include "threads.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#define ECONGS_FORKS 1
#endif

namespace econgs {
namespace {

constexpr auto SPIN = std::chrono::microseconds(30);

class Pool {
 public:
  explicit Pool(int count) : count_(count) {
    for (int thread = 1; thread < count; ++thread) std::thread([this, thread] { serve(thread); }).detach();
  }

  int count() const { return count_; }

  void run(int64_t items, const std::function<void(int64_t, int)>& work) {
    std::lock_guard<std::mutex> turn(turn_);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      items_ = items;
      work_ = &work;
      error_ = nullptr;
      next_.store(0, std::memory_order_relaxed);
      open_ = true;
      round_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    take(0);
    // Only those who came are waited for: on a busy machine a thread may wake long after the work is done.
    std::unique_lock<std::mutex> lock(mutex_);
    open_ = false;
    if (helping_.load(std::memory_order_acquire) > 0) {
      lock.unlock();
      spin([this] { return helping_.load(std::memory_order_acquire) == 0; });
      lock.lock();
      done_.wait(lock, [this] { return helping_.load(std::memory_order_acquire) == 0; });
    }
    work_ = nullptr;
    if (error_) std::rethrow_exception(error_);
  }

 private:
  template <class Condition>
  static bool spin(Condition ready) {
    const auto until = std::chrono::steady_clock::now() + SPIN;
    do {
      for (int i = 0; i < 64; ++i)
        if (ready()) return true;
    } while (std::chrono::steady_clock::now() < until);
    return false;
  }

  void take(int thread) {
    try {
      for (int64_t item; (item = next_.fetch_add(1, std::memory_order_relaxed)) < items_;) (*work_)(item, thread);
    } catch (...) {
      std::lock_guard<std::mutex> lock(mutex_);
      if (!error_) error_ = std::current_exception();
    }
  }

  void serve(int thread) {
    for (uint64_t last_round = 0;;) {
      spin([&] { return round_.load(std::memory_order_acquire) != last_round; });
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait(lock, [&] { return round_.load(std::memory_order_acquire) != last_round || retired_; });
      if (retired_) return;
      last_round = round_.load(std::memory_order_acquire);
      if (!open_) continue;
      helping_.fetch_add(1, std::memory_order_relaxed);
      lock.unlock();
      take(thread);
      lock.lock();
      if (helping_.fetch_sub(1, std::memory_order_release) == 1) done_.notify_one();
    }
  }

 public:
  // Lets the threads go; the object itself is left behind (they may still be looking at it).
  void retire() {
    std::lock_guard<std::mutex> turn(turn_);
    std::lock_guard<std::mutex> lock(mutex_);
    retired_ = true;
    wake_.notify_all();
  }

 private:
  const int count_;
  std::mutex turn_, mutex_;
  std::condition_variable wake_, done_;
  std::atomic<uint64_t> round_{0};
  std::atomic<int64_t> next_{0};
  std::atomic<int> helping_{0};
  int64_t items_ = 0;
  const std::function<void(int64_t, int)>* work_ = nullptr;
  std::exception_ptr error_;
  bool open_ = false, retired_ = false;
};

// Pools are never freed: threads may wait on them until the process ends.
std::atomic<Pool*> current{nullptr};
std::atomic<int> thread_count{1};

Pool& pool() {
  Pool* now = current.load(std::memory_order_acquire);
  if (now && now->count() == thread_count.load()) return *now;
  static std::mutex* making = new std::mutex;
  std::lock_guard<std::mutex> lock(*making);
  now = current.load(std::memory_order_acquire);
  if (now && now->count() == thread_count.load()) return *now;
#ifdef ECONGS_FORKS
  // A forked child has none of the threads and perhaps a locked mutex: it starts a pool of its own.
  static const int registered =
      pthread_atfork(nullptr, nullptr, [] { current.store(nullptr, std::memory_order_release); });
  (void)registered;
#endif
  Pool* const fresh = new Pool(thread_count.load());
  current.store(fresh, std::memory_order_release);
  if (now) now->retire();
  return *fresh;
}

}  // namespace

int threads() { return thread_count.load(); }

void set_threads(int count) { thread_count.store(count); }

void parallel(int64_t items, const std::function<void(int64_t, int)>& work) {
  if (items <= 0) return;
  if (items == 1 || threads() == 1) {
    for (int64_t item = 0; item < items; ++item) work(item, 0);
    return;
  }
  pool().run(items, work);
}

void parallel_ranges(int64_t count, int64_t grain, const std::function<void(int64_t, int64_t, int)>& work) {
  parallel((count + grain - 1) / grain,
           [&](int64_t item, int thread) { work(item * grain, std::min(count, (item + 1) * grain), thread); });
}

}  // namespace econgs
