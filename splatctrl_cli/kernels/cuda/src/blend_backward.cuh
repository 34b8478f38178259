// The derivative of eq. 2 and 3: what the loss on a tile says to each splat on its list.
#pragma once

#include "fit.h"

namespace splatctrl {

constexpr int kBands = 4;  // blocks of a warp, one below the other
constexpr int kBackwardWarps = kNumBlocks / kBands, kBackwardThreads = 32 * kBackwardWarps;
constexpr int kBackwardStage = 32;  // entries that wait in shared memory at a time
constexpr int kTogether = 3;        // entries whose sums over a warp are taken together, a lane a sum
constexpr int kLanePitch = 36;      // of a sum's row of lanes: rows begin in different banks, whole vectors of four
static_assert(kTogether * kNumSums <= 32, "a lane for each sum");

// A thread's pixel in one block: derivatives by its planes, what is left of the light, and of
// sum_i w_i f_i, f_i = c_i . gC + d_i gD + gA: at first the finished pixel, then without what has been blended so far.
struct PixelState {
  float gradient[5], rest, transmittance;
};

__device__ inline PixelState pixel_state(const Pixel& pixel, const LossWeights& weights, const float* planes,
                                         const float* plane_gradients, std::size_t plane) {
  PixelState state{};
  state.transmittance = pixel.is_inside ? 1.0f : -1.0f;
  if (!pixel.is_inside) return state;
  for (int k = 0; k < 5; ++k) state.gradient[k] = plane_gradients[k * plane + pixel.at];
  for (int c = 0; c < 3; ++c) state.gradient[4] = fma(-weights.background[c], state.gradient[c], state.gradient[4]);
  for (int k = 0; k < 5; ++k) state.rest = fma(state.gradient[k], planes[k * plane + pixel.at], state.rest);
  return state;
}

// The sum of one row of lanes, in a fixed order.
__device__ inline float row_sum(const float* row) {
  const float4* in = reinterpret_cast<const float4*>(row);
  float4 sum = in[0];
#pragma unroll
  for (int k = 1; k < 8; ++k) {
    const float4 next = in[k];
    sum = make_float4(add(sum.x, next.x), add(sum.y, next.y), add(sum.z, next.z), add(sum.w, next.w));
  }
  return add(add(sum.x, sum.z), add(sum.y, sum.w));
}

// Writes parts (kNumSums each), one for each splat of each tile. One block of threads a tile.
extern "C" __global__ void __launch_bounds__(kBackwardThreads)
    blend_backward(const Run* run, const TileSplat* splats, const Entry* entries, const int* num_entries,
                   int list_capacity, const float* planes, const float* plane_gradients, int width, int height,
                   float* parts) {
  __shared__ TileSplat stage[kBackwardStage];
  __shared__ Entry stage_entries[kBackwardStage];
  __shared__ float stage_sums[kBackwardWarps][kBackwardStage][kNumSums];
  alignas(16) __shared__ float by_lane[kBackwardWarps][kTogether * kNumSums * kLanePitch];
  const int tile = blockIdx.x, thread = threadIdx.x, warp = thread / 32, lane = thread % 32;
  const int tiles_x = (width + kTileWidth - 1) / kTileWidth;
  const int first_block = warp * kBands;
  const int x = tile % tiles_x * kTileWidth + first_block / kNumBands * kBlockWidth + lane % kBlockWidth;
  const int y0 = tile / tiles_x * kTileHeight + first_block % kNumBands * kBlockHeight + lane / kBlockWidth;
  const std::size_t plane = static_cast<std::size_t>(width) * height;
  const std::size_t list = static_cast<std::size_t>(tile) * list_capacity;
  const int count = num_entries[tile];
  PixelState states[kBands];
#pragma unroll
  for (int band = 0; band < kBands; ++band) {
    const Pixel pixel = pixel_of(x, y0 + band * kBlockHeight, width, height);
    states[band] = pixel_state(pixel, run->weights, planes, plane_gradients, plane);
  }
  for (int first = 0; first < count; first += kBackwardStage) {
    const int num_staged = std::min(kBackwardStage, count - first);
    if (thread < num_staged) stage_entries[thread] = entries[list + first + thread];
    for (int k = thread; k < num_staged * kPieces; k += kBackwardThreads) {
      const std::uint32_t splat = entries[list + first + k / kPieces].splat_and_blocks & kSplatMask;
      pieces(stage)[k] = pieces(splats + splat)[k % kPieces];
    }
    __syncthreads();
    const std::uint32_t mine = lane < num_staged ? stage_entries[lane].splat_and_blocks >> kSplatBits : 0;
    unsigned left = __ballot_sync(kAllLanes, (mine >> first_block & ((1u << kBands) - 1u)) != 0);
    if (lane < num_staged) {
      for (int sum = 0; sum < kNumSums; ++sum) stage_sums[warp][lane][sum] = 0.0f;
    }
    bool is_lit = false;
    for (const PixelState& state : states) is_lit |= state.transmittance > 0.0f;
    if (!__any_sync(kAllLanes, is_lit)) left = 0;
    while (left != 0) {
      int own = 0, num_together = 0;  // the entry of which this lane takes a sum
      for (; num_together < kTogether && left != 0; ++num_together) {
        const int k = __ffs(static_cast<int>(left)) - 1;
        left &= left - 1;
        if (lane / kNumSums == num_together) own = k;
        const std::uint32_t blocks = stage_entries[k].splat_and_blocks >> (kSplatBits + first_block);
        const TileSplat& s = stage[k];
        const float dx = static_cast<float>(x) - s.u;
        float h_1 = 0.0f, h_y = 0.0f, h_yy = 0.0f, by_feature[4] = {};  // dx is the same in all of a thread's pixels
#pragma unroll
        for (int band = 0; band < kBands; ++band) {
          if (!(blocks >> band & 1u)) continue;
          PixelState& state = states[band];
          const float dy = static_cast<float>(y0 + band * kBlockHeight) - s.v;
          const float power = log2_alpha(s, dx, dy);
          float alpha = alpha_of(power);
          const float weight = blend(&alpha, &state.transmittance);
          float value = state.gradient[4];
          for (int c = 0; c < 4; ++c) value = fma(state.gradient[c], s.features[c], value);
          state.rest = fma(-weight, value, state.rest);
          // dL/dalpha = T f - rest / (1 - alpha): front to back again, and no division by a vanishing transmittance.
          const float h = power < kLog2MaxAlpha
                              ? fma(weight, value, -mul(state.rest, __fdividef(alpha, 1.0f - alpha)))
                              : 0.0f;
          h_1 = add(h_1, h);
          h_y = fma(h, dy, h_y);
          h_yy = fma(mul(h, dy), dy, h_yy);
          for (int c = 0; c < 4; ++c) by_feature[c] = fma(weight, state.gradient[c], by_feature[c]);
      }
      const float h_x = mul(h_1, dx);
      const float sums[kNumSums] = {h_1,           h_x,           h_y, mul(h_x, dx), mul(h_y, dx), h_yy,
                                    by_feature[0], by_feature[1], by_feature[2], by_feature[3]};
      float* out = by_lane[warp] + num_together * kNumSums * kLanePitch + lane;
#pragma unroll
      for (int sum = 0; sum < kNumSums; ++sum) out[sum * kLanePitch] = sums[sum];
      }
      __syncwarp();
      if (lane < num_together * kNumSums) {
        stage_sums[warp][own][lane % kNumSums] = row_sum(by_lane[warp] + lane * kLanePitch);
      }
      __syncwarp();
    }
    __syncthreads();
    for (int k = thread; k < num_staged * kNumSums; k += kBackwardThreads) {
      const int entry = k / kNumSums, sum = k % kNumSums;
      float total = stage_sums[0][entry][sum];
      for (int other = 1; other < kBackwardWarps; ++other) total = add(total, stage_sums[other][entry][sum]);
      parts[static_cast<std::size_t>(stage_entries[entry].part) * kNumSums + sum] = total;
    }
    __syncthreads();
  }
}

}  // namespace splatctrl
