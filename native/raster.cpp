#include "raster.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <new>
#include <stdexcept>
#include <utility>

#include "threads.h"

namespace econgs {
namespace {

class Clock {
 public:
  double lap() {
    const auto now = std::chrono::steady_clock::now();
    const double seconds = std::chrono::duration<double>(now - last_).count();
    last_ = now;
    return seconds;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

struct Key {
  uint32_t depth, index;
};

// Visible Gaussians from near to far; equal depths by index. Depths are positive, so their bits sort as integers.
int64_t sort_by_depth(const Splat* splats, int64_t count, Key* keys, Key* spare) {
  constexpr int BITS = 11, BINS = 1 << BITS;
  std::vector<uint32_t> bins(3 * BINS, 0);
  int64_t visible = 0;
  for (int64_t n = 0; n < count; ++n) {
    if (splats[n].opacity <= 0.0f) continue;
    uint32_t bits;
    std::memcpy(&bits, &splats[n].depth, 4);
    keys[visible++] = {bits, static_cast<uint32_t>(n)};
    for (int pass = 0; pass < 3; ++pass) ++bins[pass * BINS + (bits >> (BITS * pass) & (BINS - 1))];
  }
  for (int pass = 0; pass < 3; ++pass) {
    uint32_t* const bin = bins.data() + pass * BINS;
    if (std::any_of(bin, bin + BINS, [&](uint32_t size) { return size == visible; })) continue;  // all alike
    uint32_t start = 0;
    for (int i = 0; i < BINS; ++i) start += std::exchange(bin[i], start);
    for (int64_t i = 0; i < visible; ++i) spare[bin[keys[i].depth >> (BITS * pass) & (BINS - 1)]++] = keys[i];
    std::memcpy(static_cast<void*>(keys), spare, visible * sizeof(Key));
  }
  return visible;
}

struct Span {
  uint32_t first;  // tile
  uint32_t count;
};

// The tiles that an ellipse meets, one span per row of tiles. Rows and columns are those of pixel centres.
template <class Take>
void spans(const Splat& s, const Frame& frame, Take take) {
  const double height = frame.view.height, width = frame.view.width;
  const double low = std::max(s.v - s.top, 0.5), high = std::min(s.v + s.top, height - 0.5);
  const int from = static_cast<int>(std::ceil(low - 0.5)), to = static_cast<int>(std::floor(high - 0.5));
  if (from > to) return;
  for (int row = from / TILE; row <= to / TILE; ++row) {
    const float above = static_cast<float>(std::max(row * TILE, from) + 0.5 - s.v);
    const float below = static_cast<float>(std::min(row * TILE + TILE - 1, to) + 0.5 - s.v);
    const float at_right = std::max(above, std::min(below, s.tip)), at_left = std::max(above, std::min(below, -s.tip));
    const float reach = std::sqrt(std::max(s.bound - at_right * at_right * s.inverse, 0.0f) * s.width2);
    const float back = std::sqrt(std::max(s.bound - at_left * at_left * s.inverse, 0.0f) * s.width2);
    const double left = std::max(s.u + (s.slope * at_left - back), 0.5);
    const double right = std::min(s.u + (s.slope * at_right + reach), width - 0.5);
    const int first = static_cast<int>(std::ceil(left - 0.5)), last = static_cast<int>(std::floor(right - 0.5));
    if (first > last) continue;
    take(row * frame.across + first / TILE, last / TILE - first / TILE + 1);
  }
}

// Sorts the tile-Gaussian pairs into tiles, near to far. Pieces of the sorted list are counted and filled in
// parallel; the result does not depend on how many pieces there are.
void bin(Frame& frame, const Key* order, int64_t visible) {
  const Splat* const splats = frame.splats.as<Splat>();
  const int64_t tiles = static_cast<int64_t>(frame.across) * frame.down;
  const int64_t pieces = std::clamp<int64_t>(visible / 1024, 1, 2 * threads());
  const auto edge = [&](int64_t piece) { return visible * piece / pieces; };
  Buffer counts_memory(pieces * tiles * sizeof(uint32_t));
  uint32_t* const counts = counts_memory.as<uint32_t>();
  std::vector<std::vector<Span>> found(pieces);
  std::vector<std::vector<uint32_t>> rows(pieces);
  frame.first_slot = Buffer((frame.count + 1) * sizeof(uint32_t));
  uint32_t* const first_slot = frame.first_slot.as<uint32_t>();
  std::fill(first_slot, first_slot + frame.count + 1, 0);

  parallel(pieces, [&](int64_t piece, int) {
    uint32_t* const count = counts + piece * tiles;
    std::fill(count, count + tiles, 0);
    found[piece].reserve((edge(piece + 1) - edge(piece)) * 3);
    rows[piece].reserve(edge(piece + 1) - edge(piece));
    for (int64_t i = edge(piece); i < edge(piece + 1); ++i) {
      if (i + 8 < visible) __builtin_prefetch(splats + order[i + 8].index);
      uint32_t sum = 0;
      const size_t before = found[piece].size();
      spans(splats[order[i].index], frame, [&](uint32_t first, uint32_t many) {
        found[piece].push_back({first, many});
        for (uint32_t t = first; t < first + many; ++t) ++count[t];
        sum += many;
      });
      rows[piece].push_back(static_cast<uint32_t>(found[piece].size() - before));
      first_slot[order[i].index + 1] = sum;
    }
  });

  frame.starts = Buffer((tiles + 1) * sizeof(int64_t));
  int64_t* const starts = frame.starts.as<int64_t>();
  int64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    starts[tile] = total;
    for (int64_t piece = 0; piece < pieces; ++piece) {
      const uint32_t many = counts[piece * tiles + tile];
      counts[piece * tiles + tile] = static_cast<uint32_t>(total);
      total += many;
    }
  }
  starts[tiles] = total;
  if (total > INT32_MAX) throw std::length_error("more than 2^31 intersections of Gaussians with tiles");
  frame.intersections = total;
  for (int64_t n = 0; n < frame.count; ++n) first_slot[n + 1] += first_slot[n];

  frame.entries = Buffer(std::max<int64_t>(total, 1) * sizeof(Entry));
  Entry* const entries = frame.entries.as<Entry>();
  parallel(pieces, [&](int64_t piece, int) {
    uint32_t* const next = counts + piece * tiles;
    const Span* span = found[piece].data();
    for (int64_t i = edge(piece); i < edge(piece + 1); ++i) {
      const uint32_t index = order[i].index;
      uint32_t slot = first_slot[index];
      for (uint32_t row = rows[piece][i - edge(piece)]; row > 0; --row, ++span)
        for (uint32_t t = span->first; t < span->first + span->count; ++t) entries[next[t]++] = {index, slot++};
    }
  });
}

Tile tile_of(const Frame& frame, int64_t at) {
  const int64_t* const starts = frame.starts.as<int64_t>();
  Tile tile;
  tile.x = static_cast<int>(at % frame.across) * TILE;
  tile.y = static_cast<int>(at / frame.across) * TILE;
  tile.width = std::min(TILE, frame.view.width - tile.x);
  tile.height = std::min(TILE, frame.view.height - tile.y);
  tile.entries = frame.entries.as<Entry>() + starts[at];
  tile.blocks = frame.blocks.as<uint64_t>() ? frame.blocks.as<uint64_t>() + starts[at] : nullptr;
  tile.count = starts[at + 1] - starts[at];
  return tile;
}

// Tiles with most entries first, so that no thread is left with a long one at the end.
std::vector<uint32_t> longest_first(const Frame& frame) {
  const int64_t* const starts = frame.starts.as<int64_t>();
  std::vector<uint32_t> order(static_cast<size_t>(frame.across) * frame.down);
  for (size_t i = 0; i < order.size(); ++i) order[i] = static_cast<uint32_t>(i);
  std::sort(order.begin(), order.end(), [&](uint32_t a, uint32_t b) {
    const int64_t many = starts[a + 1] - starts[a], few = starts[b + 1] - starts[b];
    return many != few ? many > few : a < b;
  });
  return order;
}

}  // namespace

FrameStatistics& last_frame() {
  static FrameStatistics* statistics = new FrameStatistics;
  return *statistics;
}

std::unique_ptr<Frame> forward(const Inputs& in, const View& view, const Images& out, int32_t* radii, bool keep) {
  auto frame = std::make_unique<Frame>();
  const Kernels& use = *(frame->kernels = &kernels());
  FrameStatistics statistics;
  Clock clock;
  frame->view = view;
  frame->count = in.count;
  frame->across = (view.width + TILE - 1) / TILE;
  frame->down = (view.height + TILE - 1) / TILE;
  frame->splats = Buffer(std::max<int64_t>(in.count, 1) * sizeof(Splat));
  Splat* const splats = frame->splats.as<Splat>();
  std::atomic<bool> fine{true};
  parallel_ranges(in.count, 1024, [&](int64_t begin, int64_t end, int) {
    if (!use.project(in, view, splats, radii, begin, end)) fine = false;
  });
  if (!fine) return nullptr;
  statistics.project = clock.lap();

  Buffer keys(std::max<int64_t>(in.count, 1) * 2 * sizeof(Key));
  const int64_t visible = sort_by_depth(splats, in.count, keys.as<Key>(), keys.as<Key>() + in.count);
  statistics.sort = clock.lap();
  bin(*frame, keys.as<Key>(), visible);
  statistics.bin = clock.lap();

  if (keep) frame->blocks = Buffer(std::max<int64_t>(frame->intersections, 1) * sizeof(uint64_t));
  const int64_t floats = use.scratch(in.channels);
  Buffer scratch(threads() * (floats + 16) * sizeof(float));
  const auto order = longest_first(*frame);
  std::atomic<int64_t> evaluations{0};
  parallel(static_cast<int64_t>(order.size()), [&](int64_t item, int thread) {
    evaluations += use.blend(in, splats, tile_of(*frame, order[item]), view, out,
                             scratch.as<float>() + thread * ((floats + 15) / 16 * 16));
  });
  statistics.blend = clock.lap();
  statistics.visible = visible;
  statistics.intersections = frame->intersections;
  statistics.evaluations = evaluations;
  last_frame() = statistics;
  return frame;
}

void backward(const Frame& frame, const Inputs& in, const ConstImages& out, const ConstImages& grad,
              const Gradients& gradients) {
  const Kernels& use = *frame.kernels;
  Clock clock;
  const int64_t size = slot_size(in.channels), floats = (use.scratch(in.channels) + 15) / 16 * 16;
  Buffer slots(std::max<int64_t>(frame.intersections, 1) * size * sizeof(float));
  Buffer scratch(threads() * floats * sizeof(float));
  const auto order = longest_first(frame);
  parallel(static_cast<int64_t>(order.size()), [&](int64_t item, int thread) {
    use.blend_backward(in, frame.splats.as<Splat>(), tile_of(frame, order[item]), frame.view, out, grad,
                       slots.as<float>(), scratch.as<float>() + thread * floats);
  });
  last_frame().blend_backward = clock.lap();
  parallel_ranges(in.count, 512, [&](int64_t begin, int64_t end, int) {
    use.project_backward(in, frame.view, frame.splats.as<Splat>(), frame.first_slot.as<uint32_t>(),
                         slots.as<float>(), gradients, begin, end);
  });
  last_frame().project_backward = clock.lap();
}

double photometric(const float* x, const float* y, int64_t height, int64_t width, int channels, float absolute,
                   float structural, float* grad, double* ssim) {
  const Kernels& use = kernels();
  const int64_t n = width * channels, step = (n + 15) / 16 * 16, rows = 8;
  const int64_t floats = (4 * (step + 2 * SSIM_RADIUS * channels + 16) + 15) / 16 * 16;
  std::vector<double> apart(height, 0.0), alike(height, 0.0);
  Buffer partials_memory;
  float* partials = nullptr;
  if (structural != 0.0f) {
    Buffer moments(4 * height * step * sizeof(float)), scratch(threads() * floats * sizeof(float));
    if (grad) {
      partials_memory = Buffer(3 * height * step * sizeof(float));
      partials = partials_memory.as<float>();
    }
    parallel_ranges(height, rows, [&](int64_t begin, int64_t end, int thread) {
      for (int64_t row = begin; row < end; ++row)
        use.ssim_rows(x, y, moments.as<float>(), n, height, channels, row, scratch.as<float>() + thread * floats);
    });
    parallel_ranges(height, rows, [&](int64_t begin, int64_t end, int thread) {
      for (int64_t row = begin; row < end; ++row)
        use.ssim_map(moments.as<float>(), partials, n, height, channels, row, alike.data(),
                     scratch.as<float>() + thread * floats);
    });
  }
  const float scale = 1.0f / static_cast<float>(height * n);
  parallel_ranges(height, rows, [&](int64_t begin, int64_t end, int) {
    for (int64_t row = begin; row < end; ++row) {
      if (absolute != 0.0f) apart[row] = use.absolute(x + row * n, y + row * n, n);
      if (grad) use.ssim_gradient(x, y, partials, grad, n, height, row, absolute * scale, structural * scale);
    }
  });
  double sum = 0.0, total = 0.0;
  for (int64_t row = 0; row < height; ++row) {
    sum += apart[row];
    total += alike[row];
  }
  *ssim = total / static_cast<double>(height * n);
  return sum / static_cast<double>(height * n);
}

double reference_kernel() {
  constexpr int64_t PIECE = 16384, PIECES = 512;  // 32 MB
  Buffer memory(PIECE * PIECES * sizeof(float));
  float* const data = memory.as<float>();
  parallel(PIECES, [&](int64_t item, int) { std::fill(data + item * PIECE, data + (item + 1) * PIECE, 1.5f); });
  Clock clock;
  for (int pass = 0; pass < 4; ++pass)
    parallel(PIECES, [&](int64_t item, int) { kernels().reference(data + item * PIECE, PIECE, 60); });
  for (int pass = 0; pass < 8; ++pass)
    parallel(PIECES, [&](int64_t item, int) { kernels().reference(data + item * PIECE, PIECE, 1); });
  return clock.lap();
}

double bench_blend(int channels, bool backward) {
  // Sixty-four Gaussians of one tile: 4 KB of splats, state and all in L1.
  constexpr int COUNT = 64;
  const Kernels& use = kernels();
  std::vector<float> means(3 * COUNT), quats(4 * COUNT), scales(3 * COUNT), opacities(COUNT),
      features(static_cast<size_t>(COUNT) * channels, 0.5f);
  std::vector<Splat> splats(COUNT);
  std::vector<Entry> entries(COUNT);
  std::vector<uint64_t> blocks(COUNT);
  std::vector<int32_t> radii(COUNT);
  View view = {{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}, 16, 16, 8, 8, 0.2, TILE, TILE};
  for (int i = 0; i < COUNT; ++i) {
    means[3 * i] = static_cast<float>(i % 8) / 8 - 0.4375f;
    means[3 * i + 1] = static_cast<float>(i / 8) / 8 - 0.4375f;
    means[3 * i + 2] = 1.0f;
    quats[4 * i] = 1.0f;
    for (int k = 0; k < 3; ++k) scales[3 * i + k] = 0.16f;
    opacities[i] = 0.1f;  // sixty-four of them leave the pixels alive
    entries[i] = {static_cast<uint32_t>(i), static_cast<uint32_t>(i)};
  }
  const Inputs in = {means.data(), quats.data(), scales.data(), opacities.data(), features.data(), nullptr, COUNT, channels};
  use.project(in, view, splats.data(), radii.data(), 0, COUNT);
  const Tile tile = {0, 0, TILE, TILE, entries.data(), blocks.data(), COUNT};
  const int pixels = TILE * TILE;
  std::vector<float> image(static_cast<size_t>(pixels) * channels), alpha(pixels), depth(pixels);
  std::vector<float> grad(static_cast<size_t>(pixels) * channels, 1.0f), slots(static_cast<size_t>(COUNT) * slot_size(channels));
  Buffer scratch(use.scratch(channels) * sizeof(float));
  const Images out = {image.data(), alpha.data(), depth.data()};
  const ConstImages made = {image.data(), alpha.data(), depth.data()}, outer = {grad.data(), nullptr, nullptr};
  double best = 0.0;
  const int64_t per_tile = use.blend(in, splats.data(), tile, view, out, scratch.as<float>());
  for (int round = 0; round < 10; ++round) {
    Clock clock;
    constexpr int REPEATS = 100;
    for (int i = 0; i < REPEATS; ++i) {
      if (backward) use.blend_backward(in, splats.data(), tile, view, made, outer, slots.data(), scratch.as<float>());
      else use.blend(in, splats.data(), tile, view, out, scratch.as<float>());
    }
    best = std::max(best, static_cast<double>(per_tile) * REPEATS / clock.lap());
  }
  return best;
}

}  // namespace econgs
