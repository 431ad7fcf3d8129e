// Bindings of the binary hash grids; econgs/codec/hash_grid.py is their only caller.
#include "arrays.h"

#include <nanobind/stl/vector.h>

#include "hash_grid.h"

namespace econgs {
namespace {

using Indices = nb::ndarray<const int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// The indices themselves are not looked through at every call: a Lookup is made for its grid and never changed.
HashGrid grid_of(const In& table, const Indices& index, const In& weights, const std::optional<Rows>& rows,
                 const std::vector<int>& corners, const std::vector<int64_t>& sizes) {
  const int64_t v = index.shape(0), n = index.shape(1);
  int64_t vertices = 0, entries = 0;
  expect(corners.size() == sizes.size(), "as many levels as sizes are needed");
  for (const int c : corners) {
    expect(c == 4 || c == 8, "a position lies between 4 or 8 vertices");
    vertices += c;
  }
  for (const int64_t size : sizes) entries += size;
  expect(is(table, {entries, 4}), "the table must have shape (entries, 4)");
  expect(v == vertices && is(weights, {v, n}), "index and weights must have shape (vertices of all levels, N)");
  const int64_t count = rows ? static_cast<int64_t>(rows->shape(0)) : n;
  if (rows)
    for (int64_t m = 0; m < count; ++m)
      expect(rows->data()[m] >= 0 && rows->data()[m] < n, "a row beyond the positions looked up");
  const int64_t* const indices = data_or_null(rows);
  const int levels = static_cast<int>(corners.size());
  return {table.data(), index.data(), weights.data(), indices, n, count, levels, corners.data(), sizes.data()};
}

std::vector<int64_t> forward_checked(const In& table, const Indices& index, const In& weights, std::optional<Rows> rows,
                                     const std::vector<int>& corners, const std::vector<int64_t>& sizes,
                                     const Array& out) {
  const HashGrid grid = grid_of(table, index, weights, rows, corners, sizes);
  expect(is(out, {grid.count, 4 * grid.levels}), "the output must have shape (M, 4 levels)");
  std::vector<int64_t> positive(corners.size());
  float* const to = out.data();
  nb::gil_scoped_release release;
  hash_grid(grid, to, positive.data());
  return positive;
}

void backward_checked(const In& table, const Indices& index, const In& weights, std::optional<Rows> rows,
                      const std::vector<int>& corners, const std::vector<int64_t>& sizes, const In& grad,
                      const std::vector<float>& constant, const Array& out) {
  const HashGrid grid = grid_of(table, index, weights, rows, corners, sizes);
  expect(is(grad, {grid.count, 4 * grid.levels}) && out.ndim() == 2 && out.shape(0) == table.shape(0) &&
             out.shape(1) == 4 && constant.size() == corners.size(),
         "a gradient of another size");
  const float* const outer = grad.data();
  float* const to = out.data();
  nb::gil_scoped_release release;
  hash_grid_backward(grid, outer, constant.data(), to);
}

NoiseShape noise_shape(const In& values, const In& noise, const In& steps, int first, int groups) {
  expect(values.ndim() == 2 && steps.ndim() == 2, "values and steps must have two dimensions");
  const int64_t n = values.shape(0), width = values.shape(1), stride = steps.shape(1);
  expect(is(noise, {n, width}) && is(steps, {n, stride}), "values, noise and steps of different sizes");
  expect(groups >= 1 && first >= 0 && first + groups <= stride && width % groups == 0,
         "values must split evenly into their groups");
  return {n, static_cast<int>(width), groups, static_cast<int>(stride)};
}

void noise_checked(const In& values, const In& noise, const In& steps, int first, int groups, const Array& out) {
  const NoiseShape shape = noise_shape(values, noise, steps, first, groups);
  expect(is(out, {shape.count, shape.width}), "the output must have the shape of the values");
  const float *const v = values.data(), *const u = noise.data(), *const q = steps.data() + first;
  float* const to = out.data();
  nb::gil_scoped_release release;
  add_noise(shape, v, u, q, to);
}

void noise_backward_checked(const In& grad, const In& noise, const In& steps, int first, int groups,
                            const Array& to_steps) {
  const NoiseShape shape = noise_shape(grad, noise, steps, first, groups);
  expect(is(to_steps, {shape.count, groups}), "the gradient must have shape (N, groups)");
  const float *const g = grad.data(), *const u = noise.data();
  float* const to = to_steps.data();
  nb::gil_scoped_release release;
  add_noise_backward(shape, g, u, to);
}

}  // namespace

void bind_hash_grid(nb::module_& m) {
  m.def("hash_grid", forward_checked, "table"_a, "index"_a, "weights"_a, "rows"_a.none(), "corners"_a, "sizes"_a,
        "out"_a);
  m.def("hash_grid_backward", backward_checked, "table"_a, "index"_a, "weights"_a, "rows"_a.none(), "corners"_a,
        "sizes"_a, "grad"_a, "constant"_a, "out"_a);
  m.def("add_noise", noise_checked, "values"_a, "noise"_a, "steps"_a, "first"_a, "groups"_a, "out"_a);
  m.def("add_noise_backward", noise_backward_checked, "grad"_a, "noise"_a, "steps"_a, "first"_a, "groups"_a,
        "to_steps"_a);
}

}  // namespace econgs
