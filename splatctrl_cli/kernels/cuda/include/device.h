// What the kernels take from CUDA beyond the language.
#pragma once

#include <cstdint>

constexpr unsigned kAllLanes = 0xffffffffu;

// 2^x, relative error below 2e-7 for x in [-126, 127].
__device__ inline float exp2_fast(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// Relative errors below 2e-7 and 3e-7.
__device__ inline float sqrt_fast(float x) {
  float y;
  asm("sqrt.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ inline float inverse_root_fast(float x) {
  float y;
  asm("rsqrt.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

__device__ inline float not_a_number() { return __int_as_float(0x7fc00000); }
