// One step of one splat: chain rule to its parameters, Adam, limits, and the noise of 3DGS-MCMC. For host and device.
//
// Parameters are centre (3) [m], log radius, colour (3), logit opacity.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "projection.h"

namespace splatctrl {

constexpr int kNumParameters = 8;
constexpr float kBeta1 = 0.9f, kBeta2 = 0.999f, kEpsilon = 1e-15f;
constexpr float kGate = 100.0f;        // k of the noise gate
constexpr float kLargestStep = 0.5f;   // of noise, in radii
constexpr float kLargestLogit = 6.9f;  // opacity within [0.001, 0.999]

struct OptimiserSettings {
  float lr_center, lr_log_radius, lr_color, lr_logit_opacity;
  float regulariser;        // lambda_reg / N: the derivative of lambda_reg * mean |alpha|
  float noise;              // lambda_noise
  float min_opacity;        // centre of the noise gate
  float min_radius, max_radius;  // [m]
  float radius_depth;       // [m] at which a splat may be max_radius large, and in proportion elsewhere; 0: everywhere
  std::uint64_t seed;       // of this step's noise
};

SPLATCTRL_HOST_DEVICE inline float sigmoid(float x) { return 1.0f / (1.0f + std::exp(-x)); }

// A counter-based generator (SplitMix64 finaliser): the value depends on seed and index alone.
SPLATCTRL_HOST_DEVICE inline std::uint64_t scramble(std::uint64_t x) {
  x += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

// Standard normal, Box-Muller.
SPLATCTRL_HOST_DEVICE inline float normal(std::uint64_t seed, std::uint64_t index) {
  const std::uint64_t bits = scramble(seed ^ scramble(index));
  const double u = (static_cast<double>(bits >> 32) + 0.5) * 0x1p-32;
  const double v = static_cast<double>(bits & 0xffffffffu) * 0x1p-32;
  return static_cast<float>(std::sqrt(-2.0 * std::log(u)) * std::cos(6.283185307179586 * v));
}

// The largest radius [m] at a centre: a fixed one, or what covers a fixed number of pixels there.
SPLATCTRL_HOST_DEVICE inline float largest_radius(const Camera& camera, const float* center,
                                                  const OptimiserSettings& settings) {
  if (settings.radius_depth <= 0.0f) return settings.max_radius;
  const float depth = to_camera(camera, center).z;
  return std::max(settings.max_radius * depth / settings.radius_depth, settings.min_radius);
}

// The derivatives by a splat's parameters p from those by its footprint and colour, the regulariser's included.
SPLATCTRL_HOST_DEVICE inline void parameter_gradient(const Camera& camera, const float* p,
                                                     const FootprintGradient& footprint, const float* color,
                                                     const OptimiserSettings& settings, float* g) {
  const float radius = std::exp(p[3]), opacity = sigmoid(p[7]);
  float g_radius;
  project_isotropic_backward(camera, p, radius, footprint, g, &g_radius);
  g[3] = g_radius * radius;
  for (int c = 0; c < 3; ++c) g[4 + c] = color[c];
  g[7] = (footprint.opacity + settings.regulariser) * opacity * (1.0f - opacity);
}

// One over 1 - beta^t of Adam's two moments at step t.
struct BiasCorrection {
  float first, second;
};

SPLATCTRL_HOST_DEVICE inline BiasCorrection bias_correction(std::uint32_t num_steps) {
  const auto t = static_cast<float>(num_steps);
  return {1.0f / (1.0f - std::pow(kBeta1, t)), 1.0f / (1.0f - std::pow(kBeta2, t))};
}

SPLATCTRL_HOST_DEVICE inline float learning_rate(const OptimiserSettings& settings, int parameter) {
  if (parameter < 3) return settings.lr_center;
  if (parameter == 3) return settings.lr_log_radius;
  return parameter < 7 ? settings.lr_color : settings.lr_logit_opacity;
}

// Adam on one parameter, its moments m and v, with derivative g.
SPLATCTRL_HOST_DEVICE inline void adam(float rate, const BiasCorrection& correct, float g, float* p, float* m,
                                       float* v) {
  *m = kBeta1 * *m + (1.0f - kBeta1) * g;
  *v = kBeta2 * *v + (1.0f - kBeta2) * g * g;
  *p -= rate * (*m * correct.first) / (std::sqrt(*v * correct.second) + kEpsilon);
}

SPLATCTRL_HOST_DEVICE inline void limit(const Camera& camera, const OptimiserSettings& settings, float* p) {
  p[3] = std::clamp(p[3], std::log(settings.min_radius), std::log(largest_radius(camera, p, settings)));
  for (int c = 0; c < 3; ++c) p[4 + c] = std::clamp(p[4 + c], 0.0f, 1.0f);
  p[7] = std::clamp(p[7], -kLargestLogit, kLargestLogit);
}

// lambda_noise * lr * r^2 * sigmoid(-k (alpha - alpha_min)) * eta, at most half a radius, on the centre of splat i.
SPLATCTRL_HOST_DEVICE inline void add_noise(const OptimiserSettings& settings, int i, float* p) {
  if (settings.noise <= 0.0f) return;
  const float r = std::exp(p[3]), alpha = sigmoid(p[7]);
  const float scale = settings.noise * settings.lr_center * r * r * sigmoid(-kGate * (alpha - settings.min_opacity));
  if (scale < 1e-9f) return;
  for (int k = 0; k < 3; ++k) {
    const float step = scale * normal(settings.seed, static_cast<std::uint64_t>(3 * i + k));
    p[k] += std::clamp(step, -kLargestStep * r, kLargestStep * r);
  }
}

}  // namespace splatctrl
