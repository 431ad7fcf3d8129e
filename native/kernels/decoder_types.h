// The structs that the decoder's kernel (decoder_block.h) shares with its driver (../decoder.cpp). No std:: here (see
// simd.h).
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace econgs {

enum { NET_OPACITY, NET_COVARIANCE, NET_SHADING, NET_NORMAL, NETS };
// Per Gaussian. Without shading (Scaffold-GS, HAC) the third network puts out a color alone and there is no fourth.
constexpr int NET_ATTRIBUTES[NETS] = {1, 7, 7, 3}, PLAIN_ATTRIBUTES[NETS] = {1, 7, 3, 0};
constexpr int RAW_PLANES = 17;  // outputs but the opacity, by attribute

// Constants of the shading (econgs/anchors/shading.py).
constexpr float MIN_NORMAL = 1e-3f, MIN_LENGTH = 1e-6f, MIN_BASE = 1e-6f, MAX_SPECULAR = 5.0f, MAX_SHININESS = 50.0f;

// Anchors that are decoded together, and pieces whose gradients of the weights are summed apart: neither may depend
// on the number of threads.
constexpr int DECODE_BLOCK = 64;
constexpr int DECODE_PIECES = 16;

__attribute__((always_inline)) static inline int whole16(int n) { return (n + 15) / 16 * 16; }

// Sizes and strides in floats. Strides are multiples of 16 for every ISA; pads hold zeros or finite leftovers.
struct DecodeShape {
  int features, directions, embedding, hidden, offsets;
  int nets, attributes[NETS];  // how many networks there are, and what each puts out per Gaussian
  int inputs;                // features + directions
  int input_stride, hidden_stride;
  int out_width[NETS], out_stride;  // floats of a network's row of outputs, and the widest one's stride
  int plane;                 // stride of a plane of the Gaussians of a block
};

struct DecodeInputs {
  const float *anchors, *features, *scalings, *offsets;
  int64_t count;
};

struct DecodeView {
  float eye[3], light[3], palette[3];
  bool headlight, sigmoid_color;
  float opacity, ambient, diffuse, specular, shininess;  // factors; of opacity only whether it is 0 counts
};

// Rows of Gaussians that are shaded apart from decoding: base is palette color + offset color, coefficients are k_a,
// k_d, k_s and shininess, after activation and edits.
struct ShadeInputs {
  const float *means, *normals, *base, *coefficients;
};

// Weights as the kernels read them. Hidden unit j of network i is column i * hidden + j.
struct DecodeWeights {
  const float* first_t;       // inputs x hidden_stride
  const float* first_bias;    // hidden_stride; with what the embedding adds
  const float* first;         // nets hidden x input_stride (backward only)
  const float* second_t[NETS];     // hidden x whole16(out_width)
  const float* second_bias[NETS];  // whole16(out_width)
  const float* second[NETS];       // out_width x whole16(hidden) (backward only)
};

struct DecodeGradients {  // sums of one piece, laid out as the weights
  float *first_t, *first_bias, *second_t[NETS], *second_bias[NETS], *palette;
};

struct DecodeOutputs {  // rows of the Gaussians that are not culled
  float *means, *quats, *scales, *opacities, *colors;
  int64_t* slots;
};

struct ConstDecodeOutputs {  // their gradients; each may be null: zero
  const float *means, *quats, *scales, *opacities, *colors;
};

struct DecodeInputGradients {
  float *anchors, *features, *scalings, *offsets;  // anchors may be null
};

}  // namespace econgs
