// Sums what the tiles say to each splat, in the order of the tiles, and takes the step of splat_step.h.
#pragma once

#include "fit.h"

namespace splatctrl {

constexpr int kStepThreads = 128;
constexpr int kSplatLanes = kNumParameters;  // threads of a splat
static_assert(kNumSums <= 2 * kSplatLanes, "two sums a thread");

// The derivatives by a footprint, and its sums over the tiles of its pixels' moments.
__device__ inline FootprintGradient footprint_gradient(const TileSplat& s, const float (&sums)[kNumSums]) {
  const float a = s.xx * (-2.0f / kLog2E), b = s.xy * (-1.0f / kLog2E), c = s.yy * (-2.0f / kLog2E);
  return {a * sums[1] + b * sums[2], b * sums[1] + c * sums[2], -0.5f * sums[3],    -sums[4],
          -0.5f * sums[5],           sums[9],                   sums[0] / s.opacity};
}

// The sums over the parts of a splat, by one group of kSplatLanes threads, for each of them.
__device__ inline void gather(const float* parts, int first, int count, int lane, float (&sums)[kNumSums]) {
  float2 sum = make_float2(0.0f, 0.0f);
  if (2 * lane < kNumSums) {
    const float2* in = reinterpret_cast<const float2*>(parts + static_cast<std::size_t>(first) * kNumSums) + lane;
#pragma unroll 4
    for (int k = 0; k < count; ++k) {
      const float2 part = in[static_cast<std::size_t>(k) * (kNumSums / 2)];
      sum.x = add(sum.x, part.x);
      sum.y = add(sum.y, part.y);
    }
  }
#pragma unroll
  for (int k = 0; k < kNumSums / 2; ++k) {
    sums[2 * k] = __shfl_sync(kAllLanes, sum.x, k, kSplatLanes);
    sums[2 * k + 1] = __shfl_sync(kAllLanes, sum.y, k, kSplatLanes);
  }
}

__device__ inline float chosen(const float (&values)[kNumParameters], int k) {
  float value = values[0];
#pragma unroll
  for (int j = 1; j < kNumParameters; ++j) value = k == j ? values[j] : value;
  return value;
}

// The terms of the loss of this iteration's view: sums over the patches, in a fixed order. One block of threads.
__device__ inline void sum_terms(const float* patch_ssim, const float* patch_errors, const float* patch_depths,
                                 int num_patches, double* terms) {
  __shared__ double partial[kNumTerms][kStepThreads];
  const int thread = threadIdx.x;
  double sums[kNumTerms] = {};  // l1, SSIM, depth, transmittance, squared
  for (int k = thread; k < num_patches; k += kStepThreads) {
    for (int c = 0; c < 3; ++c) {
      sums[0] += patch_errors[2 * c * num_patches + k];
      sums[1] += patch_ssim[c * num_patches + k];
      sums[4] += patch_errors[(2 * c + 1) * num_patches + k];
    }
    sums[2] += patch_depths[k];
    sums[3] += patch_depths[num_patches + k];
  }
  for (int term = 0; term < kNumTerms; ++term) partial[term][thread] = sums[term];
  for (int step = kStepThreads / 2; step > 0; step /= 2) {
    __syncthreads();
    if (thread >= step) continue;
    for (int term = 0; term < kNumTerms; ++term) partial[term][thread] += partial[term][thread + step];
  }
  __syncthreads();
  if (thread < kNumTerms) terms[thread] = partial[thread][0];
}

// Steps parameters, first_moments and second_moments (N, 8), num_steps (N) of the splats that were seen, and the
// iteration; writes gradients (N, 8) where they are wanted, and then changes nothing else. The first block writes the
// sums of the loss, terms (views, kNumTerms).
extern "C" __global__ void __launch_bounds__(kStepThreads)
    step(Counters* counters, const int* schedule, const View* views, const Run* run, const TileSplat* splats,
         const int* first_parts, const int* num_parts, const float* parts, float* parameters, float* first_moments,
         float* second_moments, std::uint32_t* num_steps, int num_splats, const float* patch_ssim,
         const float* patch_errors, const float* patch_depths, int num_patches, double* terms, float* gradients) {
  const int iteration = counters->now, which = schedule[iteration];
  if (blockIdx.x == 0) {
    sum_terms(patch_ssim, patch_errors, patch_depths, num_patches, terms + which * kNumTerms);
    if (threadIdx.x == 0) counters->next = iteration + 1;
    return;
  }
  const int lane = threadIdx.x % kSplatLanes, i = ((blockIdx.x - 1) * kStepThreads + threadIdx.x) / kSplatLanes;
  const bool is_splat = i < num_splats;
  const int count = is_splat ? num_parts[i] : 0;
  float sums[kNumSums];
  gather(parts, count > 0 ? first_parts[i] : 0, count, lane, sums);
  const std::size_t at = static_cast<std::size_t>(kNumParameters) * (is_splat ? i : 0) + lane;
  const bool is_seen = count > 0;
  float value = parameters[at];
  float p[kNumParameters], g[kNumParameters];
#pragma unroll
  for (int k = 0; k < kNumParameters; ++k) p[k] = __shfl_sync(kAllLanes, value, k, kSplatLanes);
  OptimiserSettings settings = run->settings;
  settings.seed += static_cast<std::uint64_t>(iteration);
  const Camera& camera = views[which].camera;
  std::uint32_t steps = 0;
  if (is_seen) {
    const FootprintGradient footprint = footprint_gradient(splats[i], sums);
    parameter_gradient(camera, p, footprint, sums + 6, settings, g);
    steps = num_steps[i] + 1;
    float m = first_moments[at], v = second_moments[at];
    const float gradient = chosen(g, lane);
    if (gradients != nullptr) {
      gradients[at] = gradient;
    } else {
      adam(learning_rate(settings, lane), bias_correction(steps), gradient, &value, &m, &v);
      first_moments[at] = m;
      second_moments[at] = v;
    }
  } else if (is_splat && gradients != nullptr) {
    gradients[at] = 0.0f;
  }
#pragma unroll
  for (int k = 0; k < kNumParameters; ++k) p[k] = __shfl_sync(kAllLanes, value, k, kSplatLanes);
  if (!is_seen || gradients != nullptr) return;
  limit(camera, settings, p);
  add_noise(settings, i, p);
  parameters[at] = chosen(p, lane);
  if (lane == 0) num_steps[i] = steps;
}

}  // namespace splatctrl
