#include "decoder.h"

#include <algorithm>
#include <cstring>
#include <numeric>

namespace econgs {
namespace {

int64_t blocks_of(int64_t anchors) { return (anchors + DECODE_BLOCK - 1) / DECODE_BLOCK; }

bool all_finite(const float* p, int64_t n) {
  uint32_t wrong = 0;  // an OR of integers, which the compiler makes vectors of
  for (int64_t i = 0; i < n; ++i) {
    uint32_t bits;
    std::memcpy(&bits, p + i, 4);
    wrong |= (bits & 0x7f800000u) == 0x7f800000u;
  }
  return wrong == 0;
}

bool all_finite(const DecodeShape& s, const Networks& nets) {
  bool valid = all_finite(nets.embedding, s.embedding);
  for (int net = 0; net < s.nets; ++net)
    valid = valid && all_finite(nets.first[net], int64_t{1} * s.hidden * (s.inputs + s.embedding)) &&
            all_finite(nets.first_bias[net], s.hidden) &&
            all_finite(nets.second[net], int64_t{1} * s.out_width[net] * s.hidden) &&
            all_finite(nets.second_bias[net], s.out_width[net]);
  return valid;
}

// Parts of one piece of memory; with a null base it only counts.
class Parts {
 public:
  explicit Parts(float* base) : base_(base) {}
  float* take(int64_t floats) {
    float* const part = base_ ? base_ + size : nullptr;
    size += (floats + 15) / 16 * 16;
    return part;
  }
  int64_t size = 0;

