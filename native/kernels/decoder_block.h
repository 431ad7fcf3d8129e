// Decoding anchors to Gaussians (ECoNGS; econgs/anchors/decode.py holds the formulas and the oracle), block by block.
//
// Rows are anchors, so features need no transposition: lanes run along hidden units and outputs. Outputs lie by
// attribute (attribute * K + offset), so that copying runs of K floats turns a block's rows into planes, one per
// attribute, in which lanes run along Gaussians in the order of their slots. Copies of runs go in whole vectors: what
// spills over is overwritten by the next run.
#pragma once

#include "decoder_types.h"
#include "gemm.h"
#include "simd.h"
#include "table.h"

namespace ECONGS_ISA {

using namespace econgs;

INLINE vf bounded_exp2(vf x) { return exp2(min(max(x, set(-99.0f)), set(99.0f))); }
INLINE vf sigmoid(vf x) { return 1.0f / (1.0f + bounded_exp2(x * -1.44269504f)); }

INLINE vf tanh(vf x) {
  const vf square = x * x;  // near 0 by its series: 1 - 2 / (1 + e^2x) would cancel
  vf series = fma(square, set(2.18694885e-2f), set(-5.39682540e-2f));
  series = fma(series, square, set(1.33333333e-1f));
  series = fma(series, square, set(-3.33333333e-1f));
  series = fma(series * square, x, x);
  const vf far = 1.0f - 2.0f / (1.0f + bounded_exp2(x * 2.88539008f));
  return square < 0.0625f ? series : far;
}

// Of positive normal floats, relative error 2e-7 also near 1, where a power of 50 would show it.
INLINE vf log2(vf x) {
  const vi bits = (vi)x - 0x3f3504f3;  // sqrt(1/2)
  const vf exponent = __builtin_convertvector(bits >> 23, vf);
  const vf m = (vf)((bits & 0x007fffff) + 0x3f3504f3) - 1.0f;
  const vf s = m / (m + 2.0f), q = s * s;
  vf p = fma(q, set(3.20598898e-1f), set(4.12198583e-1f));
  p = fma(p, q, set(5.77078016e-1f));
  p = fma(p, q, set(9.61796694e-1f));
  p = fma(p, q, set(2.88539008f));
  return fma(s, p, exponent);
}

struct V3 {
  vf x, y, z;
};
INLINE V3 operator+(V3 a, V3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE V3 operator-(V3 a, V3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
INLINE V3 operator*(V3 a, vf s) { return {a.x * s, a.y * s, a.z * s}; }
INLINE vf dot(V3 a, V3 b) { return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z)); }
INLINE V3 set3(const float* p) { return {set(p[0]), set(p[1]), set(p[2])}; }
INLINE V3 load3(const float* p, int64_t stride) { return {load(p), load(p + stride), load(p + 2 * stride)}; }
INLINE void store3(float* p, int64_t stride, V3 v) {
  store(p, v.x);
  store(p + stride, v.y);
  store(p + 2 * stride, v.z);
}

// A vector divided by its length; shorter ones are zero and pass no gradient (inverse = 0).
struct Direction {
  V3 unit;
  vf inverse;
};
INLINE Direction direction(V3 v) {
  const vf length = sqrt(dot(v, v));
  const vf inverse = length > MIN_LENGTH ? 1.0f / length : vf{};
  return {v * inverse, inverse};
}
INLINE V3 direction_backward(const Direction& to, V3 grad) {
  return (grad - to.unit * dot(to.unit, grad)) * to.inverse;
}

// Planes of a block, in this order; raw outputs come without their activations.
enum { RAW_SCALE = 0, RAW_QUAT = 3, RAW_COLOR = 7, RAW_AMBIENT = 10 };
enum { RAW_DIFFUSE = 11, RAW_SPECULAR, RAW_SHININESS, RAW_NORMAL };
enum { AT_MEAN = 0, AT_SCALING = 3, AT_OPACITY = 6, AT_PLANES };      // by slot, from the anchors
enum { OUT_MEAN = 0, OUT_QUAT = 3, OUT_SCALE = 7, OUT_COLOR = 10, OUT_PLANES = 13 };

struct Shaded {
  V3 base, color;              // color before it is clamped
  vf ambient, diffuse, specular, shininess;  // specular and shininess with their factors
  vf bounded_specular, bounded_shininess;    // sigmoids
  V3 normal;
  vf normal_inverse;
  vi normal_long;
  Direction view, half;
  vf toward, peak, base_log, cosine;         // n.l, |n.h|^shininess, log2 of its base, n.h
  vi lit;
};

// All but base, coefficients and the sigmoids, which are there.
INLINE void light_up(Shaded& s, V3 normal, V3 mean, const DecodeView& view) {
  const vf length = sqrt(dot(normal, normal));
  s.normal_long = length >= MIN_NORMAL;
  s.normal_inverse = 1.0f / max(length, set(MIN_NORMAL));
  s.normal = normal * s.normal_inverse;
  s.view = direction(set3(view.eye) - mean);
  if (view.headlight) {
    s.half = s.view;
    s.toward = s.cosine = dot(s.normal, s.view.unit);
  } else {
    const V3 light = set3(view.light);
    s.half = direction(s.view.unit + light);
    s.toward = dot(s.normal, light);
    s.cosine = dot(s.normal, s.half.unit);
  }
  s.lit = s.toward != vf{};
  s.base_log = log2(max(abs(s.cosine), set(MIN_BASE)));
  const vf exponent = s.shininess * s.base_log;
  s.peak = (exponent > -64.0f) & s.lit ? bounded_exp2(exponent) : vf{};
  const vf body = fma(s.diffuse, abs(s.toward), s.ambient), highlight = s.specular * s.peak;
  s.color = {fma(s.base.x, body, highlight), fma(s.base.y, body, highlight), fma(s.base.z, body, highlight)};
}

INLINE Shaded shade(const float* raw, int64_t plane, V3 mean, const DecodeView& view) {
  Shaded s;
  const V3 color = load3(raw + RAW_COLOR * plane, plane);
  const V3 offset = view.sigmoid_color ? V3{sigmoid(color.x), sigmoid(color.y), sigmoid(color.z)}
                                       : V3{tanh(color.x), tanh(color.y), tanh(color.z)};
  s.base = set3(view.palette) + offset;
  s.ambient = load(raw + RAW_AMBIENT * plane) * view.ambient;
  s.diffuse = load(raw + RAW_DIFFUSE * plane) * view.diffuse;
  s.bounded_specular = sigmoid(load(raw + RAW_SPECULAR * plane));
  s.bounded_shininess = sigmoid(load(raw + RAW_SHININESS * plane));
  s.specular = s.bounded_specular * (MAX_SPECULAR * view.specular);
  s.shininess = s.bounded_shininess * (MAX_SHININESS * view.shininess);
  light_up(s, load3(raw + RAW_NORMAL * plane, plane), mean, view);
  return s;
}

// The color without shading.
INLINE V3 plain_color(const float* raw, int64_t plane) {
  const V3 color = load3(raw + RAW_COLOR * plane, plane);
  return {sigmoid(color.x), sigmoid(color.y), sigmoid(color.z)};
}

INLINE vf clamp01(vf x) { return min(max(x, vf{}), set(1.0f)); }

// The transposed rows of up to LANES Gaussians, `width` floats each; lanes past the last row repeat it.
template <int WIDTH>
INLINE void columns_of(const float* rows, int count, float* columns) {
  for (int l = 0; l < LANES; ++l)
    for (int d = 0; d < WIDTH; ++d) columns[d * LANES + l] = rows[WIDTH * (l < count ? l : count - 1) + d];
}

// Colors of Gaussians [begin, end) from attributes after activation.
static void shade_rows(const ShadeInputs& in, const DecodeView& view, int64_t begin, int64_t end, float* colors) {
  const Flush flush;
  for (int64_t i = begin; i < end; i += LANES) {
    const int count = end - i < LANES ? (int)(end - i) : LANES;
    float mean[3 * LANES], normal[3 * LANES], base[3 * LANES], coefficients[4 * LANES];
    columns_of<3>(in.means + 3 * i, count, mean);
    columns_of<3>(in.normals + 3 * i, count, normal);
    columns_of<3>(in.base + 3 * i, count, base);
    columns_of<4>(in.coefficients + 4 * i, count, coefficients);
    Shaded s;
    s.base = load3(base, LANES);
    s.ambient = load(coefficients);
    s.diffuse = load(coefficients + LANES);
    s.specular = load(coefficients + 2 * LANES);
    s.shininess = load(coefficients + 3 * LANES);
    light_up(s, load3(normal, LANES), load3(mean, LANES), view);
    const vf color[3] = {clamp01(s.color.x), clamp01(s.color.y), clamp01(s.color.z)};
    for (int l = 0; l < count; ++l)
      for (int d = 0; d < 3; ++d) colors[3 * (i + l) + d] = color[d][l];
  }
}

// `runs` times K floats, and what spills over to the next whole vector.
template <int VECTORS>
INLINE void copy_runs_of(const float* from, int64_t from_step, float* to, int64_t to_step, int count, int runs) {
  for (int r = 0; r < runs; ++r, from += from_step, to += to_step)
    for (int i = 0; VECTORS ? i < VECTORS * LANES : i < count; i += LANES) store(to + i, load(from + i));
}
INLINE void copy_runs(const float* from, int64_t from_step, float* to, int64_t to_step, int count, int runs) {
  if (count <= LANES) copy_runs_of<1>(from, from_step, to, to_step, count, runs);
  else if (count <= 2 * LANES) copy_runs_of<2>(from, from_step, to, to_step, count, runs);
  else copy_runs_of<0>(from, from_step, to, to_step, count, runs);
}
INLINE void fill_run(float* to, float value, int count) {
  for (int i = 0; i < count; i += LANES) store(to + i, set(value));
}
// Exactly n floats.
INLINE void copy(const float* from, float* to, int64_t n) {
  int64_t i = 0;
  for (; i + LANES <= n; i += LANES) store(to + i, load(from + i));
  if (i < n && n >= LANES) store(to + n - LANES, load(from + n - LANES));
  else
    for (; i < n; ++i) to[i] = from[i];
}

// Rows of three floats as vectors of four: the fourth belongs to the next row, which the last row does not have.
INLINE v4 row3(const float* p, bool last) { return last ? load3(p) : load4(p); }
INLINE void put3(float* p, v4 v, bool last) {
  if (!last) return store4(p, v);
  for (int d = 0; d < 3; ++d) p[d] = v[d];
}
// Slots i to i + 3 of three or four planes, as rows.
INLINE Square rows3(const float* planes, int64_t plane, int64_t i) {
  const v4 z = load4(planes + 2 * plane + i);
  return transposed(load4(planes + i), load4(planes + plane + i), z, z);
}
INLINE Square rows4(const float* planes, int64_t plane, int64_t i) {
  return transposed(load4(planes + i), load4(planes + plane + i), load4(planes + 2 * plane + i),
                    load4(planes + 3 * plane + i));
}

// Floats of scratch: inputs, hidden units and outputs of a block as rows, then two sets of planes.
struct DecodeScratch {
  float *inputs, *hidden, *outputs, *hidden_grad, *raw, *at, *planes;
};

static int64_t decode_layout(const DecodeShape& s, float* memory, DecodeScratch* parts) {
  int64_t size = 0;
  const auto take = [&](int64_t floats) __attribute__((always_inline)) {
    float* const part = memory + size;
    size += floats;
    return part;
  };
  DecodeScratch p;
  p.inputs = take((int64_t)DECODE_BLOCK * s.input_stride + 16);
  p.hidden = take((int64_t)DECODE_BLOCK * s.hidden_stride + 16);
  p.hidden_grad = take((int64_t)DECODE_BLOCK * s.hidden_stride + 16);
  p.outputs = take((int64_t)DECODE_BLOCK * s.out_stride + 16);
  p.raw = take((int64_t)RAW_PLANES * s.plane);
  p.at = take((int64_t)AT_PLANES * s.plane);
  p.planes = take((int64_t)(OUT_PLANES + 1) * s.plane);
  if (parts) *parts = p;
  return size;
}

static int64_t decode_scratch(const DecodeShape& s) { return decode_layout(s, nullptr, nullptr); }

// The unit vector from the eye to an anchor; returns 1 / distance, 0 for an anchor in the eye.
INLINE float from_eye(const float* anchor, const float* eye, float* unit) {
  float square = 0.0f;
  for (int d = 0; d < 3; ++d) {
    unit[d] = anchor[d] - eye[d];
    square += unit[d] * unit[d];
  }
  const float length = __builtin_sqrtf(square), inverse = length > MIN_LENGTH ? 1.0f / length : 0.0f;
  for (int d = 0; d < 3; ++d) unit[d] *= inverse;
  return inverse;
}

// Inputs of the networks as rows: features, then the unit vector from the camera.
INLINE void decode_inputs(const DecodeShape& s, const DecodeInputs& in, const DecodeView& view, int64_t begin,
                          int count, float* rows) {
  for (int a = 0; a < count; ++a) {
    float* const to = rows + (int64_t)a * s.input_stride;
    copy(in.features + (begin + a) * s.features, to, s.features);
    if (s.directions) from_eye(in.anchors + 3 * (begin + a), view.eye, to + s.features);
  }
}

INLINE bool finite(const float* p, int64_t n) {
  vf wrong = {};
  int64_t i = 0;
  for (; i + LANES <= n; i += LANES) wrong += 0.0f * load(p + i);
  for (; i < n; ++i) wrong[0] += 0.0f * p[i];
  return signs(wrong == vf{}) == ALL_LANES;
}

// Opacities of anchors [begin, end), at most a block: `raw` gets tanh (count x K), `rows` the hidden units, or null.
// Returns the number of Gaussians that are not culled, -1 if an input is not finite.
static int64_t decode_opacity(const DecodeShape& s, const DecodeInputs& in, const DecodeView& view,
                              const DecodeWeights& w, int64_t begin, int64_t end, float* raw, float* rows,
                              float* memory) {
  const Flush flush;
  const int count = (int)(end - begin);
  DecodeScratch scratch;
  decode_layout(s, memory, &scratch);
  if (!finite(in.features + begin * s.features, (int64_t)count * s.features) ||
      !finite(in.anchors + 3 * begin, 3 * count) || !finite(in.scalings + 6 * begin, 6 * count) ||
      !finite(in.offsets + 3 * begin * s.offsets, (int64_t)3 * count * s.offsets))
    return -1;
  decode_inputs(s, in, view, begin, count, scratch.inputs);
  float* const hidden = rows ? rows : scratch.hidden;
  product<RELU>(count, s.hidden, s.inputs, {scratch.inputs, s.input_stride, 1}, w.first_t, s.hidden_stride, hidden,
                s.hidden_stride, w.first_bias);
  const int width = whole16(s.out_width[NET_OPACITY]);
  product<BIAS>(count, s.offsets, s.hidden, {hidden, s.hidden_stride, 1}, w.second_t[NET_OPACITY], width,
                scratch.outputs, width, w.second_bias[NET_OPACITY]);
  float* const packed = scratch.planes;
  copy_runs(scratch.outputs, width, packed, s.offsets, s.offsets, count);
  const int slots = count * s.offsets;
  int64_t kept = 0;
  const bool any = view.opacity > 0.0f;
  int i = 0;
  for (; i + LANES <= slots; i += LANES) {
    const vf t = tanh(load(packed + i));
    store(raw + i, t);
    kept += any ? __builtin_popcount(signs(t > vf{})) : 0;
  }
  if (i < slots) {
    const vf t = tanh(load(packed + i));
    for (int l = 0; i + l < slots; ++l) {
      raw[i + l] = t[l];
      kept += any && t[l] > 0.0f;
    }
  }
  return kept;
}

// What the planes need of the anchors: means, the last three scalings, and tanh opacities (0 past the end).
INLINE void decode_anchors(const DecodeShape& s, const DecodeInputs& in, const float* opacity, int64_t begin, int count,
                           float* at) {
  const int many = s.offsets, slots = count * many;
  const int64_t plane = s.plane, all = in.count * many;
  float* const means = at + AT_MEAN * plane;
  for (int a = 0; a < count; ++a) {
    const float* const scaling = in.scalings + 6 * (begin + a);
    const v4 anchor = load3(in.anchors + 3 * (begin + a)), stretch = load3(scaling);
    for (int k = 0; k < many; k += 4) {
      v4 row[4];
      for (int j = 0; j < 4; ++j) {
        const int64_t n = (begin + a) * many + k + j;
        row[j] = anchor + (n < all ? row3(in.offsets + 3 * n, n + 1 == all) : v4{}) * stretch;
      }
      const Square columns = transposed(row[0], row[1], row[2], row[3]);
      for (int d = 0; d < 3; ++d) store4(means + d * plane + a * many + k, columns.row[d]);
    }
    for (int d = 0; d < 3; ++d) fill_run(at + (AT_SCALING + d) * plane + a * many, scaling[3 + d], many);
  }
  float* const t = at + AT_OPACITY * plane;
  copy(opacity, t, slots);
  for (int i = slots; i < slots + LANES; ++i) t[i] = 0.0f;
}

// The Gaussians of a block, from `raw` on: rows [first, last) of the outputs. `rows` holds the hidden units of the
// opacity network or is null; `kept` is where the planes of raw outputs stay for the backward pass, or null.
static void decode_block(const DecodeShape& s, const DecodeInputs& in, const DecodeView& view, const DecodeWeights& w,
                         int64_t begin, int64_t end, const float* opacity, int64_t first, int64_t last,
                         const DecodeOutputs& out, float* rows, float* kept, float* memory) {
  const Flush flush;
  const int count = (int)(end - begin), many = s.offsets;
  const int64_t plane = s.plane;
  DecodeScratch scratch;
  decode_layout(s, memory, &scratch);
  float* const hidden = rows ? rows : scratch.hidden;
  float* const raw = kept ? kept : scratch.raw;
  decode_inputs(s, in, view, begin, count, scratch.inputs);
  product<RELU>(count, (s.nets - 1) * s.hidden, s.inputs, {scratch.inputs, s.input_stride, 1}, w.first_t + s.hidden,
                s.hidden_stride, hidden + s.hidden, s.hidden_stride, w.first_bias + s.hidden);
  int into = 0;
  for (int net = NET_COVARIANCE; net < s.nets; ++net) {
    const int width = whole16(s.out_width[net]);
    product<BIAS>(count, s.out_width[net], s.hidden, {hidden + net * s.hidden, s.hidden_stride, 1}, w.second_t[net],
                  width, scratch.outputs, width, w.second_bias[net]);
    for (int attribute = 0; attribute < s.attributes[net]; ++attribute, ++into)
      copy_runs(scratch.outputs + attribute * many, width, raw + into * plane, many, many, count);
  }
  decode_anchors(s, in, opacity, begin, count, scratch.at);

  const int slots = count * many;
  const bool shaded = s.nets == NETS;
  float* const planes = scratch.planes;
  for (int i = 0; i < slots; i += LANES) {
    const float *const from = raw + i, *const at = scratch.at + i;
    V3 color;
    if (shaded) {
      const V3 lit = shade(from, plane, load3(at + AT_MEAN * plane, plane), view).color;
      color = {clamp01(lit.x), clamp01(lit.y), clamp01(lit.z)};
    } else {
      color = plain_color(from, plane);
    }
    store3(planes + OUT_COLOR * plane + i, plane, color);
    for (int d = 0; d < 3; ++d)
      store(planes + (OUT_SCALE + d) * plane + i,
            load(at + (AT_SCALING + d) * plane) * sigmoid(load(from + (RAW_SCALE + d) * plane)));
    const vf q0 = load(from + RAW_QUAT * plane);
    const V3 q = load3(from + (RAW_QUAT + 1) * plane, plane);
    const vf square = fma(q0, q0, dot(q, q));
    const vi sound = square > 1e-24f;
    const vf inverse = sound ? 1.0f / sqrt(square) : vf{};
    store(planes + OUT_QUAT * plane + i, sound ? q0 * inverse : set(1.0f));
    store3(planes + (OUT_QUAT + 1) * plane + i, plane, q * inverse);
  }
  if (!(view.opacity > 0.0f)) return;
  const float* const t = scratch.at + AT_OPACITY * plane;
  float *const means = out.means, *const quats = out.quats, *const scales = out.scales, *const colors = out.colors,
               *const opacities = out.opacities;
  int64_t* const places = out.slots;
  int64_t n = first;
  for (int i = 0; i < slots; i += 4) {
    const Square mean = rows3(scratch.at + AT_MEAN * plane, plane, i),
                 quat = rows4(planes + OUT_QUAT * plane, plane, i), scale = rows3(planes + OUT_SCALE * plane, plane, i),
                 color = rows3(planes + OUT_COLOR * plane, plane, i);
    for (int j = 0; j < 4; ++j) {
      if (!(t[i + j] > 0.0f)) continue;  // also past the end
      // Another thread writes the rows after the block's last.
      put3(means + 3 * n, mean.row[j], n + 1 == last);
      store4(quats + 4 * n, quat.row[j]);
      put3(scales + 3 * n, scale.row[j], n + 1 == last);
      put3(colors + 3 * n, color.row[j], n + 1 == last);
      opacities[n] = t[i + j];
      places[n++] = begin * many + i + j;
    }
  }
}

// Gradients of the outputs as planes by slot (0 where culled and past the end). `all`: the number of their rows.
template <int WIDTH>
INLINE void decode_scatter(const float* t, int slots, int64_t plane, int64_t first, int64_t all, const float* from,
                           float* planes) {
  if (!from) {
    for (int d = 0; d < WIDTH; ++d)
      for (int i = 0; i < slots; i += LANES) store(planes + d * plane + i, vf{});
    return;
  }
  int64_t n = first;
  for (int i = 0; i < slots; i += 4) {
    v4 row[4];
    for (int j = 0; j < 4; ++j) {
      row[j] = v4{};
      if (!(t[i + j] > 0.0f)) continue;
      if (WIDTH == 1) row[j][0] = from[n];
      else row[j] = WIDTH == 4 ? load4(from + 4 * n) : row3(from + 3 * n, n + 1 == all);
      ++n;
    }
    const Square columns = transposed(row[0], row[1], row[2], row[3]);
    for (int d = 0; d < WIDTH; ++d) store4(planes + d * plane + i, columns.row[d]);
  }
  for (int d = 0; d < WIDTH; ++d)
    for (int i = (slots + 3) / 4 * 4; i < slots + LANES; ++i) planes[d * plane + i] = 0.0f;
}

// From the gradient of shaded colors (planes OUT_COLOR of `grad`) to those of raw outputs, of means (added to planes
// OUT_MEAN) and of the palette.
INLINE void shade_backward(const DecodeView& view, int64_t plane, vi visible, const float* at, const float* from,
                           float* to, float* grad, V3& palette) {
  const V3 mean = load3(at + AT_MEAN * plane, plane);
  const Shaded s = shade(from, plane, mean, view);

  const V3 outer = load3(grad + OUT_COLOR * plane, plane);
  const V3 g = {where(visible & (s.color.x >= 0.0f) & (s.color.x <= 1.0f), outer.x),
                where(visible & (s.color.y >= 0.0f) & (s.color.y <= 1.0f), outer.y),
                where(visible & (s.color.z >= 0.0f) & (s.color.z <= 1.0f), outer.z)};
  const vf cosine = abs(s.toward);
  const V3 base = g * fma(s.diffuse, cosine, s.ambient);
  palette = palette + V3{where(visible, base.x), where(visible, base.y), where(visible, base.z)};
  const V3 offset = s.base - set3(view.palette);
  const V3 color = view.sigmoid_color
                       ? V3{offset.x * (1.0f - offset.x), offset.y * (1.0f - offset.y), offset.z * (1.0f - offset.z)}
                       : V3{1.0f - offset.x * offset.x, 1.0f - offset.y * offset.y, 1.0f - offset.z * offset.z};
  store3(to + RAW_COLOR * plane, plane, {base.x * color.x, base.y * color.y, base.z * color.z});
  const vf body = dot(g, s.base), highlight = g.x + g.y + g.z;
  store(to + RAW_AMBIENT * plane, body * view.ambient);
  store(to + RAW_DIFFUSE * plane, body * cosine * view.diffuse);
  const vf specular = highlight * s.peak * (MAX_SPECULAR * view.specular);
  store(to + RAW_SPECULAR * plane, specular * s.bounded_specular * (1.0f - s.bounded_specular));
  const vf peak = highlight * s.specular * s.peak;  // times the logarithm's derivatives
  store(to + RAW_SHININESS * plane, peak * s.base_log * (0.693147181f * MAX_SHININESS * view.shininess) *
                                        s.bounded_shininess * (1.0f - s.bounded_shininess));
  const vf size = abs(s.cosine);
  const vf along_half = size >= MIN_BASE ? peak * s.shininess / s.cosine : vf{};
  const vf diffuse = body * s.diffuse;
  const vf along_light = s.toward > vf{} ? diffuse : s.toward < vf{} ? -diffuse : vf{};
  V3 normal, to_view;
  if (view.headlight) {
    const vf along = along_half + along_light;
    normal = s.view.unit * along;
    to_view = s.normal * along;
  } else {
    normal = set3(view.light) * along_light + s.half.unit * along_half;
    to_view = direction_backward(s.half, s.normal * along_half);
  }
  const vf held = s.normal_long ? dot(s.normal, normal) : vf{};
  const V3 to_normal = (normal - s.normal * held) * s.normal_inverse;
  store3(to + RAW_NORMAL * plane, plane, to_normal);
  const V3 to_mean = load3(grad + OUT_MEAN * plane, plane) - direction_backward(s.view, to_view);
  store3(grad + OUT_MEAN * plane, plane, to_mean);
}

INLINE void plain_color_backward(int64_t plane, vi visible, const float* from, float* to, const float* grad) {
  const V3 outer = load3(grad + OUT_COLOR * plane, plane), color = plain_color(from, plane);
  store3(
      to + RAW_COLOR * plane, plane,
      {where(visible, outer.x) * (color.x * (1.0f - color.x)), where(visible, outer.y) * (color.y * (1.0f - color.y)),
       where(visible, outer.z) * (color.z * (1.0f - color.z))});
}

// From gradients of the Gaussians (`planes`) to those of raw outputs (planes `to`, and for the raw opacity plane
// OUT_PLANES of `planes`). Plane OUT_MEAN + d of `planes` then holds the gradient of the mean, OUT_SCALE + d that of
// the last three scalings.
INLINE void decode_activations_backward(const DecodeView& view, bool shaded, int slots, int64_t plane, const float* at,
                                        const float* raw, float* to_raw, float* planes, V3& palette) {
  for (int i = 0; i < slots; i += LANES) {
    const float* const from = raw + i;
    float *const to = to_raw + i, *const grad = planes + i;
    const vf t = load(at + AT_OPACITY * plane + i);
    const vi visible = t > vf{};
    if (shaded) shade_backward(view, plane, visible, at + i, from, to, grad, palette);
    else plain_color_backward(plane, visible, from, to, grad);

    for (int d = 0; d < 3; ++d) {
      const vf bounded = sigmoid(load(from + (RAW_SCALE + d) * plane));
      const vf scale = load(grad + (OUT_SCALE + d) * plane) * bounded;
      store(grad + (OUT_SCALE + d) * plane, scale);
      store(to + (RAW_SCALE + d) * plane, scale * load(at + (AT_SCALING + d) * plane + i) * (1.0f - bounded));
    }
    const vf q0 = load(from + RAW_QUAT * plane), g0 = load(grad + OUT_QUAT * plane);
    const V3 q = load3(from + (RAW_QUAT + 1) * plane, plane), g3 = load3(grad + (OUT_QUAT + 1) * plane, plane);
    const vf square = fma(q0, q0, dot(q, q));
    const vf inverse = square > 1e-24f ? 1.0f / sqrt(square) : vf{};
    const vf turned = fma(g0, q0, dot(g3, q)) * inverse * inverse;
    store(to + RAW_QUAT * plane, (g0 - q0 * turned) * inverse);
    store3(to + (RAW_QUAT + 1) * plane, plane, (g3 - q * turned) * inverse);

    const vf opacity = visible ? load(grad + OUT_PLANES * plane) : vf{};
    store(grad + OUT_PLANES * plane, opacity * (1.0f - t * t));
  }
}

// Gradients of anchors [begin, end), at most a block; those of weights and palette are added to `sums`. `rows` and
// `raw` are what the forward pass kept.
static void decode_backward(const DecodeShape& s, const DecodeInputs& in, const DecodeView& view,
                            const DecodeWeights& w, int64_t begin, int64_t end, const float* opacity, int64_t first,
                            int64_t all, const float* rows, const float* raw, const ConstDecodeOutputs& grad,
                            const DecodeInputGradients& to, const DecodeGradients& sums, float* memory) {
  const Flush flush;
  const int count = (int)(end - begin), many = s.offsets, slots = count * many;
  const int64_t plane = s.plane;
  DecodeScratch scratch;
  decode_layout(s, memory, &scratch);
  float* const planes = scratch.planes;
  decode_anchors(s, in, opacity, begin, count, scratch.at);
  const float* const t = scratch.at + AT_OPACITY * plane;
  decode_scatter<3>(t, slots, plane, first, all, grad.means, planes + OUT_MEAN * plane);
  decode_scatter<4>(t, slots, plane, first, all, grad.quats, planes + OUT_QUAT * plane);
  decode_scatter<3>(t, slots, plane, first, all, grad.scales, planes + OUT_SCALE * plane);
  decode_scatter<3>(t, slots, plane, first, all, grad.colors, planes + OUT_COLOR * plane);
  decode_scatter<1>(t, slots, plane, first, all, grad.opacities, planes + OUT_PLANES * plane);
  V3 palette = {};
  decode_activations_backward(view, s.nets == NETS, slots, plane, scratch.at, raw, scratch.raw, planes, palette);
  sums.palette[0] += sum(palette.x);
  sums.palette[1] += sum(palette.y);
  sums.palette[2] += sum(palette.z);

  // Second layers: rows again, then gradients of the weights and of the hidden units.
  int from = 0;
  for (int net = 0; net < s.nets; ++net) {
    const int width = whole16(s.out_width[net]);
    const float* const source = net == NET_OPACITY ? planes + OUT_PLANES * plane : scratch.raw + from * plane;
    for (int a = 0; a < count; ++a)  // row by row: the last run may spill into the next row
      copy_runs(source + a * many, plane, scratch.outputs + (int64_t)a * width, many, many, s.attributes[net]);
    if (net != NET_OPACITY) from += s.attributes[net];
    for (int o = 0; o < s.out_width[net]; o += LANES) {
      vf total = {};
      for (int a = 0; a < count; ++a) total += load(scratch.outputs + (int64_t)a * width + o);
      store(sums.second_bias[net] + o, load(sums.second_bias[net] + o) + total);
    }
    product<ADD>(s.hidden, s.out_width[net], count, {rows + net * s.hidden, 1, s.hidden_stride}, scratch.outputs, width,
                 sums.second_t[net], width, nullptr);
    product<GATE>(count, s.hidden, s.out_width[net], {scratch.outputs, width, 1}, w.second[net], whole16(s.hidden),
                  scratch.hidden_grad + net * s.hidden, s.hidden_stride, rows + net * s.hidden);
  }
  const int units = s.nets * s.hidden;
  for (int a = 0; a < count; ++a)
    for (int j = units; j < units + LANES; ++j) scratch.hidden_grad[(int64_t)a * s.hidden_stride + j] = 0.0f;

  // First layers.
  decode_inputs(s, in, view, begin, count, scratch.inputs);
  for (int j = 0; j < units; j += LANES) {
    vf total = {};
    for (int a = 0; a < count; ++a) total += load(scratch.hidden_grad + (int64_t)a * s.hidden_stride + j);
    store(sums.first_bias + j, load(sums.first_bias + j) + total);
  }
  product<ADD>(s.inputs, units, count, {scratch.inputs, 1, s.input_stride}, scratch.hidden_grad, s.hidden_stride,
               sums.first_t, s.hidden_stride, nullptr);
  const int inputs = to.anchors ? s.inputs : s.features;
  product<PLAIN>(count, inputs, units, {scratch.hidden_grad, s.hidden_stride, 1}, w.first, s.input_stride,
                 scratch.inputs, s.input_stride, nullptr);

  for (int a = 0; a < count; ++a) {
    const int64_t n = begin + a;
    const float* const row = scratch.inputs + (int64_t)a * s.input_stride;
    copy(row, to.features + n * s.features, s.features);
    const v4 stretch = load3(in.scalings + 6 * n);
    v4 moved = {}, stretched = {}, scaled = {};
    for (int k = 0; k < many; k += 4) {
      const Square mean = rows3(planes + OUT_MEAN * plane, plane, a * many + k),
                   scale = rows3(planes + OUT_SCALE * plane, plane, a * many + k);
      for (int j = 0; j < 4 && k + j < many; ++j) {
        const int64_t slot = n * many + k + j;
        moved += mean.row[j];
        stretched += mean.row[j] * row3(in.offsets + 3 * slot, slot + 1 == in.count * many);
        scaled += scale.row[j];
        put3(to.offsets + 3 * slot, mean.row[j] * stretch, slot + 1 == end * many);
      }
    }
    for (int d = 0; d < 3; ++d) to.scalings[6 * n + d] = stretched[d];
    for (int d = 0; d < 3; ++d) to.scalings[6 * n + 3 + d] = scaled[d];
    if (!to.anchors) continue;
    v4 anchor = moved;
    if (s.directions) {
      float v[3], along = 0.0f;
      const float inverse = from_eye(in.anchors + 3 * n, view.eye, v);
      for (int d = 0; d < 3; ++d) along += v[d] * row[s.features + d];
      for (int d = 0; d < 3; ++d) anchor[d] += (row[s.features + d] - along * v[d]) * inverse;
    }
    for (int d = 0; d < 3; ++d) to.anchors[3 * n + d] = anchor[d];
  }
}

}  // namespace ECONGS_ISA
