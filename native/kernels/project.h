// From Gaussians in the scene to ellipses on the image and back (EWA splatting, Zwicker et al. 2001).
//
// In double: the cost is small beside blending, and centres in pixels keep their accuracy in large images.
#pragma once

#include "simd.h"
#include "table.h"

extern "C" double log2(double) noexcept;  // libm's, declared here to keep <cmath> and its templates out

namespace ECONGS_ISA {

using namespace econgs;

struct Vec3 {
  vd x, y, z;
};
INLINE Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE Vec3 operator*(vd s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
INLINE Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
INLINE Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
INLINE vd dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Vec3 row(const double* m) { return {setd(m[0]), setd(m[1]), setd(m[2])}; }

// Of positive normal doubles; relative error 1e-13.
INLINE vd log2d(vd x) {
  const vl bits = (vl)x - 0x3fe6a09e667f3bcdLL;  // sqrt(1/2)
  const vd exponent = __builtin_convertvector(bits >> 52, vd);
  const vd m = (vd)((bits & 0x000fffffffffffffLL) + 0x3fe6a09e667f3bcdLL) - 1.0;
  const vd s = m / (m + 2.0), q = s * s;
  vd p = setd(1.0 / 17.0);
  for (int n = 15; n >= 1; n -= 2) p = p * q + 1.0 / n;
  return exponent + 2.8853900817779268 * s * p;
}

// Of -1000 to 1000, beyond which it stays.
INLINE vd exp2d(vd x) {
  x = maxd(mind(x, setd(1000.0)), setd(-1000.0));
  const vd whole = (x + 0x1.8p52) - 0x1.8p52, t = (x - whole) * 0.6931471805599453;
  vd p = setd(1.0);
  for (int n = 12; n >= 1; --n) p = 1.0 + t * p * (1.0 / n);
  return p * (vd)((__builtin_convertvector(whole, vl) + 1023) << 52);
}

// DLANES Gaussians; lanes past the end repeat the last one.
struct Batch {
  Vec3 mean, scale;
  vd w, x, y, z, norm;         // unit quaternion, and its length before
  vd opacity, off_u, off_v;
};

// All the intermediate values that the gradients need again.
struct Geometry {
  Vec3 local;                  // camera space
  vd slope_x, slope_y;         // clamped
  Vec3 k1, k2;                 // rows of Jacobian * view
  Vec3 c1, c2, c3;             // columns of the Gaussian's rotation
  Vec3 r1, r2, m1, m2;         // k * rotation, and that times the scales
  Vec3 cross;                  // m1 x m2; its square is the determinant before the filter
  vd a, b, c, det, u, v;
  vd opacity;                  // after the filter
  // Where areas count: k1 x k2 and its square, squares of the scales, sum of squared areas, log2 of the relative depth,
  // its power, transmittance and opacity before the filter.
  Vec3 across, squares;
  vd across2, areas, depth, ray, through, deep;
};

INLINE Batch gather(const Inputs& in, int64_t begin, int64_t end) {
  Batch g;
  vd* const m[3] = {&g.mean.x, &g.mean.y, &g.mean.z};
  vd* const s[3] = {&g.scale.x, &g.scale.y, &g.scale.z};
  vd* const q[4] = {&g.w, &g.x, &g.y, &g.z};
  for (int l = 0; l < DLANES; ++l) {
    const int64_t n = begin + l < end ? begin + l : end - 1;
    for (int k = 0; k < 3; ++k) (*m[k])[l] = in.means[3 * n + k];
    for (int k = 0; k < 3; ++k) (*s[k])[l] = in.scales[3 * n + k];
    for (int k = 0; k < 4; ++k) (*q[k])[l] = in.quats[4 * n + k];
    g.opacity[l] = in.opacities[n];
    g.off_u[l] = in.offset ? in.offset[2 * n] : 0.0f;
    g.off_v[l] = in.offset ? in.offset[2 * n + 1] : 0.0f;
  }
  g.norm = sqrtd(g.w * g.w + g.x * g.x + g.y * g.y + g.z * g.z);
  const vd inverse = 1.0 / g.norm;
  g.w *= inverse;
  g.x *= inverse;
  g.y *= inverse;
  g.z *= inverse;
  return g;
}

constexpr double MIN_AREAS = 1e-60;

INLINE Geometry geometry(const Batch& g, const View& view) {
  Geometry o;
  const Vec3 v0 = row(view.rotation), v1 = row(view.rotation + 3), v2 = row(view.rotation + 6);
  o.local = {dot(v0, g.mean) + view.translation[0], dot(v1, g.mean) + view.translation[1],
             dot(v2, g.mean) + view.translation[2]};
  const vd inverse = 1.0 / o.local.z;
  const vd limit_x = setd(CLAMP * 0.5 * view.width / view.fx), limit_y = setd(CLAMP * 0.5 * view.height / view.fy);
  const vd tx = o.local.x * inverse, ty = o.local.y * inverse;
  o.slope_x = maxd(mind(tx, limit_x), -limit_x);
  o.slope_y = maxd(mind(ty, limit_y), -limit_y);
  o.k1 = (view.fx * inverse) * (v0 + (-o.slope_x) * v2);
  o.k2 = (view.fy * inverse) * (v1 + (-o.slope_y) * v2);
  o.c1 = {1.0 - 2.0 * (g.y * g.y + g.z * g.z), 2.0 * (g.x * g.y + g.w * g.z), 2.0 * (g.x * g.z - g.w * g.y)};
  o.c2 = {2.0 * (g.x * g.y - g.w * g.z), 1.0 - 2.0 * (g.x * g.x + g.z * g.z), 2.0 * (g.y * g.z + g.w * g.x)};
  o.c3 = {2.0 * (g.x * g.z + g.w * g.y), 2.0 * (g.y * g.z - g.w * g.x), 1.0 - 2.0 * (g.x * g.x + g.y * g.y)};
  o.r1 = {dot(o.k1, o.c1), dot(o.k1, o.c2), dot(o.k1, o.c3)};
  o.r2 = {dot(o.k2, o.c1), dot(o.k2, o.c2), dot(o.k2, o.c3)};
  o.m1 = o.r1 * g.scale;
  o.m2 = o.r2 * g.scale;
  const vd aa = dot(o.m1, o.m1), cc = dot(o.m2, o.m2);
  o.b = dot(o.m1, o.m2);
  // Determinant by the cross product of the rows (Cauchy-Binet): a c - b^2 would cancel for needles.
  o.cross = cross(o.m1, o.m2);
  const vd before = dot(o.cross, o.cross);
  o.det = before + view.low_pass * (aa + cc) + view.low_pass * view.low_pass;
  o.a = aa + view.low_pass;
  o.c = cc + view.low_pass;
  o.deep = g.opacity;
  if (view.ray_power > 0.0) {
    // Across the ray, a Gaussian has the area |m1 x m2| / |k1 x k2|; across its axes, the products of two scales.
    o.across = cross(o.k1, o.k2);
    o.across2 = dot(o.across, o.across);
    o.squares = g.scale * g.scale;
    o.areas = o.squares.y * o.squares.z + o.squares.x * (o.squares.y + o.squares.z);
    o.depth =
        0.5 * (log2d(maxd(o.areas * (1.0 / 3.0), setd(MIN_AREAS))) - log2d(maxd(before / o.across2, setd(MIN_AREAS))));
    o.ray = exp2d(view.ray_power * mind(o.depth, setd(MAX_DEPTH)));
    o.through = maxd(1.0 - g.opacity, setd(MIN_THROUGH));
    o.deep = 1.0 - exp2d(o.ray * log2d(o.through));
  }
  o.opacity = view.compensated ? o.deep * sqrtd(before / o.det) : o.deep;
  o.u = view.fx * tx + view.cx + g.off_u;
  o.v = view.fy * ty + view.cy + g.off_v;
  return o;
}

INLINE float narrow(double x) { return (float)(x > 1e30 ? 1e30 : x < -1e30 ? -1e30 : x); }

static bool project(const Inputs& in, const View& view, Splat* splats, int32_t* radii, int64_t begin, int64_t end) {
  bool valid = true;
  for (int64_t n = begin; n < end; ++n) {  // 0 * x is NaN where x is NaN or infinite
    float finite = 0.0f;
    for (int k = 0; k < in.channels; ++k) finite += 0.0f * in.features[n * in.channels + k];
    valid &= finite == 0.0f;
  }
  for (int64_t start = begin; start < end; start += DLANES) {
    const Batch g = gather(in, start, end);
    const vd finite = 0.0 * (g.mean.x + g.mean.y + g.mean.z + g.norm + g.scale.x + g.scale.y + g.scale.z + g.opacity +
                             g.off_u + g.off_v);
    const vl sound = (finite == 0.0) & (g.opacity >= 0.0) & (g.opacity <= 1.0) & (g.scale.x >= 0.0) &
                     (g.scale.y >= 0.0) & (g.scale.z >= 0.0) & (g.norm > 0.0);
    const Geometry o = geometry(g, view);
    const vd inverse = 1.0 / o.det;
    vd bound;
    for (int l = 0; l < DLANES; ++l) bound[l] = o.opacity[l] * 255.0f >= 1.0 ? ::log2(o.opacity[l]) : -100.0;
    const vd lift = bound;
    bound = maxd((bound + 7.994353436858858) * (2.0 * 0.6931471805599453), vd{});  // 2 ln(255 opacity)
    const vd half_u = sqrtd(bound * o.a), half_v = sqrtd(bound * o.c);
    const vd middle = 0.5 * (o.a + o.c), apart = 0.5 * (o.a - o.c);
    const vd radius = 3.0 * sqrtd(middle + sqrtd(apart * apart + o.b * o.b));
    // Visible: nearer than `near` is culled, and the ellipse's box must hold the centre of a pixel.
    const vd left = maxd(o.u - half_u, setd(0.5)), right = mind(o.u + half_u, setd(view.width - 0.5));
    const vd low = maxd(o.v - half_v, setd(0.5)), high = mind(o.v + half_v, setd(view.height - 0.5));
    const vl visible = sound & (o.local.z > view.near) & (o.local.z < 1e30) & (o.opacity >= 1.0 / 255.0) &
                       (left <= right) & (low <= high);
    // Rounding in float must not cut a pixel off whose alpha is 1/255 in float: widened by a hair.
    const vd wide = bound * (1.0 + 1e-4) + 1e-4;
    const vd tip = o.b * sqrtd(wide / o.a), top = sqrtd(wide * o.c), reach = sqrtd(wide * o.a);
    const vd log2e = setd(1.4426950408889634);
    const vd inverse_c = 1.0 / o.c, slope = o.b * inverse_c, width2 = o.det * inverse_c;
    const vd a = -0.5 * log2e * o.c * inverse, c = -0.5 * log2e * inverse_c;
    for (int l = 0; l < DLANES && start + l < end; ++l) {
      const int64_t n = start + l;
      valid &= sound[l] != 0;
      int across = 0;
      if (visible[l]) {  // ... and of a pixel, not only lie between two
        const double first_x = __builtin_ceil(left[l] - 0.5), last_x = __builtin_floor(right[l] - 0.5);
        const double first_y = __builtin_ceil(low[l] - 0.5), last_y = __builtin_floor(high[l] - 0.5);
        if (first_x <= last_x && first_y <= last_y)
          across = radius[l] < 1073741824.0 ? (int)__builtin_ceil(radius[l]) : 1073741824;
      }
      radii[n] = across;
      Splat& s = splats[n];
      s.opacity = across ? (float)o.opacity[l] : 0.0f;
      s.depth = across ? (float)o.local.z[l] : 0.0f;
      if (!across) continue;
      s.u = o.u[l];
      s.v = o.v[l];
      s.a = (float)a[l];
      s.c = (float)c[l];
      s.lift = (float)lift[l];
      s.slope = narrow(slope[l]);
      s.inverse = (float)inverse_c[l];
      s.width2 = narrow(width2[l]);
      s.bound = (float)wide[l];
      s.tip = narrow(tip[l]);
      s.top = narrow(top[l]);
      s.reach = narrow(reach[l]);
    }
  }
  return valid;
}

static void project_backward(const Inputs& in, const View& view, const Splat* splats, const uint32_t* first_slot,
                             const float* slots, const Gradients& out, int64_t begin, int64_t end) {
  const int channels = in.channels, size = slot_size(channels);
  const Vec3 v0 = row(view.rotation), v1 = row(view.rotation + 3), v2 = row(view.rotation + 6);
  for (int64_t start = begin; start < end; start += DLANES) {
    const int count = end - start < DLANES ? (int)(end - start) : DLANES;
    bool any = false;
    vd sum[SLOT_FEATURES] = {};
    for (int l = 0; l < count; ++l) {
      const int64_t n = start + l;
      float* const features = out.features + n * channels;
      for (int k = 0; k < channels; ++k) features[k] = 0.0f;
      // Always in the order of the tiles, so the sum is the same for any number of threads.
      v4 first = {}, second = {};
      for (uint32_t i = first_slot[n]; i < first_slot[n + 1]; ++i) {
        const float* const slot = slots + (int64_t)i * size;
        first += *(const v4_unaligned*)slot;
        second += *(const v4_unaligned*)(slot + 4);
        for (int k = 0; k < channels; ++k) features[k] += slot[SLOT_FEATURES + k];
        any = true;
      }
      for (int q = 0; q < 4; ++q) sum[q][l] = first[q];
      for (int q = 4; q < SLOT_FEATURES; ++q) sum[q][l] = second[q - 4];
    }
    if (!any) {
      for (int64_t n = start; n < start + count; ++n) {
        for (int k = 0; k < 3; ++k) out.means[3 * n + k] = out.scales[3 * n + k] = 0.0f;
        for (int k = 0; k < 4; ++k) out.quats[4 * n + k] = 0.0f;
        out.opacities[n] = 0.0f;
        if (out.offset) out.offset[2 * n] = out.offset[2 * n + 1] = 0.0f;
      }
      continue;
    }
    const Batch g = gather(in, start, end);
    const Geometry o = geometry(g, view);
    // With K the conic, alpha = opacity exp(-1/2 d' K d) and K d = (p e, q dy - slope p e), p = c / det, q = 1 / c.
    const vd q = 1.0 / o.c, p = o.c / o.det, slope = o.b * q;
    const vd du = p * sum[SLOT_E], dv = q * sum[SLOT_Y] - slope * du;
    // dL/dcov = 1/2 sum of h (K d) (K d)'
    const vd ee = p * p * sum[SLOT_EE], ey = p * q * sum[SLOT_EY], yy = q * q * sum[SLOT_YY];
    const vd h11 = 0.5 * ee, h12 = 0.5 * (ey - slope * ee), h22 = 0.5 * (yy - slope * (2.0 * ey - slope * ee));
    Vec3 dm1 = (2.0 * h11) * o.m1 + (2.0 * h12) * o.m2, dm2 = (2.0 * h12) * o.m1 + (2.0 * h22) * o.m2;
    if (view.compensated) {  // ln opacity holds 1/2 ln (det before / det after)
      const vd inverse = 1.0 / o.det, grown = sum[SLOT_SUM] * (1.0 / dot(o.cross, o.cross) - inverse);
      const vd lost = sum[SLOT_SUM] * (-view.low_pass * inverse);
      dm1 = dm1 + grown * cross(o.m2, o.cross) + lost * o.m1;
      dm2 = dm2 + grown * cross(o.cross, o.m1) + lost * o.m2;
    }
    vd deeper = {};  // gradient by the logarithm of the relative depth
    if (view.ray_power > 0.0) {
      const vd depth = -0.6931471805599453 * log2d(o.through) * o.ray;
      deeper = o.depth < MAX_DEPTH ? sum[SLOT_SUM] * (1.0 - o.deep) / o.deep * depth * view.ray_power : vd{};
      const vd less = deeper * (-1.0 / maxd(dot(o.cross, o.cross), setd(MIN_AREAS)));
      dm1 = dm1 + less * cross(o.m2, o.cross);
      dm2 = dm2 + less * cross(o.cross, o.m1);
    }
    Vec3 ds = o.r1 * dm1 + o.r2 * dm2;
    const Vec3 dr1 = g.scale * dm1, dr2 = g.scale * dm2;
    const Vec3 dc1 = dr1.x * o.k1 + dr2.x * o.k2, dc2 = dr1.y * o.k1 + dr2.y * o.k2, dc3 = dr1.z * o.k1 + dr2.z * o.k2;
    Vec3 dk1 = dr1.x * o.c1 + dr1.y * o.c2 + dr1.z * o.c3, dk2 = dr2.x * o.c1 + dr2.y * o.c2 + dr2.z * o.c3;
    if (view.ray_power > 0.0) {
      const vd wider = deeper / o.across2, larger = deeper / maxd(o.areas, setd(MIN_AREAS));
      dk1 = dk1 + wider * cross(o.k2, o.across);
      dk2 = dk2 + wider * cross(o.across, o.k1);
      const Vec3& q2 = o.squares;
      ds = ds + larger * (g.scale * Vec3{q2.y + q2.z, q2.x + q2.z, q2.x + q2.y});
    }

    const vd near = 1.0 / o.local.z, fx = view.fx * near, fy = view.fy * near;
    const vd tx = o.local.x * near, ty = o.local.y * near;
    // A clamped slope is constant.
    const vd dsx = tx == o.slope_x ? -fx * dot(dk1, v2) : vd{}, dsy = ty == o.slope_y ? -fy * dot(dk2, v2) : vd{};
    Vec3 local;
    local.x = du * fx + dsx * near;
    local.y = dv * fy + dsy * near;
    local.z =
        sum[SLOT_DEPTH] - near * (dot(dk1, o.k1) + dot(dk2, o.k2) + dsx * tx + dsy * ty) - du * fx * tx - dv * fy * ty;
    const Vec3 mean = local.x * v0 + local.y * v1 + local.z * v2;

    // Columns c1, c2, c3 hold R00 R10 R20, R01 R11 R21, R02 R12 R22.
    const vd w = g.w, x = g.x, y = g.y, z = g.z;
    vd dw = 2.0 * (z * (dc1.y - dc2.x) + y * (dc3.x - dc1.z) + x * (dc2.z - dc3.y));
    vd dx = 2.0 * (y * (dc2.x + dc1.y) + z * (dc3.x + dc1.z) - 2.0 * x * (dc2.y + dc3.z) + w * (dc2.z - dc3.y));
    vd dy = 2.0 * (x * (dc2.x + dc1.y) + z * (dc3.y + dc2.z) - 2.0 * y * (dc1.x + dc3.z) + w * (dc3.x - dc1.z));
    vd dz = 2.0 * (x * (dc3.x + dc1.z) + y * (dc3.y + dc2.z) - 2.0 * z * (dc1.x + dc2.y) + w * (dc1.y - dc2.x));
    const vd along = dw * w + dx * x + dy * y + dz * z;
    dw = (dw - along * w) / g.norm;
    dx = (dx - along * x) / g.norm;
    dy = (dy - along * y) / g.norm;
    dz = (dz - along * z) / g.norm;
    vd to_opacity = 1.0 / g.opacity;
    if (view.ray_power > 0.0)
      to_opacity = 1.0 - g.opacity > MIN_THROUGH ? o.ray * (1.0 - o.deep) / (o.through * o.deep) : vd{};
    for (int l = 0; l < count; ++l) {
      const int64_t n = start + l;
      const bool visible = splats[n].opacity > 0.0f;
      const double to_mean[3] = {mean.x[l], mean.y[l], mean.z[l]}, to_scale[3] = {ds.x[l], ds.y[l], ds.z[l]};
      const double to_quat[4] = {dw[l], dx[l], dy[l], dz[l]}, to_offset[2] = {du[l], dv[l]};
      for (int k = 0; k < 3; ++k) out.means[3 * n + k] = visible ? narrow(to_mean[k]) : 0.0f;
      for (int k = 0; k < 3; ++k) out.scales[3 * n + k] = visible ? narrow(to_scale[k]) : 0.0f;
      for (int k = 0; k < 4; ++k) out.quats[4 * n + k] = visible ? narrow(to_quat[k]) : 0.0f;
      for (int k = 0; k < 2 && out.offset; ++k) out.offset[2 * n + k] = visible ? narrow(to_offset[k]) : 0.0f;
      out.opacities[n] = visible ? (float)(sum[SLOT_SUM][l] * to_opacity[l]) : 0.0f;
    }
  }
}

}  // namespace ECONGS_ISA
