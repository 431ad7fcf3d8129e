// Decoding the anchors of one view: the driver of kernels/decoder_block.h. N anchors in blocks of 64, K Gaussians each,
// M of them not culled.
//
//   torch's tensors of the networks --- pack --> weights as the kernels read them; the embedding joins the biases
//
//   begin    features, eye --> inputs --> hidden units --> tanh opacities [N x K] --> M, first row of every block
//               (block by block)            |
//                                           v kept for backward
//   (Python allocates the M rows)
//   finish   inputs --> hidden units --> raw outputs --> activations, shading --> means, quats, scales, opacities,
//               (block by block)            |            + anchors, offsets,      colors, slots [M]
//                                           v kept         scalings
//   backward gradients [M] --> planes --> of raw outputs --> of hidden units --> of anchors, features, scalings,
//               (16 pieces of blocks)           |                  |             offsets
//                                               +--- sums of the weights and the palette, piece by piece --- unpack
//
// Rows of a block are anchors; planes hold one attribute of all its Gaussians (see kernels/decoder_block.h). Neither
// blocks nor pieces depend on the number of threads, so the sums do not either.
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
  Buffer packed, rows, raw;  // weights; hidden units and raw outputs, if kept
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

// Colors (count x 3) of Gaussians whose attributes were decoded before.
void shade(const ShadeInputs&, const DecodeView&, int64_t count, float* colors);

}  // namespace econgs
