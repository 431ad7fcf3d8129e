// Rays through a box of factors: samples in occupied cells, weights along rays, products of lines
// (methods/ccnerf documents what they mean).
#pragma once

#include <cstdint>

#include "kernels/factor_types.h"

namespace econgs {

struct Box {
  double low[3], inverse[3];  // the box begins there; 1 / its sides
  const uint8_t* cells;       // across[2] x across[1] x across[0]; 0: empty
  int64_t across[3];
  double step;                // between samples of a ray
};

struct RayBundle {
  const double *origins, *directions, *shift;  // count x 3, count x 3, count
  int64_t count;
};

// Samples of each ray, sample k at the distance (k + shift) * step. `most`: no ray is looked at beyond that many.
void count_samples(const Box&, const RayBundle&, int64_t most, int32_t* counts);
// The same samples: where in the box, of which ray, and k. first: the first sample of each ray in the outputs.
void place_samples(const Box&, const RayBundle&, const int64_t* first, float* places, int32_t* rays, int32_t* numbers);

// Weights of samples from optical depths; first has count + 1 entries. A gradient of the depths from one of the
// weights.
void ray_weights(const float* depths, const int64_t* first, int64_t count, float* weights);
void ray_weights_backward(const float* depths, const int64_t* first, int64_t count, const float* grad, float* to);
// Sums of the rows (of `width`) of consecutive samples of one ray; rays ascend.
void ray_sums(const float* rows, const int32_t* rays, int64_t samples, int64_t width, float* sums);

// Groups of equal numbers of columns: `lines.ranks` of each. out: samples x groups x (3 if mixed, 1 if summed).
void products(const Lines& lines, int groups, const LineSamples& samples, int64_t count, float* out);
void products_backward(const Lines& lines, int groups, const LineSamples& samples, int64_t count, const float* grad,
                       float* const* to_lines, float* to_mixing);

}  // namespace econgs
