// What the files that bind functions to Python share.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstdint>
#include <initializer_list>
#include <optional>
#include <stdexcept>

namespace econgs {

namespace nb = nanobind;
using namespace nb::literals;  // "name"_a

using Array = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using In = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;

inline void expect(bool valid, const char* what) {
  if (!valid) throw std::invalid_argument(what);
}

template <class A>
bool is(const A& array, std::initializer_list<int64_t> shape) {
  if (array.ndim() != shape.size()) return false;
  size_t axis = 0;
  for (const int64_t size : shape)
    if (static_cast<int64_t>(array.shape(axis++)) != size) return false;
  return true;
}

template <class A>
auto data_or_null(const std::optional<A>& array) -> decltype(array->data()) {
  return array ? array->data() : nullptr;
}

void bind_anchors(nb::module_&);
void bind_decode(nb::module_&);
void bind_factors(nb::module_&);
void bind_hash_grid(nb::module_&);
void bind_voxels(nb::module_&);

}  // namespace econgs
