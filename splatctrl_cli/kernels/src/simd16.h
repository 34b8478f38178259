// Sixteen floats at a time: one register with AVX-512, two Float8 elsewhere. Every operation rounds alike on both, and
// products are added by fma16 alone (built with -ffp-contract=off), so that results do not depend on the register.
#pragma once

#include "simd.h"

namespace splatctrl {

#if defined(__AVX512F__)

typedef float Float16 __attribute__((vector_size(64), aligned(64)));
typedef __mmask16 Mask16;  // a bit for each lane

inline Float16 splat16(float value) { return (Float16)_mm512_set1_ps(value); }
inline Float16 fma16(Float16 a, Float16 b, Float16 c) {
  return (Float16)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
}
inline Float16 fnma16(Float16 a, Float16 b, Float16 c) {
  return (Float16)_mm512_fnmadd_ps((__m512)a, (__m512)b, (__m512)c);
}
inline Float16 min16(Float16 a, Float16 b) { return (Float16)_mm512_min_ps((__m512)a, (__m512)b); }
inline Mask16 less16(Float16 a, Float16 b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ); }
inline Mask16 at_least16(Float16 a, Float16 b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
inline Mask16 negative16(Float16 v) { return _mm512_movepi32_mask((__m512i)v); }
inline Mask16 not16(Mask16 mask) { return static_cast<Mask16>(~mask); }
inline unsigned bits16(Mask16 mask) { return mask; }
inline Float16 keep16(Mask16 mask, Float16 v) { return (Float16)_mm512_maskz_mov_ps(mask, (__m512)v); }
inline Float16 select16(Mask16 mask, Float16 a, Float16 b) {
  return (Float16)_mm512_mask_mov_ps((__m512)b, mask, (__m512)a);
}
inline Float16 abs16(Float16 v) { return (Float16)_mm512_abs_ps((__m512)v); }
inline Float16 negate_abs16(Float16 v) {
  return (Float16)_mm512_or_ps((__m512)v, _mm512_set1_ps(-0.0f));
}
// p times 2 to the power n, given as 1.5 * 2^23 + n.
inline Float16 scale16(Float16 p, Float16 shifted) {
  typedef std::int32_t Int16 __attribute__((vector_size(64)));
  return (Float16)((Int16)p + ((Int16)shifted << 23));
}
// Sixteen floats from p + shift on, which need not be aligned; p is, and p - 16 and p + 31 can be read.
template <int shift>
inline Float16 shifted16(const float* p) {
  const __m512i here = _mm512_load_si512(p);
  if constexpr (shift == 0) return (Float16)here;
  if constexpr (shift > 0) return (Float16)_mm512_alignr_epi32(_mm512_load_si512(p + 16), here, shift);
  return (Float16)_mm512_alignr_epi32(here, _mm512_load_si512(p - 16), (16 + shift) & 15);
}
inline Float16 load16(const float* p) { return (Float16)_mm512_loadu_ps(p); }
inline void store16(float* p, Float16 v) { _mm512_storeu_ps(p, (__m512)v); }
inline Float16 join16(Float8 low, Float8 high) {
  return (Float16)_mm512_insertf32x8(_mm512_castps256_ps512((__m256)low), (__m256)high, 1);
}
inline Float8 low8(Float16 v) { return (Float8)_mm512_castps512_ps256((__m512)v); }
inline Float8 high8(Float16 v) { return (Float8)_mm512_extractf32x8_ps((__m512)v, 1); }

#else

struct Float16 {
  Float8 low, high;

  // Copied by halves: compilers copy a plain struct in smaller pieces, and a whole read after that has to wait.
  Float16() = default;
  Float16(Float8 l, Float8 h) : low(l), high(h) {}
  Float16(const Float16& b) : low(b.low), high(b.high) {}
  Float16& operator=(const Float16& b) {
    low = b.low;
    high = b.high;
    return *this;
  }
  Float16& operator+=(const Float16& b) { return *this = {low + b.low, high + b.high}; }
  Float16& operator-=(const Float16& b) { return *this = {low - b.low, high - b.high}; }
};
struct Mask16 {
  Int8 low, high;

  Mask16 operator&(const Mask16& b) const { return {low & b.low, high & b.high}; }
};

inline Float16 splat16(float value) { return {splat8(value), splat8(value)}; }
inline Float16 operator+(const Float16& a, const Float16& b) { return {a.low + b.low, a.high + b.high}; }
inline Float16 operator-(const Float16& a, const Float16& b) { return {a.low - b.low, a.high - b.high}; }
inline Float16 operator*(const Float16& a, const Float16& b) { return {a.low * b.low, a.high * b.high}; }
inline Float16 operator/(const Float16& a, const Float16& b) { return {a.low / b.low, a.high / b.high}; }
inline Float16 operator+(const Float16& a, float b) { return {a.low + b, a.high + b}; }
inline Float16 operator-(const Float16& a, float b) { return {a.low - b, a.high - b}; }
inline Float16 operator*(const Float16& a, float b) { return {a.low * b, a.high * b}; }
inline Float16 operator-(float a, const Float16& b) { return {a - b.low, a - b.high}; }
inline Float16 operator/(float a, const Float16& b) { return {a / b.low, a / b.high}; }

inline Float8 fma8(Float8 a, Float8 b, Float8 c) {
#if defined(__FMA__)
  return (Float8)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
  return a * b + c;
#endif
}
inline Float8 fnma8(Float8 a, Float8 b, Float8 c) {
#if defined(__FMA__)
  return (Float8)_mm256_fnmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
  return c - a * b;
#endif
}
inline Float16 fma16(const Float16& a, const Float16& b, const Float16& c) {
  return {fma8(a.low, b.low, c.low), fma8(a.high, b.high, c.high)};
}
inline Float16 fnma16(const Float16& a, const Float16& b, const Float16& c) {
  return {fnma8(a.low, b.low, c.low), fnma8(a.high, b.high, c.high)};
}
inline Float16 min16(const Float16& a, const Float16& b) { return {min8(a.low, b.low), min8(a.high, b.high)}; }
inline Mask16 less16(const Float16& a, const Float16& b) { return {a.low < b.low, a.high < b.high}; }
inline Mask16 at_least16(const Float16& a, const Float16& b) { return {a.low >= b.low, a.high >= b.high}; }
inline Mask16 negative16(const Float16& v) { return {(Int8)v.low >> 31, (Int8)v.high >> 31}; }
inline Mask16 not16(const Mask16& mask) { return {~mask.low, ~mask.high}; }
inline unsigned bits16(const Mask16& mask) { return signs8(mask.low) | signs8(mask.high) << 8; }
inline Float16 keep16(const Mask16& mask, const Float16& v) {
  return {keep8(mask.low, v.low), keep8(mask.high, v.high)};
}
inline Float16 select16(const Mask16& mask, const Float16& a, const Float16& b) {
  return {mask.low ? a.low : b.low, mask.high ? a.high : b.high};
}
inline Float16 abs16(const Float16& v) {
  return {(Float8)((Int8)v.low & INT32_MAX), (Float8)((Int8)v.high & INT32_MAX)};
}
inline Float16 negate_abs16(const Float16& v) {
  return {(Float8)((Int8)v.low | INT32_MIN), (Float8)((Int8)v.high | INT32_MIN)};
}
// p times 2 to the power n, given as 1.5 * 2^23 + n.
inline Float16 scale16(const Float16& p, const Float16& shifted) {
  return {(Float8)((Int8)p.low + ((Int8)shifted.low << 23)), (Float8)((Int8)p.high + ((Int8)shifted.high << 23))};
}
// Sixteen floats from p + shift on, which need not be aligned; p is, and p - 16 and p + 31 can be read.
template <int shift>
inline Float16 shifted16(const float* p) {
  return {load8(p + shift), load8(p + shift + 8)};
}
inline Float16 load16(const float* p) { return {load8(p), load8(p + 8)}; }
inline void store16(float* p, const Float16& v) {
  store8(p, v.low);
  store8(p + 8, v.high);
}
inline Float16 join16(Float8 low, Float8 high) { return {low, high}; }
inline Float8 low8(const Float16& v) { return v.low; }
inline Float8 high8(const Float16& v) { return v.high; }

#endif

inline Float16 fma16(Float16 a, float b, Float16 c) { return fma16(a, splat16(b), c); }
inline Float16 fma16(Float16 a, float b, float c) { return fma16(a, splat16(b), splat16(c)); }

// The lanes k and k + 8 added.
inline Float8 fold16(Float16 v) { return low8(v) + high8(v); }
// Sum of the lanes, in one fixed order.
inline float sum16(Float16 v) { return sum8(fold16(v)); }

// 2^x for x in [-126, 127], as exp2_8.
inline Float16 exp2_16(Float16 x) {
  const Float16 shifted = x + 12582912.0f;
  const Float16 f = x - (shifted - 12582912.0f);
  const Float16 ff = f * f;
  const Float16 low = fma16(f, 0.6931469440f, 1.0000001192f);
  const Float16 middle = fma16(f, 0.0555071309f, 0.2402212024f);
  const Float16 high = fma16(f, 0.0013276471f, 0.0096755410f);
  return scale16(fma16(fma16(high, ff, middle), ff, low), shifted);
}

}  // namespace splatctrl
