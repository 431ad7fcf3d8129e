// A thin vector layer over the GCC/Clang vector extensions, for the units that are compiled once per ISA.
//
// Everything here has internal linkage and nothing comes from std::, because a weak symbol compiled with
// AVX-512 flags may be the one the linker keeps for everybody. LANES is a parameter of its own, not a
// consequence of the ISA: the 16-lane code also compiles for AVX2 (as a test of the AVX-512 logic).
#pragma once

#include <stddef.h>
#include <stdint.h>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#ifndef ECONGS_LANES
#error "define ECONGS_LANES (4, 8 or 16 floats)"
#endif

#define INLINE static inline __attribute__((always_inline, unused))

namespace ECONGS_ISA {

constexpr int LANES = ECONGS_LANES;   // floats per vector
constexpr int DLANES = LANES / 2;     // doubles per vector

typedef float vf __attribute__((vector_size(4 * LANES)));
typedef int32_t vi __attribute__((vector_size(4 * LANES)));
typedef double vd __attribute__((vector_size(8 * DLANES)));
typedef int64_t vl __attribute__((vector_size(8 * DLANES)));
typedef float vf_unaligned __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef float v4 __attribute__((vector_size(16)));
typedef float v4_unaligned __attribute__((vector_size(16), aligned(4), may_alias));

// The intrinsic of that name for whole vectors, and its types, where the ISA has vectors of this width.
#if ECONGS_LANES == 16 && defined(__AVX512F__)
#define WIDE(name) _mm512_##name
typedef __m512 wide_f;
typedef __m512d wide_d;
#elif ECONGS_LANES == 8 && defined(__AVX__)
#define WIDE(name) _mm256_##name
typedef __m256 wide_f;
typedef __m256d wide_d;
#elif ECONGS_LANES == 4 && defined(__SSE2__)
#define WIDE(name) _mm_##name
typedef __m128 wide_f;
typedef __m128d wide_d;
#endif

union Quarters {
  vf v;
  v4 q[LANES / 4];
};
#if ECONGS_LANES == 16 && defined(__AVX2__)
union Halves {
  vf v;
  __m256 h[2];
};
#endif

INLINE vf load(const float* p) { return (vf) * (const vf_unaligned*)p; }
INLINE void store(float* p, vf v) { *(vf_unaligned*)p = v; }
// The first n lanes alone; the others are zero, and not stored.
INLINE vf load(const float* p, int64_t n) {
  vf v = {};
  for (int l = 0; l < n; ++l) v[l] = p[l];
  return v;
}
INLINE void store(float* p, vf v, int64_t n) {
  for (int l = 0; l < n; ++l) p[l] = v[l];
}
INLINE v4 load3(const float* p) { return v4{p[0], p[1], p[2], 0.0f}; }
INLINE v4 load4(const float* p) { return *(const v4_unaligned*)p; }
INLINE void store4(float* p, v4 v) { *(v4_unaligned*)p = v; }
INLINE vf set(float x) {
#ifdef WIDE
  return (vf)WIDE(set1_ps)(x);
#else
  vf v;
  for (int l = 0; l < LANES; ++l) v[l] = x;
  return v;
#endif
}
INLINE vd setd(double x) { return vd{} + x; }
INLINE vf min(vf a, vf b) {
#ifdef WIDE
  return (vf)WIDE(min_ps)((wide_f)a, (wide_f)b);
#else
  return a < b ? a : b;
#endif
}
INLINE vf max(vf a, vf b) {
#ifdef WIDE
  return (vf)WIDE(max_ps)((wide_f)a, (wide_f)b);
#else
  return a > b ? a : b;
#endif
}
INLINE vd mind(vd a, vd b) { return a < b ? a : b; }
INLINE vd maxd(vd a, vd b) { return a > b ? a : b; }
INLINE vf abs(vf a) { return (vf)((vi)a & 0x7fffffff); }
INLINE vf where(vi mask, vf value) { return (vf)(mask & (vi)value); }

// One rounding where the ISA has it, two elsewhere; never left to the compiler's choice, so that the backward
// pass repeats exactly the decisions of the forward pass (the units are compiled with -ffp-contract=off).
INLINE vf fma(vf a, vf b, vf c) {
#if ECONGS_LANES == 16 && defined(__AVX512F__)
  return (vf)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#elif ECONGS_LANES == 16 && defined(__FMA__)
  Halves x = {a}, y = {b}, z = {c};
  z.h[0] = _mm256_fmadd_ps(x.h[0], y.h[0], z.h[0]);
  z.h[1] = _mm256_fmadd_ps(x.h[1], y.h[1], z.h[1]);
  return z.v;
#elif ECONGS_LANES == 8 && defined(__FMA__)
  return (vf)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
  return a * b + c;
#endif
}
INLINE vf fma(vf a, float b, vf c) { return fma(a, set(b), c); }

INLINE vf sqrt(vf a) {
#ifdef WIDE
  return (vf)WIDE(sqrt_ps)((wide_f)a);
#else
  for (int l = 0; l < LANES; ++l) a[l] = __builtin_sqrtf(a[l]);
  return a;
#endif
}

INLINE vd sqrtd(vd a) {
#ifdef WIDE
  return (vd)WIDE(sqrt_pd)((wide_d)a);
#else
  for (int l = 0; l < DLANES; ++l) a[l] = __builtin_sqrt(a[l]);
  return a;
#endif
}

// The sign bits of all lanes.
INLINE uint32_t signs(vi a) {
#if ECONGS_LANES == 16 && defined(__AVX512F__)
  return _mm512_cmplt_epi32_mask((__m512i)a, _mm512_setzero_si512());
#elif ECONGS_LANES == 16 && defined(__AVX2__)
  const Halves x = {(vf)a};
  return (uint32_t)_mm256_movemask_ps(x.h[0]) | ((uint32_t)_mm256_movemask_ps(x.h[1]) << 8);
#elif ECONGS_LANES == 8 && defined(__AVX__)
  return (uint32_t)_mm256_movemask_ps((__m256)a);
#elif ECONGS_LANES == 4 && defined(__SSE2__)
  return (uint32_t)_mm_movemask_ps((__m128)a);
#else
  uint32_t bits = 0;
  for (int l = 0; l < LANES; ++l) bits |= ((uint32_t)a[l] >> 31) << l;
  return bits;
#endif
}
constexpr uint32_t ALL_LANES = (1u << LANES) - 1u;

// Lanes 4 i to 4 i + 3.
INLINE v4 quarter(vf a, int i) {
#if ECONGS_LANES == 8 && defined(__AVX__)
  return i ? (v4)_mm256_extractf128_ps((__m256)a, 1) : (v4)_mm256_castps256_ps128((__m256)a);
#elif ECONGS_LANES == 16 && defined(__AVX512F__)
  if (i == 0) return (v4)_mm512_castps512_ps128((__m512)a);
#endif
  const Quarters x = {a};
  return x.q[i];
}

// Sums of groups of four lanes, folded to one 4-vector.
INLINE v4 fold(vf a) {
#if ECONGS_LANES == 16 && defined(__AVX512F__)
  const __m256 h = _mm256_add_ps(_mm512_castps512_ps256((__m512)a),
                                 _mm256_castpd_ps(_mm512_extractf64x4_pd(_mm512_castps_pd((__m512)a), 1)));
  return (v4)_mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps(h, 1));
#elif ECONGS_LANES == 8 && defined(__AVX__)
  return (v4)_mm_add_ps(_mm256_castps256_ps128((__m256)a), _mm256_extractf128_ps((__m256)a, 1));
#else
  const Quarters x = {a};
#if ECONGS_LANES == 16
  return (x.q[0] + x.q[2]) + (x.q[1] + x.q[3]);
#elif ECONGS_LANES == 8
  return x.q[0] + x.q[1];
#else
  return x.q[0];
#endif
#endif
}

