// Blending a tile front to back, and its gradients (Kerbl et al. 2023, section 6 and appendix C).
//
// A vector covers a block of 4 x LANES/4 pixels. For each Gaussian of the tile, near to far, the blocks that its
// ellipse meets are first listed (a bit mask) and then visited; the state of the pixels lies in L1. Forward keeps
// in the mask the blocks in which the Gaussian counted, and backward visits exactly those.
#pragma once

#include "simd.h"
#include "table.h"

namespace ECONGS_ISA {

using namespace econgs;

constexpr int BLOCK_ROWS = LANES / 4;
constexpr int BANDS = TILE / BLOCK_ROWS;     // rows of blocks, four blocks each
constexpr int BLOCKS = 4 * BANDS;
constexpr int PIXELS = TILE * TILE;
constexpr int BAND_VECTORS = (BANDS + LANES - 1) / LANES;

struct Lattice {
  alignas(64) float x[PIXELS], y[PIXELS];         // pixel centres, by block and lane
  alignas(64) float first[LANES * BAND_VECTORS];  // centre of the first and last pixel row of each band
};

INLINE void make_lattice(Lattice& at) {
  for (int block = 0; block < BLOCKS; ++block)
    for (int l = 0; l < LANES; ++l) {
      at.x[block * LANES + l] = (float)(block % 4 * 4 + l % 4) + 0.5f;
      at.y[block * LANES + l] = (float)(block / 4 * BLOCK_ROWS + l / 4) + 0.5f;
    }
  for (int band = 0; band < LANES * BAND_VECTORS; ++band) at.first[band] = (float)(band * BLOCK_ROWS) + 0.5f;
}

// Calls emit(i, x, y, many) for each row of four pixels of a block: i is the place of the first in the state, (x, y)
// its place in the tile, of which `many` pixels of the row are part.
template <class Emit>
INLINE void rows_of(const Tile& tile, Emit emit) {
  for (int block = 0; block < BLOCKS; ++block)
    for (int row = 0; row < BLOCK_ROWS; ++row) {
      const int i = block * LANES + 4 * row, x = block % 4 * 4, y = block / 4 * BLOCK_ROWS + row;
      if (y >= tile.height || x >= tile.width) continue;
      if (x + 4 <= tile.width) emit(i, x, y, 4);  // a constant, which unrolls the loop over them
      else emit(i, x, y, tile.width - x);
    }
}

INLINE vf power_of_two(vi n) { return (vf)((n + 127) << 23); }

// The blocks of a tile that a splat's ellipse meets; (u, v) is its centre within the tile.
INLINE uint64_t blocks_met(const Splat& s, float u, float v, const Lattice& at) {
  uint64_t mask = 0;
  for (int part = 0; part < BAND_VECTORS; ++part) {
    const vf low = load(at.first + part * LANES) - v;
    const vf high = low + (float)(BLOCK_ROWS - 1);
    const vf above = max(low, set(-s.top)), below = min(high, set(s.top));
    const vf at_right = max(above, min(below, set(s.tip)));
    const vf at_left = max(above, min(below, set(-s.tip)));
    const vf right =
        s.slope * at_right + sqrt(max(s.bound - at_right * at_right * s.inverse, vf{}) * s.width2) + (u - 0.5f);
    const vf left =
        s.slope * at_left - sqrt(max(s.bound - at_left * at_left * s.inverse, vf{}) * s.width2) + (u + 0.5f);
    // Pixels from floor(left) to floor(right), which is exact where both are positive.
    const vi from = __builtin_convertvector(min(max(left, vf{}), set(16.0f)), vi);
    const vi to = __builtin_convertvector(min(max(right, set(-1.0f)), set(15.0f)), vi);
    const vi some = (above <= below) & (right >= vf{}) & (from <= to);
    // Bits from..to of the four blocks of each band, as floats (exact, and SSE2 cannot shift lane by lane); four
    // bands make 16 bits.
    const vf bits = (vf)(some & (vi)(power_of_two((to >> 2) + 1) - power_of_two(from >> 2)));
    for (int i = 0; i < LANES / 4 && part * LANES + 4 * i < BANDS; ++i) {
      const v4 four = quarter(bits, i) * v4{1.0f, 16.0f, 256.0f, 4096.0f};
      const v4 two = four + shuffle(four, four, 2, 3, 0, 1);
      mask |= (uint64_t)(uint32_t)(int32_t)(two[0] + two[1]) << (4 * (part * LANES + 4 * i));
    }
  }
  return mask;
}

// What both passes compute alike; `ok` says where the Gaussian is blended.
struct Sample {
  vf across, dy, raised, alpha, after;
  vi valid, ok;
};

// A splat's numbers in every lane.
struct Shape {
  vf u, v, slope, a, c, lift, depth;
};

INLINE Shape shape_of(const Splat& s, float u, float v) {
  return {set(u), set(v), set(s.slope), set(s.a), set(s.c), set(s.lift), set(s.depth)};
}

INLINE Sample evaluate(const Shape& s, const Lattice& at, int block, vf transmittance) {
  Sample r;
  r.dy = load(at.y + block * LANES) - s.v;
  r.across = fma(-r.dy, s.slope, load(at.x + block * LANES) - s.u);
  vf power = fma(r.across * s.a, r.across, fma(r.dy * s.c, r.dy, s.lift));
  power = max(power, set(-40.0f));
  r.raised = exp2(power);
  r.alpha = min(r.raised, set(MAX_ALPHA));
  r.valid = r.alpha >= MIN_ALPHA;
  r.after = fma(-r.alpha, transmittance, transmittance);
  r.ok = r.valid & (r.after >= MIN_TRANSMITTANCE);
  return r;
}

// State in scratch, each of PIXELS floats: transmittance (negative: the pixel has ended), depth, features.
template <int FIXED>
static int64_t blend_channels(const Inputs& in, const Splat* splats, const Tile& tile, const View& view,
                              const Images& out, float* scratch) {
  const int channels = FIXED ? FIXED : in.channels;
  if (!tile.count) {
    for (int y = tile.y; y < tile.y + tile.height; ++y) {
      const int64_t pixel = (int64_t)y * view.width + tile.x;
      __builtin_memset(out.alpha + pixel, 0, tile.width * sizeof(float));
      __builtin_memset(out.depth + pixel, 0, tile.width * sizeof(float));
      __builtin_memset(out.features + pixel * channels, 0, tile.width * channels * sizeof(float));
    }
    return 0;
  }
  Lattice at;
  make_lattice(at);
  float* const passing = scratch;
  float* const depth = scratch + PIXELS;
  float* const color = scratch + 2 * PIXELS;
  uint64_t alive = 0;
  for (int block = 0; block < BLOCKS; ++block) {
    const vi inside =
        (load(at.x + block * LANES) < (float)tile.width) & (load(at.y + block * LANES) < (float)tile.height);
    store(passing + block * LANES, inside ? set(1.0f) : set(-1.0f));
    if (signs(inside)) alive |= (uint64_t)1 << block;
  }
  for (int64_t i = PIXELS; i < (2 + channels) * (int64_t)PIXELS; i += LANES) store(scratch + i, vf{});

  int64_t evaluations = 0;
  int64_t e = 0;
  for (; e < tile.count && alive; ++e) {
    if (e + 6 < tile.count) {
      __builtin_prefetch(splats + tile.entries[e + 6].splat);
      __builtin_prefetch(in.features + (int64_t)tile.entries[e + 6].splat * channels);
    }
    const Splat& s = splats[tile.entries[e].splat];
    const float* const feature = in.features + (int64_t)tile.entries[e].splat * channels;
    const float u = (float)(s.u - tile.x), v = (float)(s.v - tile.y);
    uint64_t mask = blocks_met(s, u, v, at) & alive;
    evaluations += __builtin_popcountll(mask);
    uint64_t blended = 0;
    const Shape shape = shape_of(s, u, v);
    vf fixed[FIXED ? FIXED : 1];
    for (int k = 0; k < FIXED; ++k) fixed[k] = set(feature[k]);
    for (; mask; mask &= mask - 1) {
      const int block = __builtin_ctzll(mask);
      float* const p = passing + block * LANES;
      const vf transmittance = load(p);
      const Sample r = evaluate(shape, at, block, transmittance);
      const vf weight = where(r.ok, r.alpha * transmittance);
      // A pixel that would fall under the limit ends: its transmittance turns negative and stays.
      const vf ended = (vf)((vi)transmittance | (r.valid & INT32_MIN));
      const vf next = r.ok ? r.after : ended;
      store(p, next);
      float* const z = depth + block * LANES;
      store(z, fma(weight, shape.depth, load(z)));
      for (int k = 0; k < channels; ++k) {
        float* const c = color + k * PIXELS + block * LANES;
        store(c, fma(weight, FIXED ? fixed[FIXED ? k : 0] : set(feature[k]), load(c)));
      }
      blended |= (uint64_t)(signs(r.ok) != 0) << block;
      alive &= ~((uint64_t)(signs((vi)next) == ALL_LANES) << block);
    }
    if (tile.blocks) tile.blocks[e] = blended;
  }
  if (tile.blocks)
    for (; e < tile.count; ++e) tile.blocks[e] = 0;

  rows_of(tile, [&](int i, int x, int y, int many) {
    const int64_t pixel = (int64_t)(tile.y + y) * view.width + tile.x + x;
    for (int l = 0; l < many; ++l) {
      out.alpha[pixel + l] = 1.0f - __builtin_fabsf(passing[i + l]);
      out.depth[pixel + l] = depth[i + l];
      for (int k = 0; k < channels; ++k) out.features[(pixel + l) * channels + k] = color[k * PIXELS + i + l];
    }
  });
  return evaluations * LANES;
}

// State: transmittance, rest (what lies behind, as dL), gradients of alpha, depth and features.
template <int FIXED, bool DEPTH>
static void blend_backward_channels(const Inputs& in, const Splat* splats, const Tile& tile, const View& view,
                                    const ConstImages& out, const ConstImages& grad, float* slots, float* scratch) {
  if (!tile.count) return;
  const int channels = FIXED ? FIXED : in.channels;
  const int size = slot_size(channels);
  Lattice at;
  make_lattice(at);
  float* const passing = scratch;
  float* const rest = scratch + PIXELS;
  float* const grad_alpha = scratch + 2 * PIXELS;
  float* const grad_depth = scratch + 3 * PIXELS;
  float* const grad_color = scratch + 4 * PIXELS;
  vf* const sum_color = (vf*)(scratch + (4 + channels) * (int64_t)PIXELS);
  if (tile.width < TILE || tile.height < TILE) {  // pixels outside the image have ended and pass nothing on
    for (int i = 0; i < PIXELS; i += LANES) store(passing + i, set(-1.0f));
    for (int64_t i = PIXELS; i < (4 + channels) * (int64_t)PIXELS; i += LANES) store(scratch + i, vf{});
  }
  rows_of(tile, [&](int i, int x, int y, int many) {
    const int64_t pixel = (int64_t)(tile.y + y) * view.width + tile.x + x;
    for (int l = 0; l < many; ++l) {
      passing[i + l] = 1.0f;
      grad_alpha[i + l] = grad.alpha ? grad.alpha[pixel + l] : 0.0f;
      grad_depth[i + l] = DEPTH ? grad.depth[pixel + l] : 0.0f;
      double total = (double)grad_alpha[i + l] * out.alpha[pixel + l];
      if (DEPTH) total += (double)grad_depth[i + l] * out.depth[pixel + l];
      for (int k = 0; k < channels; ++k) {
        const float g = grad.features ? grad.features[(pixel + l) * channels + k] : 0.0f;
        grad_color[k * PIXELS + i + l] = g;
        total += (double)g * out.features[(pixel + l) * channels + k];
      }
      rest[i + l] = (float)total;
    }
  });

  for (int64_t e = 0; e < tile.count; ++e) {
    if (e + 6 < tile.count) {
      __builtin_prefetch(splats + tile.entries[e + 6].splat);
      __builtin_prefetch(in.features + (int64_t)tile.entries[e + 6].splat * channels);
      __builtin_prefetch(slots + (int64_t)tile.entries[e + 6].slot * size, 1);
    }
    float* const slot = slots + (int64_t)tile.entries[e].slot * size;
    uint64_t mask = tile.blocks[e];
    if (!mask) {
      for (int q = 0; q < size; q += 4) *(v4_unaligned*)(slot + q) = v4{};
      continue;
    }
    const Splat& s = splats[tile.entries[e].splat];
    const float* const feature = in.features + (int64_t)tile.entries[e].splat * channels;
    const float u = (float)(s.u - tile.x), v = (float)(s.v - tile.y);
    const Shape shape = shape_of(s, u, v);
    vf fixed[FIXED ? FIXED : 1];
    for (int k = 0; k < FIXED; ++k) fixed[k] = set(feature[k]);
    vf m0 = {}, mx = {}, my = {}, mxx = {}, mxy = {}, myy = {}, mz = {};
    vf fixed_color[FIXED ? FIXED : 1];
    vf* const mc = FIXED ? fixed_color : sum_color;
    for (int k = 0; k < channels; ++k) mc[k] = vf{};
    for (; mask; mask &= mask - 1) {
      const int block = __builtin_ctzll(mask);
      float* const p = passing + block * LANES;
      const vf transmittance = load(p);
      const Sample r = evaluate(shape, at, block, transmittance);
      const vf weight = where(r.ok, r.alpha * transmittance);
      const vf ended = (vf)((vi)transmittance | (r.valid & INT32_MIN));
      store(p, r.ok ? r.after : ended);
      // dL/dweight
      vf weight_grad = load(grad_alpha + block * LANES);
      if (DEPTH) {
        const vf g = load(grad_depth + block * LANES);
        weight_grad = fma(g, shape.depth, weight_grad);
        mz = fma(weight, g, mz);
      }
      for (int k = 0; k < channels; ++k) {
        const vf g = load(grad_color + k * PIXELS + block * LANES);
        weight_grad = fma(g, FIXED ? fixed[FIXED ? k : 0] : set(feature[k]), weight_grad);
        mc[k] = fma(weight, g, mc[k]);
      }
      float* const behind = rest + block * LANES;
      const vf remaining = fma(-weight, weight_grad, load(behind));
      store(behind, remaining);
      const vf clear = 1.0f - r.alpha;
      // alpha dL/dalpha; an alpha held at 0.99 passes no gradient on
      const vf slope = fma(weight_grad, transmittance, -remaining / clear);
      const vf h = where(r.ok & (r.raised <= MAX_ALPHA), slope * r.alpha);
      const vf hx = h * r.across, hy = h * r.dy;
      m0 += h;
      mx += hx;
      my += hy;
      mxx = fma(hx, r.across, mxx);
      mxy = fma(hx, r.dy, mxy);
      myy = fma(hy, r.dy, myy);
    }
    *(v4_unaligned*)slot = sums(m0, mx, my, mxx);
    if (FIXED == 1 || FIXED == 2 || FIXED == 3 || FIXED == 4) {
      const vf none = {};
      *(v4_unaligned*)(slot + 4) = sums(mxy, myy, mz, mc[0]);
      if (FIXED > 1)
        *(v4_unaligned*)(slot + 8) = sums(mc[FIXED > 1 ? 1 : 0], FIXED > 2 ? mc[FIXED > 2 ? 2 : 0] : none,
                                          FIXED > 3 ? mc[FIXED > 3 ? 3 : 0] : none, none);
    } else {
      *(v4_unaligned*)(slot + 4) = sums(mxy, myy, mz, mc[0]);
      for (int k = 1; k < channels; ++k) slot[SLOT_FEATURES + k] = sum(mc[k]);
    }
  }
}

static int64_t blend_scratch(int channels) { return (4 + channels) * (int64_t)PIXELS + channels * LANES; }

static int64_t blend(const Inputs& in, const Splat* splats, const Tile& tile, const View& view, const Images& out,
                     float* scratch) {
  switch (in.channels) {
    case 1: return blend_channels<1>(in, splats, tile, view, out, scratch);
    case 3: return blend_channels<3>(in, splats, tile, view, out, scratch);
    case 4: return blend_channels<4>(in, splats, tile, view, out, scratch);
    default: return blend_channels<0>(in, splats, tile, view, out, scratch);
  }
}

template <bool DEPTH>
static void blend_backward_depth(const Inputs& in, const Splat* splats, const Tile& tile, const View& view,
                                 const ConstImages& out, const ConstImages& grad, float* slots, float* scratch) {
  switch (in.channels) {
    case 1: return blend_backward_channels<1, DEPTH>(in, splats, tile, view, out, grad, slots, scratch);
    case 3: return blend_backward_channels<3, DEPTH>(in, splats, tile, view, out, grad, slots, scratch);
    case 4: return blend_backward_channels<4, DEPTH>(in, splats, tile, view, out, grad, slots, scratch);
    default: return blend_backward_channels<0, DEPTH>(in, splats, tile, view, out, grad, slots, scratch);
  }
}

static void blend_backward(const Inputs& in, const Splat* splats, const Tile& tile, const View& view,
                           const ConstImages& out, const ConstImages& grad, float* slots, float* scratch) {
  if (grad.depth) blend_backward_depth<true>(in, splats, tile, view, out, grad, slots, scratch);
  else blend_backward_depth<false>(in, splats, tile, view, out, grad, slots, scratch);
}

}  // namespace ECONGS_ISA
