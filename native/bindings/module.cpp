// The Python module econgs._native: takes NumPy arrays (quicker than DLPack from torch), releases the GIL at work.
// econgs/splat/native.py is its only caller and documents what the functions mean.
#include "arrays.h"

#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "rasteriser.h"
#include "threads.h"

using namespace econgs;
using namespace std::string_literals;

namespace {

using Doubles = nb::ndarray<const double, nb::shape<16>, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

Inputs inputs(const In& means, const In& quats, const In& scales, const In& opacities, const In& features,
              const std::optional<In>& offset) {
  const int64_t n = means.ndim() == 2 ? static_cast<int64_t>(means.shape(0)) : -1;
  expect(n >= 0 && is(means, {n, 3}), "means must have shape (N, 3)");
  expect(n < (int64_t{1} << 31), "at most 2^31 Gaussians");
  expect(is(quats, {n, 4}), "quats must have shape (N, 4)");
  expect(is(scales, {n, 3}), "scales must have shape (N, 3)");
  expect(is(opacities, {n}), "opacities must have shape (N,)");
  expect(features.ndim() == 2 && static_cast<int64_t>(features.shape(0)) == n && features.shape(1) >= 1,
         "features must have shape (N, C) with C >= 1");
  expect(!offset || is(*offset, {n, 2}), "screen_offset must have shape (N, 2)");
  const float* const shift = data_or_null(offset);
  const int channels = static_cast<int>(features.shape(1));
  return {means.data(), quats.data(), scales.data(), opacities.data(), features.data(), shift, n, channels};
}

View view_of(const Doubles& numbers, double near, double low_pass, bool compensated, double ray_power,
             const Array& alpha) {
  View view;
  const double* const p = numbers.data();
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) view.rotation[3 * i + j] = p[4 * i + j];
    view.translation[i] = p[4 * i + 3];
  }
  view.fx = p[12];
  view.fy = p[13];
  view.cx = p[14];
  view.cy = p[15];
  view.near = near;
  view.low_pass = low_pass;
  view.compensated = compensated;
  view.ray_power = ray_power;
  expect(std::isfinite(low_pass) && low_pass > 0, "the variance of the low-pass filter must be above 0");
  expect(ray_power >= 0 && ray_power <= 1, "the power of the ray must be 0 to 1");
  expect(alpha.ndim() == 2 && alpha.shape(0) >= 1 && alpha.shape(1) >= 1, "the image must have pixels");
  expect(alpha.shape(0) < (1 << 20) && alpha.shape(1) < (1 << 20), "the image is too large");
  view.height = static_cast<int>(alpha.shape(0));
  view.width = static_cast<int>(alpha.shape(1));
  for (int i = 0; i < 16; ++i) expect(std::isfinite(p[i]), "camera: pose and intrinsics must be finite");
  expect(view.fx > 0 && view.fy > 0, "camera: focal lengths must be positive");
  return view;
}

// The caller (Python) owns the frame.
Frame* forward_checked(const In& means, const In& quats, const In& scales, const In& opacities, const In& features,
                       std::optional<In> offset, const Doubles& numbers, double near, double low_pass, bool compensated,
                       double ray_power, const Array& image, const Array& alpha, const Array& depth,
                       const Counts& radii, bool keep) {
  const Inputs in = inputs(means, quats, scales, opacities, features, offset);
  const View view = view_of(numbers, near, low_pass, compensated, ray_power, alpha);
  expect(is(depth, {view.height, view.width}) && is(image, {view.height, view.width, in.channels}) &&
             static_cast<int64_t>(radii.shape(0)) == in.count,
         "the outputs have other sizes than the inputs ask for");
  const Images out = {image.data(), alpha.data(), depth.data()};
  std::unique_ptr<Frame> frame;
  int32_t* const radius = radii.data();
  {
    nb::gil_scoped_release release;
    frame = forward(in, view, out, radius, keep);
  }
  expect(frame != nullptr, "the Gaussians hold a value that cannot be used");
  return frame.release();
}

