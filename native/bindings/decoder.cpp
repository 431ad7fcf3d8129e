// Bindings of the anchors' decoders; econgs/anchors/native.py is their only caller.
#include "arrays.h"

#include <nanobind/stl/vector.h>

#include "decoder.h"

namespace econgs {
namespace {

using Vector3 = nb::ndarray<const float, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Slots = nb::ndarray<int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

DecodeInputs inputs_of(const DecodeShape& s, const In& anchors, const In& features, const In& scalings,
                       const In& offsets) {
  const int64_t n = anchors.ndim() == 2 ? static_cast<int64_t>(anchors.shape(0)) : -1;
  expect(n >= 0 && is(anchors, {n, 3}), "anchors must have shape (N, 3)");
  expect(is(features, {n, s.features}), "features must have shape (N, F)");
  expect(is(scalings, {n, 6}), "scalings must have shape (N, 6)");
  expect(is(offsets, {n, s.offsets, 3}), "offsets must have shape (N, K, 3)");
  return {anchors.data(), features.data(), scalings.data(), offsets.data(), n};
}

// First weight and bias, second weight and bias of each network.
template <class A, class T>
void networks_of(const DecodeShape& s, const std::vector<A>& tensors, T** first, T** first_bias, T** second,
                 T** second_bias) {
  expect(static_cast<int>(tensors.size()) == 4 * s.nets, "four tensors per network are needed");
  for (int net = 0; net < s.nets; ++net) {
    const A* const four = &tensors[4 * net];
    expect(is(four[0], {s.hidden, s.inputs + s.embedding}) && is(four[1], {s.hidden}) &&
               is(four[2], {s.out_width[net], s.hidden}) && is(four[3], {s.out_width[net]}),
           "a decoder's tensor has another size than the anchors ask for");
    first[net] = four[0].data();
    first_bias[net] = four[1].data();
    second[net] = four[2].data();
    second_bias[net] = four[3].data();
  }
}

Networks networks_of(const DecodeShape& s, const std::vector<In>& weights, const In& embedding) {
  Networks nets = {};
  networks_of(s, weights, nets.first, nets.first_bias, nets.second, nets.second_bias);
  expect(is(embedding, {s.embedding}), "embedding must have shape (E,)");
  nets.embedding = embedding.data();
  return nets;
}

DecodeView lit_view(const Vector3& eye, const std::optional<Vector3>& light) {
  DecodeView view = {};
  for (int d = 0; d < 3; ++d) {
    view.eye[d] = eye.data()[d];
    view.light[d] = light ? light->data()[d] : 0.0f;
  }
  view.headlight = !light;
  return view;
}

DecodeFrame* begin_checked(const In& anchors, const In& features, const In& scalings, const In& offsets,
                           const std::vector<In>& weights, const In& embedding, const Vector3& palette,
                           const Vector3& eye, std::optional<Vector3> light, const std::vector<float>& factors,
                           bool directions, bool sigmoid_color, const Array& opacities, bool keep) {
  expect(features.ndim() == 2 && offsets.ndim() == 3 && embedding.ndim() == 1 &&
             (weights.size() == 4 * NETS || weights.size() == 4 * (NETS - 1)) && weights[0].ndim() == 2 &&
             factors.size() == 5,
         "decode: arguments of the wrong kind");
  const DecodeShape shape = decode_shape(static_cast<int>(features.shape(1)), directions ? 3 : 0,
                                         static_cast<int>(embedding.shape(0)), static_cast<int>(weights[0].shape(0)),
                                         static_cast<int>(offsets.shape(1)), weights.size() == 4 * NETS);
  expect(shape.features >= 1 && shape.hidden >= 1 && shape.offsets >= 1, "decode: a width is zero");
  const DecodeInputs in = inputs_of(shape, anchors, features, scalings, offsets);
  const Networks nets = networks_of(shape, weights, embedding);
  expect(is(opacities, {in.count, shape.offsets}), "opacities must have shape (N, K)");
  DecodeView view = lit_view(eye, light);
  for (int d = 0; d < 3; ++d) view.palette[d] = palette.data()[d];
  view.sigmoid_color = sigmoid_color;
  view.opacity = factors[0];
  view.ambient = factors[1];
  view.diffuse = factors[2];
  view.specular = factors[3];
  view.shininess = factors[4];
  std::unique_ptr<DecodeFrame> frame;
  float* const to = opacities.data();
  {
    nb::gil_scoped_release release;
    frame = decode_begin(shape, in, view, nets, to, keep);
  }
  expect(frame != nullptr, "decode: every value must be finite");
  return frame.release();
}

void finish_checked(DecodeFrame& frame, const In& anchors, const In& features, const In& scalings, const In& offsets,
                    const In& opacities, const Array& means, const Array& quats, const Array& scales,
                    const Array& opaque, const Array& colors, const Slots& slots) {
  const DecodeInputs in = inputs_of(frame.shape, anchors, features, scalings, offsets);
  const int64_t m = frame.gaussians;
  expect(in.count == frame.anchors && is(opacities, {in.count, frame.shape.offsets}),
         "decode: another number of anchors");
  expect(is(means, {m, 3}) && is(quats, {m, 4}) && is(scales, {m, 3}) && is(opaque, {m}) && is(colors, {m, 3}) &&
             static_cast<int64_t>(slots.shape(0)) == m,
         "the outputs have other sizes than the Gaussians ask for");
  const DecodeOutputs out = {means.data(), quats.data(), scales.data(), opaque.data(), colors.data(), slots.data()};
  const float* const t = opacities.data();
  nb::gil_scoped_release release;
  decode_finish(frame, in, t, out);
}

void backward_checked(const DecodeFrame& frame, const In& anchors, const In& features, const In& scalings,
                      const In& offsets, const std::vector<In>& weights, const In& embedding, const In& opacities,
                      std::optional<In> means, std::optional<In> quats, std::optional<In> scales,
                      std::optional<In> opaque, std::optional<In> colors, std::optional<Array> to_anchors,
                      const Array& to_features, const Array& to_scalings, const Array& to_offsets,
                      const std::vector<Array>& to_weights, const Array& to_embedding, const Array& to_palette) {
  const DecodeShape& s = frame.shape;
  const DecodeInputs in = inputs_of(s, anchors, features, scalings, offsets);
  const Networks nets = networks_of(s, weights, embedding);
  const int64_t n = in.count, m = frame.gaussians;
  expect(frame.keep && n == frame.anchors && is(opacities, {n, s.offsets}), "decode: not what the forward pass saw");
  expect((!means || is(*means, {m, 3})) && (!quats || is(*quats, {m, 4})) && (!scales || is(*scales, {m, 3})) &&
             (!opaque || is(*opaque, {m})) && (!colors || is(*colors, {m, 3})),
         "a gradient of another size than its tensor");
  expect((!to_anchors || is(*to_anchors, {n, 3})) && is(to_features, {n, s.features}) && is(to_scalings, {n, 6}) &&
             is(to_offsets, {n, s.offsets, 3}) && is(to_embedding, {s.embedding}) && is(to_palette, {3}),
         "a gradient of another size than its tensor");
  const ConstDecodeOutputs grad = {data_or_null(means), data_or_null(quats), data_or_null(scales), data_or_null(opaque),
                                   data_or_null(colors)};
  const DecodeInputGradients to = {data_or_null(to_anchors), to_features.data(), to_scalings.data(), to_offsets.data()};
  NetworkGradients net_grads = {};
  networks_of(s, to_weights, net_grads.first, net_grads.first_bias, net_grads.second, net_grads.second_bias);
  net_grads.embedding = to_embedding.data();
  net_grads.palette = to_palette.data();
  const float* const t = opacities.data();
  nb::gil_scoped_release release;
  decode_backward(frame, in, nets, t, grad, to, net_grads);
}

void shade_checked(const In& means, const In& normals, const In& base, const In& coefficients, const Vector3& eye,
                   std::optional<Vector3> light, const Array& colors) {
  const int64_t n = means.ndim() == 2 ? static_cast<int64_t>(means.shape(0)) : -1;
  expect(n >= 0 && is(means, {n, 3}) && is(normals, {n, 3}) && is(base, {n, 3}) && is(coefficients, {n, 4}) &&
             is(colors, {n, 3}),
         "shade: attributes of different sizes");
  const DecodeView view = lit_view(eye, light);
  const ShadeInputs in = {means.data(), normals.data(), base.data(), coefficients.data()};
  float* const to = colors.data();
  nb::gil_scoped_release release;
  shade(in, view, n, to);
}

}  // namespace

void bind_decode(nb::module_& m) {
  nb::class_<DecodeFrame>(m, "DecodeFrame").def_ro("gaussians", &DecodeFrame::gaussians);
  m.def("decode_begin", begin_checked, "anchors"_a, "features"_a, "scalings"_a, "offsets"_a, "weights"_a, "embedding"_a,
        "palette"_a, "eye"_a, "light"_a.none(), "factors"_a, "directions"_a, "sigmoid_color"_a, "opacities"_a, "keep"_a,
        nb::rv_policy::take_ownership);
  m.def("decode_finish", finish_checked, "frame"_a, "anchors"_a, "features"_a, "scalings"_a, "offsets"_a, "opacities"_a,
        "means"_a, "quats"_a, "scales"_a, "opaque"_a, "colors"_a, "slots"_a);
  m.def("shade", shade_checked, "means"_a, "normals"_a, "base"_a, "coefficients"_a, "eye"_a, "light"_a.none(),
        "colors"_a);
  m.def("decode_backward", backward_checked, "frame"_a, "anchors"_a, "features"_a, "scalings"_a, "offsets"_a,
        "weights"_a, "embedding"_a, "opacities"_a, "means"_a.none(), "quats"_a.none(), "scales"_a.none(),
        "opaque"_a.none(), "colors"_a.none(), "to_anchors"_a.none(), "to_features"_a, "to_scalings"_a, "to_offsets"_a,
        "to_weights"_a, "to_embedding"_a, "to_palette"_a);
}

}  // namespace econgs
