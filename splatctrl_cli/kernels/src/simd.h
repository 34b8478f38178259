// Eight floats at a time, in the compiler's own vector types: AVX2 on x86-64-v3, pairs of SSE or NEON elsewhere.
#pragma once

#include <cstdint>
#include <cstring>

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

inline Float8 min8(Float8 a, Float8 b) { return a < b ? a : b; }
inline Float8 max8(Float8 a, Float8 b) { return a > b ? a : b; }

// Sum of the lanes, in one fixed order.
inline float sum8(Float8 v) { return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7])); }

inline bool any8(Int8 mask) {
  std::int64_t part[4];
  std::memcpy(part, &mask, sizeof part);
  return (part[0] | part[1] | part[2] | part[3]) != 0;
}

// exp(x) for x in [-87, 88], relative error below 2e-7; x below -87 gives exp(-87). Range reduction by ln 2 in two
// parts, then the degree-6 Taylor polynomial on |r| <= ln(2) / 2.
inline Float8 exp8(Float8 x) {
  const Float8 magic = splat8(12582912.0f);  // 1.5 * 2^23: adding it rounds to the nearest integer
  x = max8(x, splat8(-87.0f));
  const Float8 n = (x * 1.44269504088896341f + magic) - magic;
  const Float8 r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
  Float8 p = splat8(1.3888888889e-3f);
  p = p * r + 8.3333333333e-3f;
  p = p * r + 4.1666666667e-2f;
  p = p * r + 1.6666666667e-1f;
  p = p * r + 0.5f;
  p = p * r + 1.0f;
  p = p * r + 1.0f;
  const Int8 exponent = (__builtin_convertvector(n, Int8) + 127) << 23;
  Float8 scale;
  std::memcpy(&scale, &exponent, sizeof scale);
  return p * scale;
}

}  // namespace splatctrl