void backward_checked(const Frame& frame, const In& means, const In& quats, const In& scales, const In& opacities,
                      const In& features, const In& image, const In& alpha, const In& depth,
                      std::optional<In> grad_image, std::optional<In> grad_alpha, std::optional<In> grad_depth,
                      const Array& to_means, const Array& to_quats, const Array& to_scales, const Array& to_opacities,
                      const Array& to_features, std::optional<Array> to_offset, std::optional<In> offset) {
  const Inputs in = inputs(means, quats, scales, opacities, features, offset);
  const int64_t h = frame.view.height, w = frame.view.width, n = in.count;
  expect(n == frame.count, "another number of Gaussians than in the forward pass");
  expect(is(image, {h, w, in.channels}) && is(alpha, {h, w}) && is(depth, {h, w}), "outputs of another size");
  expect((!grad_image || is(*grad_image, {h, w, in.channels})) && (!grad_alpha || is(*grad_alpha, {h, w})) &&
             (!grad_depth || is(*grad_depth, {h, w})),
         "a gradient of another size than its image");
  expect(is(to_means, {n, 3}) && is(to_quats, {n, 4}) && is(to_scales, {n, 3}) && is(to_opacities, {n}) &&
             is(to_features, {n, in.channels}) && (!to_offset || is(*to_offset, {n, 2})),
         "a gradient of another size than its tensor");
  const ConstImages out = {image.data(), alpha.data(), depth.data()};
  const ConstImages grad = {data_or_null(grad_image), data_or_null(grad_alpha), data_or_null(grad_depth)};
  const Gradients to = {to_means.data(),     to_quats.data(),    to_scales.data(),
                        to_opacities.data(), to_features.data(), data_or_null(to_offset)};
  nb::gil_scoped_release release;
  backward(frame, in, out, grad, to);
}

// Coefficients come as one tensor (N, K, 3), or as the first (N, 1, 3) and the others (N, K - 1, 3).
Coefficients coefficients_of(int degree, const In& means, const In& position, const In& first,
                             const std::optional<In>& rest) {
  const int64_t n = means.ndim() == 2 ? static_cast<int64_t>(means.shape(0)) : -1;
  expect(degree >= 0 && degree <= 3, "the degree of the spherical harmonics must be 0 to 3");
  expect(n >= 0 && is(means, {n, 3}) && is(position, {3}), "means must have shape (N, 3) and the position (3,)");
  const auto fits = [n](const In& one) {
    return one.ndim() == 3 && static_cast<int64_t>(one.shape(0)) == n && one.shape(2) == 3;
  };
  expect(fits(first) && first.shape(1) >= 1 && (!rest || (fits(*rest) && first.shape(1) == 1)),
         "coefficients must have shape (N, K, 3), or (N, 1, 3) and (N, K - 1, 3)");
  const int64_t stride = 3 * first.shape(1);
  const Coefficients all = rest ? Coefficients{first.data(), rest->data(), 3, static_cast<int64_t>(3 * rest->shape(1)),
                                               static_cast<int>(rest->shape(1))}
                                : Coefficients{first.data(), n ? first.data() + 3 : nullptr, stride, n ? stride : 0,
                                               static_cast<int>(first.shape(1)) - 1};
  expect(all.rest_bands + 1 >= (degree + 1) * (degree + 1), "fewer coefficients than the degree needs");
  return all;
}

void sh_forward(int degree, const In& means, const In& position, const In& first, std::optional<In> rest,
                const Array& colors) {
  const Coefficients in = coefficients_of(degree, means, position, first, rest);
  const int64_t n = means.shape(0);
  expect(is(colors, {n, 3}), "colors must have shape (N, 3)");
  const float *const m = means.data(), *const p = position.data();
  float* const out = colors.data();
  nb::gil_scoped_release release;
  parallel_ranges(n, 2048, [&](int64_t begin, int64_t end, int) { kernels().sh(degree, in, m, p, out, begin, end); });
}

