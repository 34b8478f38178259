#include "optimiser.h"

#include <algorithm>
#include <cmath>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr float kBeta1 = 0.9f, kBeta2 = 0.999f, kEpsilon = 1e-15f;
constexpr float kGate = 100.0f;        // k of the noise gate
constexpr float kLargestStep = 0.5f;   // of noise, in radii
constexpr float kLargestLogit = 6.9f;  // opacity within [0.001, 0.999]
constexpr int kChunk = 256;

float sigmoid(float x) { return 1.0f / (1.0f + std::exp(-x)); }

// A counter-based generator (SplitMix64 finaliser): the value depends on seed and index alone.
std::uint64_t scramble(std::uint64_t x) {
  x += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

// Standard normal, Box-Muller.
float normal(std::uint64_t seed, std::uint64_t index) {
  const std::uint64_t bits = scramble(seed ^ scramble(index));
  const double u = (static_cast<double>(bits >> 32) + 0.5) * 0x1p-32;
  const double v = static_cast<double>(bits & 0xffffffffu) * 0x1p-32;
  return static_cast<float>(std::sqrt(-2.0 * std::log(u)) * std::cos(6.283185307179586 * v));
}

// The largest radius [m] at a centre: a fixed one, or what covers a fixed number of pixels there.
float largest_radius(const Camera& camera, const float* center, const OptimiserSettings& settings) {
  if (settings.radius_depth <= 0.0f) return settings.max_radius;
  const float depth = to_camera(camera, center).z;
  return std::max(settings.max_radius * depth / settings.radius_depth, settings.min_radius);
}

void step_splat(const SplatState& state, int i, const Camera& camera, const SplatGradient& gradient,
                const OptimiserSettings& settings) {
  float* p = state.parameters + static_cast<std::size_t>(kNumParameters) * i;
  float* m = state.first_moment + static_cast<std::size_t>(kNumParameters) * i;
  float* v = state.second_moment + static_cast<std::size_t>(kNumParameters) * i;
  const float radius = std::exp(p[3]), opacity = sigmoid(p[7]);
  float g[kNumParameters], g_radius;
  project_isotropic_backward(camera, p, radius, gradient.footprint, g, &g_radius);
  g[3] = g_radius * radius;
  for (int c = 0; c < 3; ++c) g[4 + c] = gradient.color[c];
  g[7] = (gradient.footprint.opacity + settings.regulariser) * opacity * (1.0f - opacity);
  const float rates[kNumParameters] = {settings.lr_center, settings.lr_center, settings.lr_center,
                                       settings.lr_log_radius, settings.lr_color, settings.lr_color,
                                       settings.lr_color, settings.lr_logit_opacity};
  const auto t = static_cast<float>(++state.num_steps[i]);
  const float correct1 = 1.0f / (1.0f - std::pow(kBeta1, t)), correct2 = 1.0f / (1.0f - std::pow(kBeta2, t));
  for (int k = 0; k < kNumParameters; ++k) {
    m[k] = kBeta1 * m[k] + (1.0f - kBeta1) * g[k];
    v[k] = kBeta2 * v[k] + (1.0f - kBeta2) * g[k] * g[k];
    p[k] -= rates[k] * (m[k] * correct1) / (std::sqrt(v[k] * correct2) + kEpsilon);
  }
  p[3] = std::clamp(p[3], std::log(settings.min_radius), std::log(largest_radius(camera, p, settings)));
  for (int c = 0; c < 3; ++c) p[4 + c] = std::clamp(p[4 + c], 0.0f, 1.0f);
  p[7] = std::clamp(p[7], -kLargestLogit, kLargestLogit);
  if (settings.noise <= 0.0f) return;
  // lambda_noise * lr * r^2 * sigmoid(-k (alpha - alpha_min)) * eta, at most half a radius.
  const float r = std::exp(p[3]), alpha = sigmoid(p[7]);
  const float scale =
      settings.noise * settings.lr_center * r * r * sigmoid(-kGate * (alpha - settings.min_opacity));
  if (scale < 1e-9f) return;
  for (int k = 0; k < 3; ++k) {
    const float step = scale * normal(settings.seed, static_cast<std::uint64_t>(3 * i + k));
    p[k] += std::clamp(step, -kLargestStep * r, kLargestStep * r);
  }
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
