// What the kernels of one iteration share, and its arithmetic in one place: each product and sum is written with its
// rounding, so that the backward pass finds the bits of the forward pass again.
//
// Shapes: N splats, (H, W) pixels, K tiles of 16 x 16 pixels.
#pragma once

#include <cstddef>
#include <cstdint>

#include "device.h"
#include "loss_weights.h"
#include "splat_step.h"
#include "tile_splat.h"

namespace splatctrl {

// A camera and what it saw.
struct View {
  Camera camera;
  float per_value, per_depth;    // one over the number of counted colour values and depths; per_depth 0: has none
  const std::uint8_t* color;     // (3, H, W)
  const float* depth;            // (H, W) [m], 0 = none
  const std::uint8_t* counted;   // (H, W), 0 = this pixel is given its target's colour, and has no depth
};

// What stays the same in a run of iterations. The noise of iteration k of the run has seed + k.
struct Run {
  OptimiserSettings settings;
  LossWeights weights;
};

// Written by the device alone in a run. `next` is read by the kernels that project and blend and written by the one
// that steps; `now` is written by the one that blends and read by those after it: nothing is read while it is written.
struct Counters {
  int next, now;    // iteration of the run
  int num_parts;    // pairs of a splat and a tile, of this iteration
  int most_parts;   // where there was no room for them, else 0
  int longest_list; // where a tile had no room for it, else 0
};

// A footprint crosses memory in four pieces, side by side: the compiler's own copy goes byte by byte.
constexpr int kPieces = 4;
static_assert(sizeof(TileSplat) == kPieces * sizeof(float4), "a footprint is four pieces");

__device__ inline float4 piece(const TileSplat& s, int k) {
  if (k == 0) return make_float4(s.u, s.v, s.xx, s.xy);
  if (k == 1) return make_float4(s.yy, s.log2_opacity, s.features[0], s.features[1]);
  if (k == 2) return make_float4(s.features[2], s.features[3], s.slope, s.half2_level);
  return make_float4(s.half2_slope, s.opacity, 0.0f, 0.0f);  // the index is that of its place
}

__device__ inline float4* pieces(TileSplat* splats) { return reinterpret_cast<float4*>(splats); }
__device__ inline const float4* pieces(const TileSplat* splats) { return reinterpret_cast<const float4*>(splats); }

// A footprint on the list of a tile, and where its gradient there goes.
struct Entry {
  std::uint32_t splat_and_blocks;  // 24 bits, and one for each block of the tile that it was blended on
  std::uint32_t part;
};
constexpr int kSplatBits = 24;
constexpr std::uint32_t kSplatMask = (1u << kSplatBits) - 1u;

// A warp's share of a tile: 8 x 4 pixels. Block b begins at column 8 (b / 4), row 4 (b % 4).
constexpr int kBlockWidth = 8, kBlockHeight = 4, kNumBands = kTileHeight / kBlockHeight, kNumBlocks = 8;

// Sums over the pixels of a tile, or of all: of the derivative h of the loss by ln(alpha G) times 1, dx, dy, dx^2,
// dx dy, dy^2; of the weights times the derivatives by red, green, blue and depth.
constexpr int kNumSums = 10;

__device__ inline float fma(float a, float b, float c) { return __fmaf_rn(a, b, c); }
__device__ inline float mul(float a, float b) { return __fmul_rn(a, b); }
__device__ inline float add(float a, float b) { return __fadd_rn(a, b); }

// log2 of alpha G at a pixel that lies (dx, dy) from the mean.
__device__ inline float log2_alpha(const TileSplat& s, float dx, float dy) {
  return fma(mul(dx, s.xy), dy, add(fma(mul(dx, dx), s.xx, s.log2_opacity), mul(mul(dy, dy), s.yy)));
}

__device__ inline float alpha_of(float power) {
  return power >= kLog2MinAlpha ? exp2_fast(std::min(power, kLog2MaxAlpha)) : 0.0f;
}

// The weight alpha T of a splat on a pixel. Where the light is used up, now or before, it and alpha become 0, and T
// negative; else T becomes what is left behind the splat.
__device__ inline float blend(float* alpha, float* transmittance) {
  const float before = *transmittance;
  const float next = fma(-before, *alpha, before);
  const bool ends = next < kMinTransmittance;
  if (ends) *alpha = 0.0f;
  *transmittance = ends ? -fabsf(before) : next;
  return mul(*alpha, before);
}

// The sum over the lanes of a warp of v[lane kCount / 32]: as long as there are several, each step halves what is left
// of v and the lanes that add up the same.
template <int kCount, int kStep = 16>
__device__ inline float warp_sums(const float (&v)[kCount], int lane) {
  if constexpr (kCount == 1) {
    float sum = v[0];
#pragma unroll
    for (int step = kStep; step > 0; step >>= 1) sum = add(sum, __shfl_xor_sync(kAllLanes, sum, step));
    return sum;
  } else {
    constexpr int kHalf = kCount / 2;
    const bool is_upper = lane & kStep;
    float half[kHalf];
#pragma unroll
    for (int k = 0; k < kHalf; ++k) {
      const float keep = is_upper ? v[k + kHalf] : v[k], give = is_upper ? v[k] : v[k + kHalf];
      half[k] = add(keep, __shfl_xor_sync(kAllLanes, give, kStep));
    }
    return warp_sums<kHalf, kStep / 2>(half, lane);
  }
}

// Where a thread's pixel lies.
struct Pixel {
  int x, y;
  bool is_inside;
  std::size_t at;  // in a plane
};

__device__ inline Pixel pixel_of(int x, int y, int width, int height) {
  return {x, y, x < width && y < height, static_cast<std::size_t>(y) * width + x};
}

}  // namespace splatctrl
