// Scenes of factors (CP decomposition): what their kernels and the code that drives them share.
#pragma once

#include <stdint.h>

namespace econgs {

constexpr int FACTOR_UNIT = 16;  // ranks of a row come in multiples of it

// Some columns of three lines of factors: value r at a place is the product over the axes of the lines there.
struct Lines {
  const float* line[3];  // of each axis: size rows, of which the columns from there on are meant
  int size[3];           // rows, at least 2; the first lies at place 0, the last at place 1
  int64_t stride;        // floats from a row to the next
  int ranks;             // columns, a multiple of FACTOR_UNIT
};

// Samples of rays, and three rows of `stride` floats per ray by which the values are weighted.
struct LineSamples {
  const float* places;  // count x 3, each in [0, 1]
  const int32_t* rays;  // count
  const float* mixing;  // null: values are summed
};

}  // namespace econgs