INLINE v4 shuffle(v4 a, v4 b, int i, int j, int k, int l) {
#if defined(__clang__)
  const v4 all[2] = {a, b};
  const float* p = (const float*)all;
  return v4{p[i], p[j], p[k], p[l]};
#else
  typedef int32_t i4 __attribute__((vector_size(16)));
  return __builtin_shuffle(a, b, i4{i, j, k, l});
#endif
}

// The lane sums of four vectors, as one 4-vector (a transposition that adds).
INLINE v4 sums(vf a, vf b, vf c, vf d) {
  const v4 p = fold(a), q = fold(b), r = fold(c), s = fold(d);
  const v4 pq = shuffle(p, q, 0, 4, 1, 5) + shuffle(p, q, 2, 6, 3, 7);  // p02 q02 p13 q13
  const v4 rs = shuffle(r, s, 0, 4, 1, 5) + shuffle(r, s, 2, 6, 3, 7);
  return shuffle(pq, rs, 0, 1, 4, 5) + shuffle(pq, rs, 2, 3, 6, 7);
}

struct Square {
  v4 row[4];
};
INLINE Square transposed(v4 a, v4 b, v4 c, v4 d) {
  const v4 ab = shuffle(a, b, 0, 4, 1, 5), cd = shuffle(c, d, 0, 4, 1, 5);
  const v4 AB = shuffle(a, b, 2, 6, 3, 7), CD = shuffle(c, d, 2, 6, 3, 7);
  return {{shuffle(ab, cd, 0, 1, 4, 5), shuffle(ab, cd, 2, 3, 6, 7), shuffle(AB, CD, 0, 1, 4, 5),
           shuffle(AB, CD, 2, 3, 6, 7)}};
}

INLINE float sum(vf a) {
  const v4 q = fold(a);
  return (q[0] + q[2]) + (q[1] + q[3]);
}

// 2^x for -100 < x < 100, relative error 2e-7: rounding by a large constant (this is what -ffast-math would
// delete), a degree-5 near-minimax polynomial on [-1/2, 1/2], the exponent added as an integer.
INLINE vf exp2(vf x) {
  const float magic = 12582912.0f;  // 1.5 * 2^23
  const vf shifted = x + magic;
  const vf f = x - (shifted - magic);
  vf y = fma(set(1.32647260e-3f), f, set(9.67151272e-3f));
  y = fma(y, f, set(5.55073375e-2f));
  y = fma(y, f, set(2.40222421e-1f));
  y = fma(y, f, set(6.93146978e-1f));
  y = fma(y, f, set(1.0f));
  return (vf)((vi)y + ((vi)shifted << 23));
}

// Flush denormals (moments of Gaussians long unseen fade away): each would cost a hundred cycles.
struct Flush {
#if defined(__SSE2__)
  unsigned int before = _mm_getcsr();
  Flush() { _mm_setcsr(before | 0x8040u); }
  ~Flush() { _mm_setcsr(before); }
#else
  Flush() {}
  ~Flush() {}
#endif
};

}  // namespace ECONGS_ISA
