// Decoding the anchors of one view: packed weights, blocks and threads around the kernels of
// kernels/decoder_block.h.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "runtime.h"

namespace econgs {

// The networks' tensors as torch holds them: per network first weight (hidden x (inputs + embedding)), first bias,
// second weight (attributes * K x hidden), second bias. Without shading there are three networks.
struct Networks {
  const float *first[NETS], *first_bias[NETS], *second[NETS], *second_bias[NETS];
  const float* embedding;
};

struct NetworkGradients {  // overwritten
  float *first[NETS], *first_bias[NETS], *second[NETS], *second_bias[NETS], *embedding, *palette;
};

// One view of the anchors, with all that its backward pass needs.
struct DecodeFrame {
  const Kernels* kernels;
  DecodeShape shape;
  DecodeView view;
  int64_t anchors = 0, gaussians = 0;
  bool keep = false;
  Buffer packed, rows, raw;    // weights; hidden units and raw outputs, if kept
  DecodeWeights weights;
  std::vector<int64_t> first;  // row of the outputs, by block, and the number of all
};

DecodeShape decode_shape(int features, int directions, int embedding, int hidden, int offsets, bool shaded);

// Decodes the opacities (N x K). Returns null if an input or a weight is not finite.
std::unique_ptr<DecodeFrame> decode_begin(const DecodeShape&, const DecodeInputs&, const DecodeView&, const Networks&,
                                          float* opacities, bool keep);
// The Gaussians that are not culled; `opacities` as decode_begin left them.
void decode_finish(DecodeFrame&, const DecodeInputs&, const float* opacities, const DecodeOutputs&);
void decode_backward(const DecodeFrame&, const DecodeInputs&, const Networks&, const float* opacities,
                     const ConstDecodeOutputs& grad, const DecodeInputGradients&, const NetworkGradients&);

}  // namespace econgs