void sh_backward(int degree, const In& means, const In& position, const In& first, std::optional<In> rest,
                 const In& colors, const In& grad, const Array& grad_means, const Array& grad_first,
                 std::optional<Array> grad_rest) {
  const Coefficients in = coefficients_of(degree, means, position, first, rest);
  const int64_t n = means.shape(0);
  expect(is(colors, {n, 3}) && is(grad, {n, 3}) && is(grad_means, {n, 3}) &&
             is(grad_first, {n, static_cast<int64_t>(first.shape(1)), 3}) && !grad_rest == !rest &&
             (!rest || is(*grad_rest, {n, in.rest_bands, 3})),
         "a gradient of another size than its tensor");
  const MutableCoefficients out = {grad_first.data(), rest ? grad_rest->data() : n ? grad_first.data() + 3 : nullptr};
  const float *const m = means.data(), *const p = position.data(), *const shaded = colors.data(),
                     *const outer = grad.data();
  float* const to_means = grad_means.data();
  nb::gil_scoped_release release;
  parallel_ranges(n, 1024, [&](int64_t begin, int64_t end, int) {
    kernels().sh_backward(degree, in, m, p, shaded, outer, to_means, out, begin, end);
  });
}

std::pair<double, double> photometric_checked(const In& x, const In& y, float absolute, float structural,
                                              std::optional<Array> grad) {
  expect(x.ndim() == 3 && x.size() > 0, "images must have shape (H, W, C)");
  const int64_t h = x.shape(0), w = x.shape(1), c = x.shape(2);
  expect(is(y, {h, w, c}) && (!grad || is(*grad, {h, w, c})), "the images have different shapes");
  double ssim = 0, mean = 0;
  const float *const a = x.data(), *const b = y.data();
  float* const to = data_or_null(grad);
  {
    nb::gil_scoped_release release;
    mean = photometric(a, b, h, w, static_cast<int>(c), absolute, structural, to, &ssim);
  }
  return {mean, ssim};
}

std::tuple<double, double, double> view_loss_checked(const In& color, const In& alpha, const In& truth, const In& back,
                                                     float absolute, float structural, float alpha_weight,
                                                     float vanishing, float rescue, std::optional<Array> grad_color,
                                                     std::optional<Array> grad_alpha) {
  expect(color.ndim() == 3 && color.size() > 0, "colors must have shape (H, W, 3)");
  const int64_t h = color.shape(0), w = color.shape(1);
  expect(is(color, {h, w, 3}) && is(alpha, {h, w}) && is(truth, {h, w, 4}) && is(back, {3}) &&
             (!grad_color || (is(*grad_color, {h, w, 3}) && grad_alpha && is(*grad_alpha, {h, w}))),
         "colors (H, W, 3), alpha (H, W), a view (H, W, 4) and a background (3) are needed");
  ViewLoss loss;
  const float *const c = color.data(), *const a = alpha.data(), *const t = truth.data(), *const b = back.data();
  float *const to_color = data_or_null(grad_color), *const to_alpha = data_or_null(grad_alpha);
  {
    nb::gil_scoped_release release;
    loss = view_loss(c, a, t, b, h, w, absolute, structural, alpha_weight, vanishing, rescue, to_color, to_alpha);
  }
  return {loss.absolute, loss.ssim, loss.alpha};
}

void adam(const std::vector<Array>& params, const std::vector<In>& grads, const std::vector<Array>& first,
          const std::vector<Array>& second, const std::vector<double>& rates, double beta1, double beta2, double eps,
          int64_t step) {
  expect(step >= 1, "the first step of Adam is step 1");
  const size_t count = params.size();
  expect(grads.size() == count && first.size() == count && second.size() == count && rates.size() == count,
         "adam_step: as many gradients, moments and rates as parameters are needed");
  struct Piece {
    float* p;
    const float* g;
    float *m, *v;
    int64_t n;
    AdamRates rates;
  };
  constexpr int64_t GRAIN = 16384;
  std::vector<Piece> pieces;
  const double t = static_cast<double>(step);
  const double left1 = 1.0 - std::pow(beta1, t), left2 = 1.0 - std::pow(beta2, t);
  for (size_t i = 0; i < count; ++i) {
    const int64_t n = static_cast<int64_t>(params[i].size());
    expect(static_cast<int64_t>(grads[i].size()) == n && static_cast<int64_t>(first[i].size()) == n &&
               static_cast<int64_t>(second[i].size()) == n,
           "adam_step: a gradient or moment has another size than its parameter");
    const AdamRates r = {
        static_cast<float>(rates[i] / left1), static_cast<float>(beta2), static_cast<float>(1.0 - beta1),
        static_cast<float>(1.0 - beta2),      static_cast<float>(eps),   static_cast<float>(1.0 / std::sqrt(left2))};
    for (int64_t at = 0; at < n; at += GRAIN)
      pieces.push_back({params[i].data() + at, grads[i].data() + at, first[i].data() + at, second[i].data() + at,
                        std::min(GRAIN, n - at), r});
  }
  nb::gil_scoped_release release;
  parallel(static_cast<int64_t>(pieces.size()), [&](int64_t item, int) {
    const Piece& one = pieces[item];
    kernels().adam(one.p, one.g, one.m, one.v, one.n, one.rates);
  });
}

