// Bindings of scenes of factors; methods/ccnerf is their only caller.
#include "factors.h"

#include <cmath>

#include "arrays.h"

namespace econgs {
namespace {

template <class T>
using Vector = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Cells = nb::ndarray<const uint8_t, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

Box box_of(const Doubles& corners, const Cells& cells, double step) {
  expect(is(corners, {2, 3}), "the box must be given as its two corners (2, 3)");
  expect(cells.size() > 0 && std::isfinite(step) && step > 0.0, "cells and a step above 0 are needed");
  Box box;
  for (int i = 0; i < 3; ++i) {
    const double side = corners.data()[3 + i] - corners.data()[i];
    expect(std::isfinite(side) && side > 0.0, "the box must have sides above 0");
    box.low[i] = corners.data()[i];
    box.inverse[i] = 1.0 / side;
    box.across[i] = static_cast<int64_t>(cells.shape(2 - i));
  }
  box.cells = cells.data();
  box.step = step;
  return box;
}

RayBundle rays_of(const Doubles& origins, const Doubles& directions, const Vector<const double>& shift) {
  const int64_t n = static_cast<int64_t>(origins.shape(0));
  expect(is(origins, {n, 3}) && is(directions, {n, 3}) && is(shift, {n}),
         "rays need origins and directions (B, 3) and shift (B,)");
  expect(n < (int64_t{1} << 31), "too many rays at once");
  return {origins.data(), directions.data(), shift.data(), n};
}

void count_checked(const Doubles& corners, const Cells& cells, double step, const Doubles& origins,
                   const Doubles& directions, const Vector<const double>& shift, int64_t most,
                   const Vector<int32_t>& counts) {
  const Box box = box_of(corners, cells, step);
  const RayBundle rays = rays_of(origins, directions, shift);
  expect(is(counts, {rays.count}) && most >= 1, "a count for each ray, and a limit of at least 1, are needed");
  int32_t* const to = counts.data();
  nb::gil_scoped_release release;
  count_samples(box, rays, most, to);
}

const int64_t* firsts_of(const Vector<const int64_t>& first, int64_t rays, int64_t samples) {
  expect(is(first, {rays + 1}) && first.data()[0] == 0 && first.data()[rays] == samples,
         "the samples of rays must follow one another");
  return first.data();
}

void place_checked(const Doubles& corners, const Cells& cells, double step, const Doubles& origins,
                   const Doubles& directions, const Vector<const double>& shift, const Vector<const int64_t>& first,
                   const Array& places, const Vector<int32_t>& owners, const Vector<int32_t>& numbers) {
  const Box box = box_of(corners, cells, step);
  const RayBundle rays = rays_of(origins, directions, shift);
  const int64_t n = static_cast<int64_t>(owners.shape(0));
  const int64_t* const from = firsts_of(first, rays.count, n);
  expect(is(places, {n, 3}) && is(numbers, {n}), "outputs of another size");
  float* const at = places.data();
  int32_t *const of = owners.data(), *const number = numbers.data();
  nb::gil_scoped_release release;
  place_samples(box, rays, from, at, of, number);
}

void weights_checked(const Vector<const float>& depths, const Vector<const int64_t>& first,
                     const Vector<float>& weights) {
  const int64_t n = static_cast<int64_t>(depths.shape(0)), count = static_cast<int64_t>(first.shape(0)) - 1;
  const int64_t* const from = firsts_of(first, count, n);
  expect(is(weights, {n}), "weights of another number than depths");
  const float* const in = depths.data();
  float* const out = weights.data();
  nb::gil_scoped_release release;
  ray_weights(in, from, count, out);
}

void weights_backward_checked(const Vector<const float>& depths, const Vector<const int64_t>& first,
                              const Vector<const float>& grad, const Vector<float>& to) {
  const int64_t n = static_cast<int64_t>(depths.shape(0)), count = static_cast<int64_t>(first.shape(0)) - 1;
  const int64_t* const from = firsts_of(first, count, n);
  expect(is(grad, {n}) && is(to, {n}), "a gradient of another size");
  const float *const in = depths.data(), *const outer = grad.data();
  float* const out = to.data();
  nb::gil_scoped_release release;
  ray_weights_backward(in, from, count, outer, out);
}

const int32_t* owners_of(const Vector<const int32_t>& rays, int64_t samples, int64_t count) {
  expect(is(rays, {samples}), "a ray for each sample is needed");
  for (int64_t n = 0; n < samples; ++n)
    expect(rays.data()[n] >= 0 && rays.data()[n] < count, "a sample of a ray that is not there");
  return rays.data();
}

void sums_checked(const In& rows, const Vector<const int32_t>& rays, const Array& sums) {
  expect(rows.ndim() == 2 && sums.ndim() == 2 && rows.shape(1) == sums.shape(1), "rows and sums must be equally wide");
  const int64_t n = rows.shape(0), width = rows.shape(1);
  const int32_t* const of = owners_of(rays, n, sums.shape(0));
  const float* const from = rows.data();
  float* const to = sums.data();
  nb::gil_scoped_release release;
  ray_sums(from, of, n, width, to);
}

struct Problem {
  Lines lines;
  LineSamples samples;
  int64_t count;
};

Problem problem_of(const In& x, const In& y, const In& z, int groups, const std::optional<In>& mixing, const In& places,
                   const Vector<const int32_t>& rays) {
  const In* const lines[3] = {&x, &y, &z};
  expect(x.ndim() == 2, "lines must have shape (size, ranks)");
  const int64_t ranks = x.shape(1), n = static_cast<int64_t>(places.shape(0));
  Problem one;
  for (int i = 0; i < 3; ++i) {
    const int64_t size = lines[i]->shape(0);
    expect(is(*lines[i], {size, ranks}) && size >= 2 && size < (1 << 20), "lines need at least 2 rows of equal length");
    one.lines.line[i] = lines[i]->data();
    one.lines.size[i] = static_cast<int>(size);
  }
  expect(groups >= 1 && ranks % (groups * FACTOR_UNIT) == 0, "ranks of a group come in multiples of 16");
  expect(is(places, {n, 3}), "places must have shape (N, 3)");
  expect(!mixing || (mixing->ndim() == 3 && mixing->shape(1) == 3 && static_cast<int64_t>(mixing->shape(2)) == ranks),
         "mixing must have shape (B, 3, ranks)");
  one.lines.stride = ranks;
  one.lines.ranks = static_cast<int>(ranks / groups);
  const int32_t* const of = mixing ? owners_of(rays, n, mixing->shape(0)) : nullptr;
  one.samples = {places.data(), of, data_or_null(mixing)};
  one.count = n;
  return one;
}

void products_checked(const In& x, const In& y, const In& z, int groups, std::optional<In> mixing, const In& places,
                      const Vector<const int32_t>& rays, const Array& out) {
  const Problem one = problem_of(x, y, z, groups, mixing, places, rays);
  expect(is(out, {one.count, groups, mixing ? 3 : 1}), "the output must have shape (N, groups, channels)");
  float* const to = out.data();
  nb::gil_scoped_release release;
  products(one.lines, groups, one.samples, one.count, to);
}

void products_backward_checked(const In& x, const In& y, const In& z, int groups, std::optional<In> mixing,
                               const In& places, const Vector<const int32_t>& rays, const In& grad, const Array& to_x,
                               const Array& to_y, const Array& to_z, std::optional<Array> to_mixing) {
  const Problem one = problem_of(x, y, z, groups, mixing, places, rays);
  expect(is(grad, {one.count, groups, mixing ? 3 : 1}), "a gradient of another size than the output");
  const In* const lines[3] = {&x, &y, &z};
  const Array* const outs[3] = {&to_x, &to_y, &to_z};
  float* to[3];
  for (int i = 0; i < 3; ++i) {
    expect(is(*outs[i], {static_cast<int64_t>(lines[i]->shape(0)), static_cast<int64_t>(x.shape(1))}),
           "a gradient of another size than its line");
    to[i] = outs[i]->data();
  }
  expect(!mixing == !to_mixing && (!mixing || to_mixing->size() == mixing->size()),
         "a gradient of another size than the mixing");
  float* const mixed = data_or_null(to_mixing);
  const float* const outer = grad.data();
  nb::gil_scoped_release release;
  products_backward(one.lines, groups, one.samples, one.count, outer, to, mixed);
}

}  // namespace

void bind_factors(nb::module_& m) {
  m.def("count_samples", count_checked, "corners"_a, "cells"_a, "step"_a, "origins"_a, "directions"_a, "shift"_a,
        "most"_a, "counts"_a);
  m.def("place_samples", place_checked, "corners"_a, "cells"_a, "step"_a, "origins"_a, "directions"_a, "shift"_a,
        "first"_a, "places"_a, "rays"_a, "numbers"_a);
  m.def("ray_weights", weights_checked, "depths"_a, "first"_a, "weights"_a);
  m.def("ray_weights_backward", weights_backward_checked, "depths"_a, "first"_a, "grad"_a, "to"_a);
  m.def("ray_sums", sums_checked, "rows"_a, "rays"_a, "sums"_a);
  m.def("line_products", products_checked, "x"_a, "y"_a, "z"_a, "groups"_a, "mixing"_a.none(), "places"_a, "rays"_a,
        "out"_a);
  m.def("line_products_backward", products_backward_checked, "x"_a, "y"_a, "z"_a, "groups"_a, "mixing"_a.none(),
        "places"_a, "rays"_a, "grad"_a, "to_x"_a, "to_y"_a, "to_z"_a, "to_mixing"_a.none());
}

}  // namespace econgs
