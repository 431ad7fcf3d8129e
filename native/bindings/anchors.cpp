// Bindings of what training asks of anchors; econgs/anchors is their only caller.
#include "anchors.h"

#include "arrays.h"

namespace econgs {
namespace {

using Rows = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Radii = nb::ndarray<const int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void visible_checked(const In& pose, float near, const In& middle, const In& anchors, const In& scalings,
                     const Mask& shown) {
  const int64_t n = anchors.shape(0);
  expect(is(pose, {3, 4}) && is(middle, {4}), "a pose (3, 4) and four numbers of the image are needed");
  expect(is(anchors, {n, 3}) && is(scalings, {n, 6}) && is(shown, {n}), "anchors and scalings of different sizes");
  AnchorView view;
  for (int i = 0; i < 12; ++i) view.pose[i] = pose.data()[i];
  view.near = near;
  for (int axis = 0; axis < 2; ++axis) {
    view.offset[axis] = middle.data()[axis];
    view.edge[axis] = middle.data()[2 + axis];
  }
  visible_anchors(view, anchors.data(), scalings.data(), n, shown.data());
}

void record_checked(const Array& gradients, const Array& draws, const Array& opacities, const Array& visits,
                    const Rows& rows, const In& opacity, const Rows& slots, const In& pixels, const Radii& radii,
                    float half_width, float half_height) {
  expect(gradients.ndim() == 2, "gradients must have shape (N, K)");
  const int64_t n = gradients.shape(0), k = gradients.shape(1), v = rows.shape(0), m = slots.shape(0);
  expect(is(draws, {n, k}) && is(opacities, {n}) && is(visits, {n}), "statistics of different sizes");
  expect(is(opacity, {v, k}) && is(pixels, {m, 2}) && is(radii, {m}), "a view of another size");
  for (int64_t i = 0; i < v; ++i) expect(rows.data()[i] >= 0 && rows.data()[i] < n, "an anchor that is not there");
  for (int64_t i = 0; i < m; ++i) expect(slots.data()[i] >= 0 && slots.data()[i] < v * k, "a slot that is not there");
  const AnchorStatistics to = {gradients.data(), draws.data(), opacities.data(), visits.data(), static_cast<int>(k)};
  record_view(to, rows.data(), opacity.data(), v, slots.data(), pixels.data(), radii.data(), m, half_width,
              half_height);
}

}  // namespace

void bind_anchors(nb::module_& m) {
  m.def("visible_anchors", visible_checked, "pose"_a, "near"_a, "middle"_a, "anchors"_a, "scalings"_a, "shown"_a);
  m.def("record_view", record_checked, "gradients"_a, "draws"_a, "opacities"_a, "visits"_a, "rows"_a, "opacity"_a,
        "slots"_a, "pixels"_a, "radii"_a, "half_width"_a, "half_height"_a);
}

}  // namespace econgs
