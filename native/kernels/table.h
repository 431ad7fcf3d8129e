// What the per-ISA kernels and the code that drives them share: plain structs and one table of functions.
// No std:: here (see simd.h).
#pragma once

#include <stddef.h>
#include <stdint.h>

#include "decoder_types.h"
#include "factor_types.h"
#include "voxel_types.h"

namespace econgs {

// Constants of the 3DGS lineage.
constexpr int TILE = 16;                     // pixels
constexpr float MAX_ALPHA = 0.99f;
constexpr float MIN_ALPHA = 1.0f / 255.0f;
constexpr float MIN_TRANSMITTANCE = 1e-4f;
constexpr double CLAMP = 1.3;                // of half a field of view, for the Jacobian
constexpr double MIN_THROUGH = 1e-4;         // least transmittance of a Gaussian whose depth is changed
constexpr double MAX_DEPTH = 5.643856189774724;  // log2 of the largest relative depth of a Gaussian, 50

struct View {
  double rotation[9], translation[3];  // world to camera
  double fx, fy, cx, cy, near;
  double low_pass;  // px^2, added to the diagonal of the projected covariance
  bool compensated;  // opacities shrink so that the filter keeps a Gaussian's mass
  double ray_power;  // power of the relative depth of Gaussians along a ray, by which optical depths grow; 0: not
  int width, height;
};

struct Inputs {
  const float *means, *quats, *scales, *opacities, *features, *offset;  // offset may be null
  int64_t count;
  int channels;
};

// A projected Gaussian: one cache line. log2(alpha) = lift + a (dx - slope dy)^2 + c dy^2, a sum of terms of one
// sign: the usual three-term form cancels for needles.
struct Splat {
  double u, v;         // centre, pixels
  float a, c, lift;
  float depth;
  // The ellipse on which alpha falls to 1/255, a little widened: at height dy its middle lies at slope * dy and
  // its half width is sqrt((bound - dy^2 * inverse) * width2); it is furthest right at dy = tip,
  // and lies within reach and top of the centre.
  float slope, inverse, width2, bound, tip, top, reach;
  float opacity;       // 0: not visible
};
static_assert(sizeof(Splat) <= 64, "a splat must fit in a cache line");

// One Gaussian in one tile.
struct Entry {
  uint32_t splat;  // index into splats
  uint32_t slot;   // where its gradients go: all of a Gaussian's tiles side by side
};

struct Tile {
  int x, y;                  // of its first pixel
  int width, height;         // less than TILE at the image's border
  const Entry* entries;
  uint64_t* blocks;          // per entry: the blocks of the tile in which it was blended (one bit each)
  int64_t count;
};

struct Images {
  float *features, *alpha, *depth;
};
struct ConstImages {
  const float *features, *alpha, *depth;  // a gradient may be null: zero
};

// Gradients of one slot: moments of h = dL/dlog(alpha) in e = dx - slope dy and dy (in which the exponent is a sum
// of squares: moments in dx and dy would cancel for needles), then depth, then features.
enum { SLOT_SUM, SLOT_E, SLOT_Y, SLOT_EE, SLOT_EY, SLOT_YY, SLOT_DEPTH, SLOT_FEATURES };
__attribute__((always_inline)) static inline int slot_size(int channels) {
  return (SLOT_FEATURES + channels + 3) / 4 * 4;
}

struct Gradients {
  float *means, *quats, *scales, *opacities, *features, *offset;  // offset may be null
};

// Spherical harmonics: three floats for the first coefficient, 3 * rest_bands for the others; strides in floats.
struct Coefficients {
  const float *first, *rest;
  int64_t first_stride, rest_stride;
  int rest_bands;
};
struct MutableCoefficients {  // with the strides of the coefficients; rest may be null
  float *first, *rest;
};

// rate / (1 - beta1^t), beta2, 1 - beta1, 1 - beta2, eps, 1 / sqrt(1 - beta2^t): formed in double, then rounded.
struct AdamRates {
  float rate, beta2, new1, new2, eps, root2;
};

constexpr int SSIM_RADIUS = 5, SSIM_BAND = 8;

struct Kernels {
  const char* name;
  int lanes;
  // Projects Gaussians [begin, end); returns false if any input among them is unusable.
  bool (*project)(const Inputs&, const View&, Splat*, int32_t* radii, int64_t begin, int64_t end);
  // Sums the slots of Gaussians [begin, end) and carries the gradients back to the inputs.
  void (*project_backward)(const Inputs&, const View&, const Splat*, const uint32_t* first_slot, const float* slots,
                           const Gradients&, int64_t begin, int64_t end);
  // Scratch floats that the two blend functions need.
  int64_t (*scratch)(int channels);
  // Blends one tile; returns the number of lane evaluations.
  int64_t (*blend)(const Inputs&, const Splat*, const Tile&, const View&, const Images&, float* scratch);
  void (*blend_backward)(const Inputs&, const Splat*, const Tile&, const View&, const ConstImages& out,
                         const ConstImages& grad, float* slots, float* scratch);
  void (*sh)(int degree, const Coefficients&, const float* means, const float* position, float* colors, int64_t begin,
             int64_t end);
  void (*sh_backward)(int degree, const Coefficients&, const float* means, const float* position, const float* colors,
                      const float* grad, float* grad_means, const MutableCoefficients&, int64_t begin, int64_t end);
  // SSIM over rows of n = width * channels floats, in three sweeps over rows [begin, end), at most SSIM_BAND of them
  // (see ssim.h). The first two also take the SSIM_RADIUS rows above and below the image.
  int64_t (*ssim_scratch)(int64_t n, int channels);
  void (*ssim_rows)(const float* x, const float* y, float* moments, int64_t n, int64_t height, int channels,
                    int64_t begin, int64_t end, float* scratch);
  void (*ssim_map)(const float* moments, float* partials, int64_t n, int64_t height, int channels, int64_t begin,
                   int64_t end, double* values, float* scratch);
  void (*ssim_gradient)(const float* x, const float* y, const float* partials, float* grad, int64_t n, int64_t height,
                        int64_t begin, int64_t end, float absolute, float structural);
  double (*absolute)(const float* x, const float* y, int64_t n);
  // Pixels of a drawn picture (premultiplied color and alpha) and of a view (RGBA): both over a background; sums of
  // alpha, of the view's alpha and of their distance; gradients by alpha from those by the composited colors and
  // from the weight of the distance.
  void (*composite)(const float* color, const float* alpha, const float* truth, const float* back, float* drawn,
                    float* target, int64_t pixels);
  void (*alpha_sums)(const float* alpha, const float* truth, int64_t pixels, double* sums);
  void (*alpha_gradient)(const float* grad, const float* alpha, const float* truth, const float* back, float weight,
                         float* to, int64_t pixels);
  // Decoding a block of anchors (see decoder_block.h).
  int64_t (*decode_scratch)(const DecodeShape&);
  int64_t (*decode_opacity)(const DecodeShape&, const DecodeInputs&, const DecodeView&, const DecodeWeights&,
                            int64_t begin, int64_t end, float* raw, float* rows, float* scratch);
  void (*decode_block)(const DecodeShape&, const DecodeInputs&, const DecodeView&, const DecodeWeights&, int64_t begin,
                       int64_t end, const float* opacity, int64_t first, int64_t last, const DecodeOutputs&,
                       float* rows, float* kept, float* scratch);
  void (*decode_backward)(const DecodeShape&, const DecodeInputs&, const DecodeView&, const DecodeWeights&,
                          int64_t begin, int64_t end, const float* opacity, int64_t first, int64_t all,
                          const float* rows, const float* raw, const ConstDecodeOutputs&, const DecodeInputGradients&,
                          const DecodeGradients& sums, float* scratch);
  // Colors of Gaussians [begin, end); of the view only eye and light count.
  void (*shade)(const ShadeInputs&, const DecodeView&, int64_t begin, int64_t end, float* colors);
  void (*adam)(float* p, const float* g, float* m, float* v, int64_t n, const AdamRates&);
  void (*reference)(float* data, int64_t n, int rounds);
  // Lines of factors (see factors.h).
  void (*line_products)(const Lines&, const LineSamples&, int64_t begin, int64_t end, int64_t apart, float* out);
  void (*line_products_backward)(const Lines&, const LineSamples&, int64_t count, int64_t apart, const float* grad,
                                 float* const* to_lines, float* to_mixing);
  // Sparse voxel grids (see voxels.h).
  int64_t (*march_ray)(const March&, const float* origin, const float* direction, float near, const float* tile,
                       float* color, float* alpha, VoxelSample* kept, float* most);
  void (*scatter_voxels)(const VoxelGrid&, const VoxelGradient* from, int64_t count, const float* tiles,
                         const VoxelArrays& to);
  double (*voxel_variation)(const VoxelGrid&, int64_t begin, int64_t count, float factor, float spread, int part,
                            const VoxelArrays& to);
  void (*voxel_step)(const VoxelArrays& values, const VoxelArrays& grads, const VoxelArrays& moments, int64_t begin,
                     int64_t end, float density_rate, float row_rate, float beta, float eps);
};

}  // namespace econgs
