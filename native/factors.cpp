#include "factors.h"

#include <algorithm>
#include <cmath>

#include "runtime.h"

namespace econgs {
namespace {

constexpr int64_t RAYS = 64, SAMPLES = 512, SLICE = 48;  // of one piece of work; slices are columns

// A ray in the box: sample k lies at from + k * by, in sides of the box, and within it for first <= k <= last.
struct Path {
  double from[3], by[3];
  int64_t first, last;
};

Path path_of(const Box& box, const RayBundle& rays, int64_t ray) {
  Path path;
  const double shift = rays.shift[ray];
  double low = 0.0, high = 1e9;
  for (int i = 0; i < 3; ++i) {
    const double by = box.step * box.inverse[i] * rays.directions[3 * ray + i];
    const double from = (rays.origins[3 * ray + i] - box.low[i]) * box.inverse[i] + shift * by;
    path.from[i] = from;
    path.by[i] = by;
    if (by != 0.0) {
      const double one = -from / by, other = (1.0 - from) / by;
      low = std::max(low, std::min(one, other));
      high = std::min(high, std::max(one, other));
    } else if (!(from >= 0.0 && from <= 1.0)) {
      high = -1.0;
    }
  }
  path.first = low < 1e9 ? static_cast<int64_t>(std::ceil(low)) : 1;
  path.last = low < 1e9 && high >= 0.0 ? static_cast<int64_t>(std::floor(high)) : -1;
  return path;
}

// Calls visit(k, place) for every sample in an occupied cell until it returns false.
template <class Visit>
void walk(const Box& box, const Path& path, Visit visit) {
  for (int64_t k = path.first; k <= path.last; ++k) {
    double place[3];
    int64_t cell[3];
    for (int i = 0; i < 3; ++i) {
      place[i] = std::min(std::max(path.from[i] + static_cast<double>(k) * path.by[i], 0.0), 1.0);
      cell[i] = std::min(static_cast<int64_t>(place[i] * static_cast<double>(box.across[i])), box.across[i] - 1);
    }
    if (box.cells[(cell[2] * box.across[1] + cell[1]) * box.across[0] + cell[0]] && !visit(k, place)) return;
  }
}

}  // namespace

void count_samples(const Box& box, const RayBundle& rays, int64_t most, int32_t* counts) {
  parallel_ranges(rays.count, RAYS, [&](int64_t begin, int64_t end, int) {
    for (int64_t ray = begin; ray < end; ++ray) {
      int32_t count = 0;
      walk(box, path_of(box, rays, ray), [&](int64_t, const double*) { return ++count < most; });
      counts[ray] = count;
    }
  });
}

void place_samples(const Box& box, const RayBundle& rays, const int64_t* first, float* places, int32_t* owners,
                   int32_t* numbers) {
  parallel_ranges(rays.count, RAYS, [&](int64_t begin, int64_t end, int) {
    for (int64_t ray = begin; ray < end; ++ray) {
      int64_t at = first[ray];
      walk(box, path_of(box, rays, ray), [&](int64_t k, const double* place) {
        if (at >= first[ray + 1]) return false;
        for (int i = 0; i < 3; ++i) places[3 * at + i] = static_cast<float>(place[i]);
        owners[at] = static_cast<int32_t>(ray);
        numbers[at++] = static_cast<int32_t>(k);
        return true;
      });
    }
  });
}

void ray_weights(const float* depths, const int64_t* first, int64_t count, float* weights) {
  parallel_ranges(count, RAYS, [&](int64_t begin, int64_t end, int) {
    for (int64_t ray = begin; ray < end; ++ray) {
      double through = 1.0;
      for (int64_t n = first[ray]; n < first[ray + 1]; ++n) {
        const double behind = through * std::exp(-static_cast<double>(depths[n]));
        weights[n] = static_cast<float>(through - behind);
        through = behind;
      }
    }
  });
}

// A depth lets less through to all samples behind, and more stays in its own.
void ray_weights_backward(const float* depths, const int64_t* first, int64_t count, const float* grad, float* to) {
  parallel_ranges(count, RAYS, [&](int64_t begin, int64_t end, int) {
    for (int64_t ray = begin; ray < end; ++ray) {
      double all = 0.0, through = 1.0;
      for (int pass = 0; pass < 2; ++pass) {
        double done = 0.0;
        through = 1.0;
        for (int64_t n = first[ray]; n < first[ray + 1]; ++n) {
          const double behind = through * std::exp(-static_cast<double>(depths[n])), g = grad[n];
          done += g * (through - behind);
          if (pass == 1) to[n] = static_cast<float>(g * behind - (all - done));
          through = behind;
        }
        all = done;
      }
    }
  });
}

void ray_sums(const float* rows, const int32_t* rays, int64_t samples, int64_t width, float* sums) {
  for (int64_t n = 0; n < samples; ++n) {
    float* const to = sums + rays[n] * width;
    const float* const from = rows + n * width;
    for (int64_t i = 0; i < width; ++i) to[i] += from[i];
  }
}

void products(const Lines& lines, int groups, const LineSamples& samples, int64_t count, float* out) {
  const int64_t channels = samples.mixing ? 3 : 1, apart = groups * channels;
  const int64_t pieces = (count + SAMPLES - 1) / SAMPLES;
  parallel(pieces * groups, [&](int64_t item, int) {
    const int64_t group = item / pieces, begin = item % pieces * SAMPLES, column = group * lines.ranks;
    Lines own = lines;
    LineSamples there = samples;
    for (auto& line : own.line) line += column;
    if (there.mixing) there.mixing += column;
    const int64_t end = std::min(begin + SAMPLES, count);
    kernels().line_products(own, there, begin, end, apart, out + group * channels);
  });
}

// Every slice of columns has gradients of its own: no two threads meet, and the order of sums is that of samples.
void products_backward(const Lines& lines, int groups, const LineSamples& samples, int64_t count, const float* grad,
                       float* const* to_lines, float* to_mixing) {
  const int64_t channels = samples.mixing ? 3 : 1;
  const int64_t slices = (lines.ranks + SLICE - 1) / SLICE;
  parallel(groups * slices, [&](int64_t item, int) {
    const int64_t group = item / slices, within = item % slices * SLICE, column = group * lines.ranks + within;
    Lines own = lines;
    own.ranks = static_cast<int>(std::min<int64_t>(SLICE, lines.ranks - within));
    LineSamples there = samples;
    float* to[3];
    for (int i = 0; i < 3; ++i) {
      own.line[i] += column;
      to[i] = to_lines[i] + column;
    }
    if (there.mixing) there.mixing += column;
    kernels().line_products_backward(own, there, count, groups * channels, grad + group * channels, to,
                                     to_mixing ? to_mixing + column : nullptr);
  });
}

}  // namespace econgs