 private:
  float* base_;
};

// Where packed weights lie: those of the forward pass in the layout of the gradients' sums, then those of the backward
// pass alone.
struct Packed : DecodeGradients {
  float *first, *second[NETS];
};

int64_t lay_out(const DecodeShape& s, float* base, bool sums, bool backward, Packed& p) {
  Parts parts(base);
  p.first_t = parts.take(int64_t{1} * s.inputs * s.hidden_stride);
  p.first_bias = parts.take(s.hidden_stride);
  for (int net = 0; net < s.nets; ++net) {
    p.second_t[net] = parts.take(int64_t{1} * s.hidden * whole16(s.out_width[net]));
    p.second_bias[net] = parts.take(whole16(s.out_width[net]));
  }
  if (sums) p.palette = parts.take(3);
  if (backward) {
    p.first = parts.take(int64_t{1} * s.nets * s.hidden * s.input_stride);
    for (int net = 0; net < s.nets; ++net)
      p.second[net] = parts.take(int64_t{1} * s.out_width[net] * whole16(s.hidden));
  }
  return parts.size;
}

void pack(const DecodeShape& s, const Networks& nets, DecodeFrame& frame) {
  Packed p;
  const int64_t size = lay_out(s, nullptr, false, frame.keep, p);
  frame.packed = Buffer(size * sizeof(float));
  float* const base = frame.packed.as<float>();
  std::memset(base, 0, size * sizeof(float));
  lay_out(s, base, false, frame.keep, p);
  const int wide = s.inputs + s.embedding;
  for (int net = 0; net < s.nets; ++net) {
    for (int j = 0; j < s.hidden; ++j) {
      const float* const row = nets.first[net] + int64_t{1} * j * wide;
      const int unit = net * s.hidden + j;
      for (int i = 0; i < s.inputs; ++i) p.first_t[int64_t{1} * i * s.hidden_stride + unit] = row[i];
      double bias = nets.first_bias[net][j];
      for (int e = 0; e < s.embedding; ++e) bias += static_cast<double>(row[s.inputs + e]) * nets.embedding[e];
      p.first_bias[unit] = static_cast<float>(bias);
      if (frame.keep) std::copy(row, row + s.inputs, p.first + int64_t{1} * unit * s.input_stride);
    }
    const int width = whole16(s.out_width[net]), hidden = whole16(s.hidden);
    for (int o = 0; o < s.out_width[net]; ++o) {
      const float* const row = nets.second[net] + int64_t{1} * o * s.hidden;
      for (int j = 0; j < s.hidden; ++j) p.second_t[net][int64_t{1} * j * width + o] = row[j];
      if (frame.keep) std::copy(row, row + s.hidden, p.second[net] + int64_t{1} * o * hidden);
      p.second_bias[net][o] = nets.second_bias[net][o];
    }
  }
  frame.weights.first_t = p.first_t;
  frame.weights.first_bias = p.first_bias;
  frame.weights.first = frame.keep ? p.first : nullptr;
  for (int net = 0; net < s.nets; ++net) {
    frame.weights.second_t[net] = p.second_t[net];
    frame.weights.second_bias[net] = p.second_bias[net];
    frame.weights.second[net] = frame.keep ? p.second[net] : nullptr;
  }
}

// From the layout of the kernels to that of torch.
void unpack(const DecodeShape& s, const Packed& sums, const Networks& nets, const NetworkGradients& to) {
  const int wide = s.inputs + s.embedding;
  std::vector<double> embedding(s.embedding, 0.0);
  for (int net = 0; net < s.nets; ++net) {
    for (int j = 0; j < s.hidden; ++j) {
      const int unit = net * s.hidden + j;
      float* const row = to.first[net] + int64_t{1} * j * wide;
      const float bias = to.first_bias[net][j] = sums.first_bias[unit];
      for (int i = 0; i < s.inputs; ++i) row[i] = sums.first_t[int64_t{1} * i * s.hidden_stride + unit];
      const float* const weights = nets.first[net] + int64_t{1} * j * wide + s.inputs;
      for (int e = 0; e < s.embedding; ++e) {
        row[s.inputs + e] = bias * nets.embedding[e];
        embedding[e] += static_cast<double>(bias) * weights[e];
      }
    }
    const int width = whole16(s.out_width[net]);
    for (int o = 0; o < s.out_width[net]; ++o) {
      for (int j = 0; j < s.hidden; ++j)
        to.second[net][int64_t{1} * o * s.hidden + j] = sums.second_t[net][int64_t{1} * j * width + o];
      to.second_bias[net][o] = sums.second_bias[net][o];
    }
  }
  for (int e = 0; e < s.embedding; ++e) to.embedding[e] = static_cast<float>(embedding[e]);
  std::copy(sums.palette, sums.palette + 3, to.palette);
}

int64_t raw_size(const DecodeShape& s) { return int64_t{1} * RAW_PLANES * s.plane; }

float* rows_of(const DecodeFrame& frame, int64_t block) {
  return frame.keep ? frame.rows.as<float>() + block * DECODE_BLOCK * frame.shape.hidden_stride : nullptr;
}

}  // namespace

DecodeShape decode_shape(int features, int directions, int embedding, int hidden, int offsets, bool shaded) {
  DecodeShape s = {};
  s.features = features;
  s.directions = directions;
  s.embedding = embedding;
  s.hidden = hidden;
  s.offsets = offsets;
  s.inputs = features + directions;
  s.input_stride = whole16(s.inputs);
  s.nets = shaded ? NETS : NETS - 1;
  s.hidden_stride = whole16(s.nets * hidden) + 16;  // the last network's pad
  s.out_stride = 0;
  for (int net = 0; net < s.nets; ++net) {
    s.attributes[net] = (shaded ? NET_ATTRIBUTES : PLAIN_ATTRIBUTES)[net];
    s.out_width[net] = s.attributes[net] * offsets;
    s.out_stride = std::max(s.out_stride, whole16(s.out_width[net]));
  }
  s.plane = whole16(DECODE_BLOCK * offsets) + 16;
  return s;
}

std::unique_ptr<DecodeFrame> decode_begin(const DecodeShape& shape, const DecodeInputs& in, const DecodeView& view,
                                          const Networks& nets, float* opacities, bool keep) {
  if (!all_finite(shape, nets) || !all_finite(view.palette, 3)) return nullptr;
  auto frame = std::make_unique<DecodeFrame>();
  frame->kernels = &kernels();
  frame->shape = shape;
  frame->view = view;
  frame->anchors = in.count;
  frame->keep = keep;
  pack(shape, nets, *frame);
  const int64_t blocks = blocks_of(in.count);
  if (keep) frame->rows = Buffer((blocks * DECODE_BLOCK * shape.hidden_stride + 16) * sizeof(float));
  const Scratch scratch(frame->kernels->decode_scratch(shape));
  std::vector<int64_t>& first = frame->first;
  first.assign(blocks + 1, 0);
  parallel(blocks, [&](int64_t block, int thread) {
    const int64_t begin = block * DECODE_BLOCK, end = std::min(in.count, begin + DECODE_BLOCK);
    first[block + 1] =
        frame->kernels->decode_opacity(shape, in, view, frame->weights, begin, end, opacities + begin * shape.offsets,
                                       rows_of(*frame, block), scratch.of(thread));
  });
  if (std::any_of(first.begin(), first.end(), [](int64_t n) { return n < 0; })) return nullptr;
  std::partial_sum(first.begin(), first.end(), first.begin());
  frame->gaussians = first.back();
  return frame;
}

void decode_finish(DecodeFrame& frame, const DecodeInputs& in, const float* opacities, const DecodeOutputs& out) {
  const DecodeShape& shape = frame.shape;
  const int64_t blocks = blocks_of(in.count);
  if (frame.gaussians == 0) return;
  if (frame.keep) frame.raw = Buffer(blocks * raw_size(shape) * sizeof(float));
  const Scratch scratch(frame.kernels->decode_scratch(shape));
  parallel(blocks, [&](int64_t block, int thread) {
    const int64_t begin = block * DECODE_BLOCK, end = std::min(in.count, begin + DECODE_BLOCK);
    float* const kept = frame.keep ? frame.raw.as<float>() + block * raw_size(shape) : nullptr;
    frame.kernels->decode_block(shape, in, frame.view, frame.weights, begin, end, opacities + begin * shape.offsets,
                                frame.first[block], frame.first[block + 1], out, rows_of(frame, block), kept,
                                scratch.of(thread));
  });
}

void decode_backward(const DecodeFrame& frame, const DecodeInputs& in, const Networks& nets, const float* opacities,
                     const ConstDecodeOutputs& grad, const DecodeInputGradients& to, const NetworkGradients& weights) {
  const DecodeShape& shape = frame.shape;
  const int64_t blocks = blocks_of(in.count);
  Packed sums;
  const int64_t size = lay_out(shape, nullptr, true, false, sums);
  const int64_t pieces = frame.gaussians ? std::min<int64_t>(blocks, DECODE_PIECES) : 0;
  const Buffer memory((pieces + 1) * size * sizeof(float));
  const Scratch scratch(frame.kernels->decode_scratch(shape));
  float* const total = memory.as<float>() + pieces * size;
  parallel(pieces, [&](int64_t piece, int thread) {
    float* const base = memory.as<float>() + piece * size;
    std::memset(base, 0, size * sizeof(float));
    Packed p;
    lay_out(shape, base, true, false, p);
    for (int64_t block = piece * blocks / pieces; block < (piece + 1) * blocks / pieces; ++block) {
      const int64_t begin = block * DECODE_BLOCK, end = std::min(in.count, begin + DECODE_BLOCK);
      frame.kernels->decode_backward(shape, in, frame.view, frame.weights, begin, end,
                                     opacities + begin * shape.offsets, frame.first[block], frame.gaussians,
                                     rows_of(frame, block), frame.raw.as<float>() + block * raw_size(shape), grad, to,
                                     p, scratch.of(thread));
    }
  });
  // Piece by piece in their order, whichever thread summed them.
  parallel_ranges(size, 4096, [&](int64_t begin, int64_t end, int) {
    std::fill(total + begin, total + end, 0.0f);
    for (int64_t piece = 0; piece < pieces; ++piece) {
      const float* const from = memory.as<float>() + piece * size;
      for (int64_t i = begin; i < end; ++i) total[i] += from[i];
    }
  });
  if (!pieces) {
    const int64_t n = in.count;
    std::fill(to.features, to.features + n * shape.features, 0.0f);
    std::fill(to.scalings, to.scalings + n * 6, 0.0f);
    std::fill(to.offsets, to.offsets + n * shape.offsets * 3, 0.0f);
    if (to.anchors) std::fill(to.anchors, to.anchors + n * 3, 0.0f);
  }
  lay_out(shape, total, true, false, sums);
  unpack(shape, sums, nets, weights);
}

void shade(const ShadeInputs& in, const DecodeView& view, int64_t count, float* colors) {
  parallel_ranges(count, 4096, [&](int64_t begin, int64_t end, int) { kernels().shade(in, view, begin, end, colors); });
}

}  // namespace econgs
