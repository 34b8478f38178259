// The image part of eq. 4 and its derivative: L1 and D-SSIM on colour, L1 on depth. As in loss.cpp, SSIM is that of the
// sum s and the difference d of the two images, so that four moments do.
#pragma once

#include "fit.h"

namespace splatctrl {

constexpr int kPatch = 32, kPatchThreads = 128;       // a block's share of one channel: 32 x 32 pixels
constexpr int kWide = kPatch + 2 * kHalfWindow;       // with what the window adds around it
constexpr int kPitch = kWide + 1;                     // of rows in shared memory: columns fall into different banks
constexpr int kLoadRows = kPatchThreads / kWide;      // of a patch with its surroundings, loaded at once
constexpr int kRun = 8;                               // pixels of a line that a thread takes
constexpr int kAtOnce = 7;                            // blocks of threads on a multiprocessor, as kBlocksAtOnce
constexpr int kNumTerms = 5;                          // of the loss, as in LossTerms

// Sum and difference of the rendered colour, on its background, and the target's.
struct Pair {
  float sum, difference;
};

// level / 255, correctly rounded for 0 to 255.
__device__ inline float share_of_255(std::uint8_t level) {
  const auto x = static_cast<float>(level);
  const float quotient = mul(x, 1.0f / 255.0f);
  return fma(fma(-quotient, 255.0f, x), 1.0f / 255.0f, quotient);
}

__device__ inline Pair pair_at(const View& view, const float* planes, float background, int channel, std::size_t plane,
                               std::size_t at) {
  const float target = share_of_255(view.color[channel * plane + at]);
  const float rendered = fma(1.0f - planes[4 * plane + at], background, planes[channel * plane + at]);
  const float difference = view.counted[at] != 0 ? rendered - target : 0.0f;
  return {target + target + difference, difference};
}

// Sums with the window over kRun neighbours of a line: out[k] = sum_j weight[|j|] in[k + j + kHalfWindow].
template <int kRun>
__device__ inline void window_sums(const float (&in)[kRun + 2 * kHalfWindow], float (&out)[kRun]) {
  constexpr Window window;
#pragma unroll
  for (int k = 0; k < kRun; ++k) {
    const int center = k + kHalfWindow;
    float sum = mul(in[center], window.weight[0]);
#pragma unroll
    for (int j = 1; j <= kHalfWindow; ++j) sum = fma(add(in[center - j], in[center + j]), window.weight[j], sum);
    out[k] = sum;
  }
}

// Sum over a block of threads, in a fixed order; for thread 0.
__device__ inline float block_sum(float x, float* shared, int thread) {
  const float sum = warp_sums<1>({x}, thread % 32);
  __syncthreads();
  if (thread % 32 == 0) shared[thread / 32] = sum;
  __syncthreads();
  float total = 0.0f;
  if (thread == 0) {
    for (int k = 0; k < kPatchThreads / 32; ++k) total = add(total, shared[k]);
  }
  return total;
}

// SSIM's derivatives at one pixel by the mean (of s and d together) and by the second moments of s and d; returns SSIM.
//
// With S = mean(s)^2, D = mean(d)^2 and the variances V, W of s and d:
// SSIM = ((S - D) / 2 + C1) ((V - W) / 2 + C2) / (((S + D) / 2 + C1) ((V + W) / 2 + C2)).
__device__ inline float ssim(float mean_s, float mean_d, float square_s, float square_d, float (&derivative)[3]) {
  const float S = mul(mean_s, mean_s), D = mul(mean_d, mean_d), V = square_s - S, W = square_d - D;
  const float n1 = 0.5f * (S - D) + kC1, n2 = 0.5f * (V - W) + kC2;
  const float m1 = 0.5f * (S + D) + kC1, m2 = 0.5f * (V + W) + kC2;
  const float inverse = __fdividef(1.0f, m1 * m2), value = n1 * n2 * inverse;
  const float half1 = 0.5f * m2 * inverse, half2 = 0.5f * m1 * inverse;  // 1 / (2 m1), 1 / (2 m2)
  const float by_n1 = 0.5f * n2 * inverse, by_n2 = 0.5f * n1 * inverse;
  const float by_V = by_n2 - value * half2, by_W = -by_n2 - value * half2;
  const float by_S = by_n1 - value * half1 - by_V, by_D = -by_n1 - value * half1 - by_W;
  derivative[0] = 2.0f * (mean_s * by_S + mean_d * by_D);
  derivative[1] = by_V;
  derivative[2] = by_W;
  return value;
}

// Four neighbours in a row, of which those in the image are written.
__device__ inline void write_four(float* row, int x, int width, const float* values) {
  if (x + 3 < width && width % 4 == 0) {
    *reinterpret_cast<float4*>(row + x) = make_float4(values[0], values[1], values[2], values[3]);
    return;
  }
  for (int k = 0; k < 4; ++k) {
    if (x + k < width) row[x + k] = values[k];
  }
}

// Writes maps (3 channels, 3, H, W), the derivatives of SSIM, and its sum over each patch (3, patches). The grid is
// patches across, patches down, channels.
extern "C" __global__ void __launch_bounds__(kPatchThreads, kAtOnce)
    ssim_derivatives(const Counters* counters, const int* schedule, const View* views, const Run* run,
                     const float* planes, int width, int height, float* maps, float* patch_ssim) {
  __shared__ float images[2][kWide][kPitch];    // s and d
  __shared__ float moments[2][kPatch][kPitch];  // of one of them and its square, summed along the columns
  __shared__ float warp_totals[kPatchThreads / 32];
  const View& view = views[schedule[counters->now]];
  const int thread = threadIdx.x, channel = blockIdx.z, x0 = blockIdx.x * kPatch, y0 = blockIdx.y * kPatch;
  const std::size_t plane = static_cast<std::size_t>(width) * height;
  const float background = run->weights.background[channel];
  if (thread < kLoadRows * kWide) {
    const int column = thread % kWide, x = x0 + column - kHalfWindow;
    for (int row = thread / kWide; row < kWide; row += kLoadRows) {
      const int y = y0 + row - kHalfWindow;
      Pair pair{0.0f, 0.0f};
      if (x >= 0 && y >= 0 && x < width && y < height) {
        pair = pair_at(view, planes, background, channel, plane, static_cast<std::size_t>(y) * width + x);
      }
      images[0][row][column] = pair.sum;
      images[1][row][column] = pair.difference;
    }
  }
  __syncthreads();
  const int row = thread / (kPatch / kRun), column = thread % (kPatch / kRun) * kRun;  // of kRun pixels
  float sums[4][kRun];  // of s, s^2, d, d^2
#pragma unroll
  for (int image = 0; image < 2; ++image) {
    float line[kRun + 2 * kHalfWindow], sum[kRun];
    for (int k = thread; k < kWide * (kPatch / kRun); k += kPatchThreads) {
      const int below = k % kWide, first = k / kWide * kRun;
#pragma unroll
      for (int j = 0; j < kRun + 2 * kHalfWindow; ++j) line[j] = images[image][first + j][below];
      window_sums<kRun>(line, sum);
#pragma unroll
      for (int j = 0; j < kRun; ++j) moments[0][first + j][below] = sum[j];
#pragma unroll
      for (int j = 0; j < kRun + 2 * kHalfWindow; ++j) line[j] = mul(line[j], line[j]);
      window_sums<kRun>(line, sum);
#pragma unroll
      for (int j = 0; j < kRun; ++j) moments[1][first + j][below] = sum[j];
    }
    __syncthreads();
#pragma unroll
    for (int power = 0; power < 2; ++power) {
#pragma unroll
      for (int j = 0; j < kRun + 2 * kHalfWindow; ++j) line[j] = moments[power][row][column + j];
      window_sums<kRun>(line, sums[2 * image + power]);
    }
    __syncthreads();
  }
  float total = 0.0f;
  const int y = y0 + row;
#pragma unroll
  for (int j = 0; j < kRun; ++j) {
    float derivative[3];
    const float value = ssim(sums[0][j], sums[2][j], sums[1][j], sums[3][j], derivative);
    if (x0 + column + j < width && y < height) total = add(total, value);
    for (int map = 0; map < 3; ++map) sums[map][j] = derivative[map];
  }
  if (y < height) {
#pragma unroll
    for (int map = 0; map < 3; ++map) {
      float* out = maps + (3 * channel + map) * plane + static_cast<std::size_t>(y) * width;
      for (int j = 0; j < kRun; j += 4) write_four(out, x0 + column + j, width, sums[map] + j);
    }
  }
  total = block_sum(total, warp_totals, thread);
  if (thread == 0) patch_ssim[(channel * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x] = total;
}

__device__ inline float sign_of(float x) { return static_cast<float>((x > 0.0f) - (x < 0.0f)); }

// The depth loss of a pixel: derivatives by depth and opacity, |error| and transmittance.
struct DepthGradient {
  float by_depth, by_opacity, error, transmittance;
};

__device__ inline DepthGradient depth_gradient(const View& view, const LossWeights& weights, float rendered,
                                               float opacity, std::size_t at) {
  const float target = view.depth[at];
  if (!(target > 0.0f) || view.counted[at] == 0) return {0.0f, 0.0f, 0.0f, 0.0f};
  const bool divides = weights.normalised && opacity > kOpaqueEnough;
  const float inverse = divides ? 1.0f / opacity : 1.0f;
  const float error = rendered * inverse - target;
  const float sign = weights.depth * view.per_depth * sign_of(error);
  const float through_opacity = divides ? sign * rendered * inverse * inverse : 0.0f;
  return {sign * inverse, -weights.opacity * view.per_depth - through_opacity, fabsf(error), 1.0f - opacity};
}

// Writes plane_gradients (5, H, W), of which that by opacity lacks what the background adds, and each patch's sums of
// |d|, d^2 (3, 2, patches), |depth error| and transmittance (2, patches). The grid is that of ssim_derivatives.
extern "C" __global__ void __launch_bounds__(kPatchThreads, kAtOnce)
    loss_gradient(const Counters* counters, const int* schedule, const View* views, const Run* run,
                  const float* planes, const float* maps, int width, int height, float* plane_gradients,
                  float* patch_errors, float* patch_depths) {
  __shared__ float maps_around[3][kWide][kPitch];
  __shared__ float across[kWide][kPatch + 1];  // one of them, summed along the rows
  __shared__ float warp_totals[kPatchThreads / 32];
  const View& view = views[schedule[counters->now]];
  const LossWeights& weights = run->weights;
  const int thread = threadIdx.x, channel = blockIdx.z, x0 = blockIdx.x * kPatch, y0 = blockIdx.y * kPatch;
  const std::size_t plane = static_cast<std::size_t>(width) * height;
  if (thread < kLoadRows * kWide) {
    const int column = thread % kWide, x = x0 + column - kHalfWindow;
    for (int row = thread / kWide; row < kWide; row += kLoadRows) {
      const int y = y0 + row - kHalfWindow;
      const bool is_inside = x >= 0 && y >= 0 && x < width && y < height;
      const float* in = maps + 3 * channel * plane + (is_inside ? static_cast<std::size_t>(y) * width + x : 0);
#pragma unroll
      for (int map = 0; map < 3; ++map) maps_around[map][row][column] = is_inside ? in[map * plane] : 0.0f;
    }
  }
  __syncthreads();
  const int column = thread % kPatch, row = thread / kPatch * kRun;  // of kRun pixels, one below the other
  float sums[3][kRun];
#pragma unroll
  for (int map = 0; map < 3; ++map) {
    float line[kRun + 2 * kHalfWindow], sum[kRun];
    for (int k = thread; k < kWide * (kPatch / kRun); k += kPatchThreads) {
      const int beside = k % kWide, first = k / kWide * kRun;
#pragma unroll
      for (int j = 0; j < kRun + 2 * kHalfWindow; ++j) line[j] = maps_around[map][beside][first + j];
      window_sums<kRun>(line, sum);
#pragma unroll
      for (int j = 0; j < kRun; ++j) across[beside][first + j] = sum[j];
    }
    __syncthreads();
#pragma unroll
    for (int j = 0; j < kRun + 2 * kHalfWindow; ++j) line[j] = across[row + j][column];
    window_sums<kRun>(line, sums[map]);
    __syncthreads();
  }
  const float weight_l1 = weights.color * (1.0f - weights.dssim) * view.per_value;
  const float weight_ssim = weights.color * weights.dssim * view.per_value;
  float l1 = 0.0f, squared = 0.0f, error = 0.0f, transmittance = 0.0f;
#pragma unroll
  for (int j = 0; j < kRun; ++j) {
    const Pixel pixel = pixel_of(x0 + column, y0 + row + j, width, height);
    if (!pixel.is_inside) continue;
    const Pair pair = pair_at(view, planes, weights.background[channel], channel, plane, pixel.at);
    const float by_ssim = sums[0][j] + 2.0f * (pair.sum * sums[1][j] + pair.difference * sums[2][j]);
    const float gradient = weight_l1 * sign_of(pair.difference) - weight_ssim * by_ssim;
    plane_gradients[channel * plane + pixel.at] = view.counted[pixel.at] != 0 ? gradient : 0.0f;
    l1 = add(l1, fabsf(pair.difference));
    squared = fma(pair.difference, pair.difference, squared);
    if (channel != 0) continue;
    const DepthGradient depth =
        depth_gradient(view, weights, planes[3 * plane + pixel.at], planes[4 * plane + pixel.at], pixel.at);
    plane_gradients[3 * plane + pixel.at] = depth.by_depth;
    plane_gradients[4 * plane + pixel.at] = depth.by_opacity;
    error = add(error, depth.error);
    transmittance = add(transmittance, depth.transmittance);
  }
  const int num_patches = gridDim.x * gridDim.y, patch = blockIdx.y * gridDim.x + blockIdx.x;
  l1 = block_sum(l1, warp_totals, thread);
  squared = block_sum(squared, warp_totals, thread);
  error = block_sum(error, warp_totals, thread);
  transmittance = block_sum(transmittance, warp_totals, thread);
  if (thread != 0) return;
  patch_errors[2 * channel * num_patches + patch] = l1;
  patch_errors[(2 * channel + 1) * num_patches + patch] = squared;
  if (channel != 0) return;
  patch_depths[patch] = error;
  patch_depths[num_patches + patch] = transmittance;
}

}  // namespace splatctrl
