#include "optimiser.h"

#include <algorithm>
#include <cmath>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr int kChunk = 256;

void step_splat(const SplatState& state, int i, const Camera& camera, const SplatGradient& gradient,
                const OptimiserSettings& settings) {
  float* p = state.parameters + static_cast<std::size_t>(kNumParameters) * i;
  float* m = state.first_moment + static_cast<std::size_t>(kNumParameters) * i;
  float* v = state.second_moment + static_cast<std::size_t>(kNumParameters) * i;
  float g[kNumParameters];
  parameter_gradient(camera, p, gradient.footprint, gradient.color, settings, g);
  const BiasCorrection correct = bias_correction(++state.num_steps[i]);
  for (int k = 0; k < kNumParameters; ++k) adam(learning_rate(settings, k), correct, g[k], p + k, m + k, v + k);
  limit(camera, settings, p);
  add_noise(settings, i, p);
}

}  // namespace

void optimiser_step(const SplatState& state, const Rasteriser& raster, const SplatGradient* gradients,
                    const OptimiserSettings& settings, int num_threads) {
  parallel_for((state.num_splats + kChunk - 1) / kChunk, num_threads, [&](int chunk) {
    for (int i = chunk * kChunk; i < std::min(state.num_splats, (chunk + 1) * kChunk); ++i) {
      if (raster.visible()[i]) step_splat(state, i, raster.camera(), gradients[i], settings);
    }
  });
}

void unpack_parameters(const float* parameters, int num_splats, float* centers, float* radii, float* colors,
                       float* opacities, int num_threads) {
  parallel_for((num_splats + kChunk - 1) / kChunk, num_threads, [&](int chunk) {
    for (int i = chunk * kChunk; i < std::min(num_splats, (chunk + 1) * kChunk); ++i) {
      const float* p = parameters + static_cast<std::size_t>(kNumParameters) * i;
      std::copy(p, p + 3, centers + 3 * static_cast<std::size_t>(i));
      std::copy(p + 4, p + 7, colors + 3 * static_cast<std::size_t>(i));
      radii[i] = std::exp(p[3]);
      opacities[i] = sigmoid(p[7]);
    }
  });
}

}  // namespace splatctrl
