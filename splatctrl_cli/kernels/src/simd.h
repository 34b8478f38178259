// Eight floats at a time, in the compiler's own vector types: AVX2 on x86-64-v3, pairs of SSE or NEON elsewhere.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace splatctrl {

typedef float Float8 __attribute__((vector_size(32), aligned(32)));
typedef std::int32_t Int8 __attribute__((vector_size(32), aligned(32)));

inline Float8 splat8(float value) { return Float8{} + value; }

inline Float8 load8(const float* p) {
  Float8 v;
  std::memcpy(&v, p, sizeof v);
  return v;
}

inline void store8(float* p, Float8 v) { std::memcpy(p, &v, sizeof v); }

// Eight bytes as floats.
inline Float8 load_bytes8(const std::uint8_t* p) {
#if defined(__AVX2__)
  return (Float8)_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(p))));
#else
  Float8 v;
  for (int lane = 0; lane < 8; ++lane) v[lane] = p[lane];
  return v;
#endif
}

#if defined(__AVX__)
inline Float8 min8(Float8 a, Float8 b) { return (Float8)_mm256_min_ps((__m256)a, (__m256)b); }
inline Float8 max8(Float8 a, Float8 b) { return (Float8)_mm256_max_ps((__m256)a, (__m256)b); }
#else
inline Float8 min8(Float8 a, Float8 b) { return a < b ? a : b; }
inline Float8 max8(Float8 a, Float8 b) { return a > b ? a : b; }
#endif

// v where the mask is set, 0 elsewhere.
inline Float8 keep8(Int8 mask, Float8 v) { return (Float8)(mask & (Int8)v); }

inline Float8 sqrt8(Float8 v) {
#if defined(__AVX__)
  return (Float8)_mm256_sqrt_ps((__m256)v);
#else
  Float8 root;
  for (int lane = 0; lane < 8; ++lane) root[lane] = std::sqrt(v[lane]);
  return root;
#endif
}

// The lanes' sign bits, lane 0 lowest.
inline unsigned signs8(Int8 v) {
#if defined(__AVX__)
  return static_cast<unsigned>(_mm256_movemask_ps((__m256)v));
#elif defined(__SSE2__)
  __m128 half[2];
  std::memcpy(half, &v, sizeof half);
  return static_cast<unsigned>(_mm_movemask_ps(half[0]) | _mm_movemask_ps(half[1]) << 4);
#else
  unsigned bits = 0;
  for (int lane = 0; lane < 8; ++lane) bits |= (static_cast<std::uint32_t>(v[lane]) >> 31) << lane;
  return bits;
#endif
}

inline bool any8(Int8 mask) {
  std::int64_t part[4];
  std::memcpy(part, &mask, sizeof part);
  return (part[0] | part[1] | part[2] | part[3]) != 0;
}

// Sum of the lanes, in one fixed order.
inline float sum8(Float8 v) { return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7])); }

// The least of the lanes.
inline float min_of8(Float8 v) {
  const Float8 four = min8(v, __builtin_shufflevector(v, v, 4, 5, 6, 7, 0, 1, 2, 3));
  const Float8 two = min8(four, __builtin_shufflevector(four, four, 2, 3, 0, 1, 6, 7, 4, 5));
  return two[0] < two[1] ? two[0] : two[1];
}

// Lane k is the sum of the lanes of in[k], in one fixed order: a third of the work of eight sum8.
inline Float8 sums8(const Float8 in[8]) {
  Float8 pairs[4], fours[2];  // lanes 0 + 2 and 1 + 3 of two vectors; then of four, lower and upper half apart
  for (int k = 0; k < 4; ++k) {
    const Float8 a = in[2 * k], b = in[2 * k + 1];
    pairs[k] = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13) +
               __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
  }
  for (int k = 0; k < 2; ++k) {
    const Float8 a = pairs[2 * k], b = pairs[2 * k + 1];
    fours[k] = __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13) +
               __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
  }
  return __builtin_shufflevector(fours[0], fours[1], 0, 1, 2, 3, 8, 9, 10, 11) +
         __builtin_shufflevector(fours[0], fours[1], 4, 5, 6, 7, 12, 13, 14, 15);
}

// 2^x for x in [-126, 127], relative error below 3e-7; any value, NaN included, for x outside.
// x = n + f with |f| <= 1/2; 2^f is a polynomial fitted for the relative error (8e-8), by pairs of terms: as many
// operations as Horner's rule and two more, in half the time until the result is there.
inline Float8 exp2_8(Float8 x) {
  const Float8 shifted = x + 12582912.0f;  // 1.5 * 2^23 leaves the nearest integer in the low bits
  const Float8 f = x - (shifted - 12582912.0f);
  const Float8 ff = f * f;
  const Float8 low = 0.6931469440f * f + 1.0000001192f;
  const Float8 middle = 0.0555071309f * f + 0.2402212024f;
  const Float8 high = 0.0013276471f * f + 0.0096755410f;
  const Float8 p = (high * ff + middle) * ff + low;
  return (Float8)((Int8)p + ((Int8)shifted << 23));
}

// log x for positive, normal x, to 2e-7 of 1 or of the result, whichever is larger. x = 2^n m with m in [1/sqrt 2, sqrt 2);
// log m = 2 atanh((m - 1) / (m + 1)), five terms of its series.
inline Float8 log8(Float8 x) {
  const Int8 n = ((Int8)x - 0x3f3504f3) >> 23;
  const Float8 m = (Float8)((Int8)x - (n << 23));
  const Float8 s = (m - 1.0f) / (m + 1.0f), ss = s * s;
  const Float8 series = 2.0f + ss * (0.666666667f + ss * (0.4f + ss * (0.285714286f + ss * 0.222222222f)));
  return __builtin_convertvector(n, Float8) * 0.693147181f + s * series;
}

}  // namespace splatctrl
