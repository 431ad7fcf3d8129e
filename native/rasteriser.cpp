#include "rasteriser.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <utility>

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

// A run of tiles in one row of tiles that a Gaussian meets.
struct Span {
  uint32_t splat, first, count;
};

// Whole numbers next to x >= 0.
int floor_of(double x) { return static_cast<int>(x); }
int ceil_of(double x) {
  const int below = static_cast<int>(x);
  return below + (below < x);
}

// The tiles that an ellipse meets, one span per row of tiles. Rows and columns are those of pixel centres.
template <class Emit>
void spans(const Splat& s, const Frame& frame, Emit emit) {
  const double height = frame.view.height, width = frame.view.width;
  const double low = std::max(s.v - s.top, 0.5), high = std::min(s.v + s.top, height - 0.5);
  const int from = ceil_of(low - 0.5), to = floor_of(high - 0.5);
  if (from > to) return;
  if (from / TILE == to / TILE) {  // most Gaussians of a trained scene lie in one tile
    const int first = ceil_of(std::max(s.u - s.reach, 0.5) - 0.5);
    const int last = floor_of(std::min(s.u + s.reach, width - 0.5) - 0.5);
    if (first / TILE == last / TILE) return emit(from / TILE * frame.across + first / TILE, 1);
  }
  for (int row = from / TILE; row <= to / TILE; ++row) {
    const float above = static_cast<float>(std::max(row * TILE, from) + 0.5 - s.v);
    const float below = static_cast<float>(std::min(row * TILE + TILE - 1, to) + 0.5 - s.v);
    const float at_right = std::max(above, std::min(below, s.tip)), at_left = std::max(above, std::min(below, -s.tip));
    const float reach = std::sqrt(std::max(s.bound - at_right * at_right * s.inverse, 0.0f) * s.width2);
    const float back = std::sqrt(std::max(s.bound - at_left * at_left * s.inverse, 0.0f) * s.width2);
    const double left = std::clamp(s.u + (s.slope * at_left - back), 0.5, width);
    const double right = std::min(s.u + (s.slope * at_right + reach), width - 0.5);
    if (right < left) continue;
    const int first = ceil_of(left - 0.5), last = floor_of(right - 0.5);
    if (first > last) continue;
    emit(row * frame.across + first / TILE, last / TILE - first / TILE + 1);
  }
}

// A Gaussian in a tile before the tile is sorted. Depths are positive, so their bits sort as integers.
struct Intersection {
  uint32_t depth, splat, slot;
};

// Spans of a piece of the Gaussians, in memory that is handed round.
class SpanList {
 public:
  void reserve(int64_t capacity) { memory_ = Buffer((capacity_ = capacity) * sizeof(Span)); }
  void add(const Span& span) {
    if (size == capacity_) {
      Buffer larger(2 * capacity_ * sizeof(Span));
      std::memcpy(larger.as<Span>(), data(), size * sizeof(Span));
      memory_ = std::move(larger);
      capacity_ *= 2;
    }
    data()[size++] = span;
  }
  Span* data() const { return memory_.as<Span>(); }
  int64_t size = 0;

 private:
  Buffer memory_;
  int64_t capacity_ = 0;
};

