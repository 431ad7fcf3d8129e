// Bindings of the binary hash grids; econgs/context/hash_grid.py is their only caller.
#include "module.h"

#include <nanobind/stl/vector.h>

#include "hash_grid.h"

namespace econgs {
namespace {

using Indices = nb::ndarray<const int32_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// The indices themselves are not looked through at every call: a Lookup is made for its grid and never changed.
HashGrid grid_of(const In& table, const Indices& index, const In& weights, const std::optional<Rows>& rows,
                 const std::vector<int>& corners, const std::vector<int64_t>& sizes) {
  const int64_t n = index.shape(0), v = index.shape(1);
  int64_t vertices = 0, entries = 0;
  expect(corners.size() == sizes.size(), "as many levels as sizes are needed");
  for (const int c : corners) {
    expect(c == 4 || c == 8, "a vertex has 4 or 8 neighbours");
    vertices += c;
  }
  for (const int64_t size : sizes) entries += size;
  expect(is(table, {entries, 4}), "the table must have shape (entries, 4)");
  expect(v == vertices && is(weights, {n, v}), "index and weights must have shape (N, vertices of all levels)");
  const int64_t count = rows ? static_cast<int64_t>(rows->shape(0)) : n;
  if (rows)
    for (int64_t m = 0; m < count; ++m)
      expect(rows->data()[m] >= 0 && rows->data()[m] < n, "a row beyond the positions looked up");
  return {table.data(), index.data(), weights.data(), rows ? rows->data() : nullptr, entries, v, count,
          static_cast<int>(corners.size()), corners.data(), sizes.data()};
}

void forward_checked(const In& table, const Indices& index, const In& weights, std::optional<Rows> rows,
                     const std::vector<int>& corners, const std::vector<int64_t>& sizes, const Array& out) {
  const HashGrid grid = grid_of(table, index, weights, rows, corners, sizes);
  expect(is(out, {grid.count, 4 * grid.levels}), "the output must have shape (M, 4 levels)");
  float* const to = out.data();
  nb::gil_scoped_release release;
  hash_grid(grid, to);
}

void backward_checked(const In& table, const Indices& index, const In& weights, std::optional<Rows> rows,
                      const std::vector<int>& corners, const std::vector<int64_t>& sizes, const In& grad,
                      const Array& out) {
  const HashGrid grid = grid_of(table, index, weights, rows, corners, sizes);
  expect(is(grad, {grid.count, 4 * grid.levels}) && is(out, {grid.entries, 4}), "a gradient of another size");
  const float* const outer = grad.data();
  float* const to = out.data();
  nb::gil_scoped_release release;
  hash_grid_backward(grid, outer, to);
}

}  // namespace

void bind_hash_grid(nb::module_& m) {
  m.def("hash_grid", forward_checked, nb::arg("table"), nb::arg("index"), nb::arg("weights"), nb::arg("rows").none(),
        nb::arg("corners"), nb::arg("sizes"), nb::arg("out"));
  m.def("hash_grid_backward", backward_checked, nb::arg("table"), nb::arg("index"), nb::arg("weights"),
        nb::arg("rows").none(), nb::arg("corners"), nb::arg("sizes"), nb::arg("grad"), nb::arg("out"));
}

}  // namespace econgs