template <class Condition>
std::vector<std::string> names_of(Condition condition) {
  std::vector<std::string> names;
  for (const Kernels* one : built_kernels())
    if (condition(*one)) names.push_back(one->name);
  return names;
}

}  // namespace

NB_MODULE(_native, m) {
  m.doc() = "Compiled kernels of the splatting core; call them through econgs.splat.native.";
  nb::class_<Frame>(m, "Frame").def_prop_ro("statistics", [](const Frame& frame) {
    const FrameStatistics& s = frame.statistics;
    nb::typed<nb::dict, std::string, double> d;
    d["project"] = s.project;
    d["sort"] = s.sort;
    d["bin"] = s.bin;
    d["blend"] = s.blend;
    d["visible"] = s.visible;
    d["intersections"] = frame.intersections;
    d["evaluations"] = s.evaluations;
    return d;
  });

  m.def("built_isas", [] { return names_of([](const Kernels&) { return true; }); });
  m.def(
      "available_isas",
      [](bool testing) {
        return names_of([=](const Kernels& one) { return supported(one) && (testing || one.name != "avx2x16"s); });
      },
      "testing"_a);
  m.def("isa", [] { return std::string(kernels().name); });
  m.def(
      "set_isa",
      [](const std::string& name) {
        for (const Kernels* one : built_kernels())
          if (name == one->name && supported(*one)) return use_kernels(*one);
        throw std::invalid_argument("this processor or build lacks " + name);
      },
      "name"_a);
  m.def("threads", threads);
  m.def("set_threads", set_threads, "count"_a);

  m.def("forward", forward_checked, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "features"_a, "offset"_a.none(),
        "view"_a, "near"_a, "low_pass"_a, "compensated"_a, "ray_power"_a, "image"_a, "alpha"_a, "depth"_a, "radii"_a,
        "keep"_a, nb::rv_policy::take_ownership);
  m.def("backward", backward_checked, "frame"_a, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "features"_a,
        "image"_a, "alpha"_a, "depth"_a, "grad_image"_a.none(), "grad_alpha"_a.none(), "grad_depth"_a.none(),
        "to_means"_a, "to_quats"_a, "to_scales"_a, "to_opacities"_a, "to_features"_a, "to_offset"_a.none(),
        "offset"_a.none());
  m.def("sh_forward", sh_forward, "degree"_a, "means"_a, "position"_a, "first"_a, "rest"_a.none(), "colors"_a);
  m.def("sh_backward", sh_backward, "degree"_a, "means"_a, "position"_a, "first"_a, "rest"_a.none(), "colors"_a,
        "grad"_a, "grad_means"_a, "grad_first"_a, "grad_rest"_a.none());
  m.def("photometric", photometric_checked, "x"_a, "y"_a, "absolute"_a, "structural"_a, "grad"_a.none());
  m.def("view_loss", view_loss_checked, "color"_a, "alpha"_a, "truth"_a, "back"_a, "absolute"_a, "structural"_a,
        "alpha_weight"_a, "vanishing"_a, "rescue"_a, "grad_color"_a.none(), "grad_alpha"_a.none());
  m.def("adam", adam, "params"_a, "grads"_a, "first"_a, "second"_a, "rates"_a, "beta1"_a, "beta2"_a, "eps"_a, "step"_a);
  bind_anchors(m);
  bind_decode(m);
  bind_factors(m);
  bind_hash_grid(m);
  bind_voxels(m);

  m.def("reference_kernel", reference_kernel, nb::call_guard<nb::gil_scoped_release>());
  m.def("bench_blend", bench_blend, "channels"_a, nb::call_guard<nb::gil_scoped_release>());
}