// Distributes the Gaussians over the tiles, each tile's by index. Pieces of the Gaussians are counted and filled in
// parallel; the result does not depend on how many pieces there are. Returns the tiles' Gaussians, to be sorted.
Buffer bin(Frame& frame) {
  const Splat* const splats = frame.splats.as<Splat>();
  const int64_t tiles = static_cast<int64_t>(frame.across) * frame.down, count = frame.count;
  const int64_t pieces = std::clamp<int64_t>(count / 1024, 1, 2 * threads());
  const auto edge = [&](int64_t piece) { return count * piece / pieces; };
  Buffer counts_memory(pieces * tiles * sizeof(uint32_t));
  uint32_t* const counts = counts_memory.as<uint32_t>();
  struct Piece {
    SpanList spans;
    int64_t visible = 0, slots = 0;
  };
  std::vector<Piece> all(pieces);
  frame.first_slot = Buffer((count + 1) * sizeof(uint32_t));
  uint32_t* const first_slot = frame.first_slot.as<uint32_t>();

  parallel(pieces, [&](int64_t at, int) {
    uint32_t* const in_tile = counts + at * tiles;
    std::fill(in_tile, in_tile + tiles, 0);
    Piece piece;
    piece.spans.reserve((edge(at + 1) - edge(at)) * 3 / 2 + 64);
    for (int64_t n = edge(at); n < edge(at + 1); ++n) {
      first_slot[n] = static_cast<uint32_t>(piece.slots);
      if (splats[n].opacity <= 0.0f) continue;
      ++piece.visible;
      spans(splats[n], frame, [&](uint32_t first, uint32_t many) {
        piece.spans.add({static_cast<uint32_t>(n), first, many});
        for (uint32_t t = first; t < first + many; ++t) ++in_tile[t];
        piece.slots += many;
      });
    }
    all[at] = std::move(piece);
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
  first_slot[count] = static_cast<uint32_t>(total);
  int64_t slots = 0;
  for (Piece& piece : all) {
    slots += std::exchange(piece.slots, slots);
    frame.statistics.visible += piece.visible;
  }

  Buffer memory(std::max<int64_t>(total, 1) * sizeof(Intersection));
  Intersection* const unsorted = memory.as<Intersection>();
  parallel(pieces, [&](int64_t at, int) {
    uint32_t* const next = counts + at * tiles;
    uint32_t slot = static_cast<uint32_t>(all[at].slots);
    for (int64_t n = edge(at); n < edge(at + 1); ++n) first_slot[n] += slot;
    const Span* span = all[at].spans.data();
    for (const Span* const end = span + all[at].spans.size; span < end; ++span) {
      uint32_t depth;
      std::memcpy(&depth, &splats[span->splat].depth, 4);
      for (uint32_t t = span->first; t < span->first + span->count; ++t)
        unsorted[next[t]++] = {depth, span->splat, slot++};
    }
  });
  return memory;
}

struct Key {
  uint32_t depth, place;
};

// Sorts one tile near to far; equal depths stay in the order of their indices.
void sort_tile(const Intersection* unsorted, int64_t count, Entry* entries, Key* keys, Key* spare) {
  for (int64_t i = 0; i < count; ++i) keys[i] = {unsorted[i].depth, static_cast<uint32_t>(i)};
  if (count <= 32) {
    for (int64_t i = 1; i < count; ++i) {
      const Key key = keys[i];
      int64_t to = i;
      for (; to > 0 && keys[to - 1].depth > key.depth; --to) keys[to] = keys[to - 1];
      keys[to] = key;
    }
  } else {
    constexpr int BITS = 8, BINS = 1 << BITS, PASSES = 4;
    uint32_t bins[PASSES][BINS] = {};
    for (int64_t i = 0; i < count; ++i)
      for (int pass = 0; pass < PASSES; ++pass) ++bins[pass][keys[i].depth >> (BITS * pass) & (BINS - 1)];
    for (int pass = 0; pass < PASSES; ++pass) {
      uint32_t* const bin = bins[pass];
      if (bin[keys[0].depth >> (BITS * pass) & (BINS - 1)] == count) continue;  // all alike
      uint32_t start = 0;
      for (int i = 0; i < BINS; ++i) start += std::exchange(bin[i], start);
      for (int64_t i = 0; i < count; ++i) spare[bin[keys[i].depth >> (BITS * pass) & (BINS - 1)]++] = keys[i];
      std::swap(keys, spare);
    }
  }
  for (int64_t i = 0; i < count; ++i) entries[i] = {unsorted[keys[i].place].splat, unsorted[keys[i].place].slot};
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

std::unique_ptr<Frame> forward(const Inputs& in, const View& view, const Images& out, int32_t* radii, bool keep) {
  auto frame = std::make_unique<Frame>();
  const Kernels& use = *(frame->kernels = &kernels());
  FrameStatistics& statistics = frame->statistics;
  Clock clock;
  frame->view = view;
  frame->count = in.count;
  frame->across = (view.width + TILE - 1) / TILE;
  frame->down = (view.height + TILE - 1) / TILE;
  frame->splats = Buffer(std::max<int64_t>(in.count, 1) * sizeof(Splat));
  Splat* const splats = frame->splats.as<Splat>();
  std::atomic<bool> valid{true};
  parallel_ranges(in.count, 1024, [&](int64_t begin, int64_t end, int) {
    if (!use.project(in, view, splats, radii, begin, end)) valid = false;
  });
  if (!valid) return nullptr;
  statistics.project = clock.lap();

  const Buffer unsorted = bin(*frame);
  statistics.bin = clock.lap();

  frame->order = longest_first(*frame);
  frame->entries = Buffer(std::max<int64_t>(frame->intersections, 1) * sizeof(Entry));
  const int64_t* const starts = frame->starts.as<int64_t>();
  const int64_t longest = starts[frame->order[0] + 1] - starts[frame->order[0]];
  Buffer keys(threads() * 2 * (longest + 1) * sizeof(Key));
  parallel(static_cast<int64_t>(frame->order.size()), [&](int64_t item, int thread) {
    const int64_t start = starts[frame->order[item]];
    Key* const mine = keys.as<Key>() + thread * 2 * longest;
    sort_tile(unsorted.as<Intersection>() + start, starts[frame->order[item] + 1] - start,
              frame->entries.as<Entry>() + start, mine, mine + longest);
  });
  statistics.sort = clock.lap();

  if (keep) frame->blocks = Buffer(std::max<int64_t>(frame->intersections, 1) * sizeof(uint64_t));
  const Scratch scratch(use.scratch(in.channels));
  const auto& order = frame->order;
  std::atomic<int64_t> evaluations{0};
  parallel(static_cast<int64_t>(order.size()), [&](int64_t item, int thread) {
    evaluations += use.blend(in, splats, tile_of(*frame, order[item]), view, out, scratch.of(thread));
  });
  statistics.blend = clock.lap();
  statistics.evaluations = evaluations;
  return frame;
}

void backward(const Frame& frame, const Inputs& in, const ConstImages& out, const ConstImages& grad,
              const Gradients& gradients) {
  const Kernels& use = *frame.kernels;
  const int64_t size = slot_size(in.channels);
  Buffer slots(std::max<int64_t>(frame.intersections, 1) * size * sizeof(float));
  const Scratch scratch(use.scratch(in.channels));
  const auto& order = frame.order;
  parallel(static_cast<int64_t>(order.size()), [&](int64_t item, int thread) {
    use.blend_backward(in, frame.splats.as<Splat>(), tile_of(frame, order[item]), frame.view, out, grad,
                       slots.as<float>(), scratch.of(thread));
  });
  parallel_ranges(in.count, 512, [&](int64_t begin, int64_t end, int) {
    use.project_backward(in, frame.view, frame.splats.as<Splat>(), frame.first_slot.as<uint32_t>(), slots.as<float>(),
                         gradients, begin, end);
  });
}

double photometric(const float* x, const float* y, int64_t height, int64_t width, int channels, float absolute,
                   float structural, float* grad, double* ssim) {
  const Kernels& use = kernels();
  const int64_t n = width * channels, plane = (height + 2 * SSIM_RADIUS) * ((n + 15) / 16 * 16);
  std::vector<double> apart(height, 0.0), alike(height, 0.0);
  Buffer partials_memory;
  float* partials = nullptr;
  if (structural != 0.0f) {
    const Buffer moments(4 * plane * sizeof(float));
    const Scratch scratch(use.ssim_scratch(n, channels));
    if (grad) {
      partials_memory = Buffer(3 * plane * sizeof(float));
      partials = partials_memory.as<float>();
    }
    const auto padded_rows = [&](auto work) {
      parallel_ranges(height + 2 * SSIM_RADIUS, SSIM_BAND, [&](int64_t begin, int64_t end, int thread) {
        work(begin - SSIM_RADIUS, end - SSIM_RADIUS, scratch.of(thread));
      });
    };
    padded_rows([&](int64_t begin, int64_t end, float* mine) {
      use.ssim_rows(x, y, moments.as<float>(), n, height, channels, begin, end, mine);
    });
    padded_rows([&](int64_t begin, int64_t end, float* mine) {
      use.ssim_map(moments.as<float>(), partials, n, height, channels, begin, end, alike.data(), mine);
    });
  }
  const float scale = 1.0f / static_cast<float>(height * n);
  parallel_ranges(height, SSIM_BAND, [&](int64_t begin, int64_t end, int) {
    if (absolute != 0.0f)
      for (int64_t row = begin; row < end; ++row) apart[row] = use.absolute(x + row * n, y + row * n, n);
    if (grad) use.ssim_gradient(x, y, partials, grad, n, height, begin, end, absolute * scale, structural * scale);
  });
  double sum = 0.0, total = 0.0;
  for (int64_t row = 0; row < height; ++row) {
    sum += apart[row];
    total += alike[row];
  }
  *ssim = total / static_cast<double>(height * n);
  return sum / static_cast<double>(height * n);
}

ViewLoss view_loss(const float* color, const float* alpha, const float* truth, const float* back, int64_t height,
                   int64_t width, float absolute, float structural, float alpha_weight, float vanishing, float rescue,
                   float* grad_color, float* grad_alpha) {
  const Kernels& use = kernels();
  const int64_t pixels = height * width;
  const Buffer memory(2 * 3 * pixels * sizeof(float));
  float *const drawn = memory.as<float>(), *const target = drawn + 3 * pixels;
  std::vector<double> sums(3 * height);
  parallel_ranges(height, SSIM_BAND, [&](int64_t begin, int64_t end, int) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t at = row * width;
      use.composite(color + 3 * at, alpha + at, truth + 4 * at, back, drawn + 3 * at, target + 3 * at, width);
      if (alpha_weight > 0.0f) use.alpha_sums(alpha + at, truth + 4 * at, width, &sums[3 * row]);
    }
  });
  double total[3] = {0.0, 0.0, 0.0};
  for (int64_t i = 0; i < 3 * height; ++i) total[i % 3] += sums[i];
  const float weight =
      alpha_weight > 0.0f && total[0] < vanishing * total[1] ? std::max(alpha_weight, rescue) : alpha_weight;
  ViewLoss loss;
  loss.alpha = weight * total[2] / static_cast<double>(pixels);
  loss.absolute = photometric(drawn, target, height, width, 3, absolute, structural, grad_color, &loss.ssim);
  if (grad_color)
    parallel_ranges(height, SSIM_BAND, [&](int64_t begin, int64_t end, int) {
      const int64_t at = begin * width;
      use.alpha_gradient(grad_color + 3 * at, alpha + at, truth + 4 * at, back, weight / static_cast<float>(pixels),
                         grad_alpha + at, (end - begin) * width);
    });
  return loss;
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

double bench_blend(int channels) {
  // Sixty-four Gaussians of one tile: 4 KB of splats, state and all in L1.
  constexpr int COUNT = 64;
  const Kernels& use = kernels();
  std::vector<float> means(3 * COUNT), quats(4 * COUNT), scales(3 * COUNT), opacities(COUNT),
      features(static_cast<size_t>(COUNT) * channels, 0.5f);
  std::vector<Splat> splats(COUNT);
  std::vector<Entry> entries(COUNT);
  std::vector<uint64_t> blocks(COUNT);
  std::vector<int32_t> radii(COUNT);
  View view = {{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}, 16, 16, 8, 8, 0.2, 0.3, false, 0.0, TILE, TILE};
  for (int i = 0; i < COUNT; ++i) {
    means[3 * i] = static_cast<float>(i % 8) / 8 - 0.4375f;
    means[3 * i + 1] = static_cast<float>(i / 8) / 8 - 0.4375f;
    means[3 * i + 2] = 1.0f;
    quats[4 * i] = 1.0f;
    for (int k = 0; k < 3; ++k) scales[3 * i + k] = 0.16f;
    opacities[i] = 0.1f;  // sixty-four of them leave the pixels alive
    entries[i] = {static_cast<uint32_t>(i), static_cast<uint32_t>(i)};
  }
  const Inputs in = {means.data(),    quats.data(), scales.data(), opacities.data(),
                     features.data(), nullptr,      COUNT,         channels};
  use.project(in, view, splats.data(), radii.data(), 0, COUNT);
  const Tile tile = {0, 0, TILE, TILE, entries.data(), blocks.data(), COUNT};
  const int pixels = TILE * TILE;
  std::vector<float> image(static_cast<size_t>(pixels) * channels), alpha(pixels), depth(pixels);
  Buffer scratch(use.scratch(channels) * sizeof(float));
  const Images out = {image.data(), alpha.data(), depth.data()};
  double best = 0.0;
  const int64_t per_tile = use.blend(in, splats.data(), tile, view, out, scratch.as<float>());
  for (int round = 0; round < 10; ++round) {
    Clock clock;
    constexpr int REPEATS = 100;
    for (int i = 0; i < REPEATS; ++i) use.blend(in, splats.data(), tile, view, out, scratch.as<float>());
    best = std::max(best, static_cast<double>(per_tile) * REPEATS / clock.lap());
  }
  return best;
}

}  // namespace econgs
