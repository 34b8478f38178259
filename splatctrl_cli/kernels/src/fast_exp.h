// exp of floats that compilers vectorise: no table, no call, no branch.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__CUDACC__)
#define HOST_DEVICE __host__ __device__
#else
#define HOST_DEVICE
#endif

namespace splatctrl {

// exp(x), relative error below 3e-7 for x in [-87, 87]; x beyond either end is moved to it, so that the result is a
// positive, finite, normal float for every x that is a number. (e^-87 is 1.6e-38.)
//
// x = n ln 2 + f with |f| <= ln 2 / 2; e^f = 1 + f + f^2 P(f), P of degree 3 fitted for the relative error (1.1e-7).
HOST_DEVICE inline float fast_exp(float x) {
  constexpr float kRoundToInteger = 12582912.0f;  // 1.5 * 2^23: adding it leaves the nearest integer in the low bits
  constexpr float kLog2High = 0.693145751953125f, kLog2Low = 1.42860677e-6f;  // their sum is ln 2
  x = x < -87.0f ? -87.0f : x;
  x = x > 87.0f ? 87.0f : x;
  const float shifted = x * 1.44269504f + kRoundToInteger;
  const float n = shifted - kRoundToInteger;
  const float f = (x - n * kLog2High) - n * kLog2Low;
  const float p = 0.49999229f + f * (0.16667116f + f * (0.04189056f + f * 0.00831246f));
  const float y = 1.0f + (f + f * f * p);
  std::int32_t bits, power;
  std::memcpy(&bits, &y, sizeof bits);
  std::memcpy(&power, &shifted, sizeof power);
  bits += power << 23;  // the low bits of `shifted` are n; what stands above them leaves the word
  float result;
  std::memcpy(&result, &bits, sizeof result);
  return result;
}

}  // namespace splatctrl
