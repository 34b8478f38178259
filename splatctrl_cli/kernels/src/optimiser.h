// Adam on the splats' parameters (N, 8): centre (3) [m], log radius, colour (3), logit opacity; with the chain rule
// from image derivatives, the opacity regulariser, and the noise of 3DGS-MCMC after the update.
#pragma once

#include <cstdint>

#include "raster.h"

namespace splatctrl {

constexpr int kNumParameters = 8;

struct OptimiserSettings {
  float lr_center, lr_log_radius, lr_color, lr_logit_opacity;
  float regulariser;        // lambda_reg / N: the derivative of lambda_reg * mean |alpha|
  float noise;              // lambda_noise
  float min_opacity;        // centre of the noise gate
  float min_radius, max_radius;  // [m]
  float radius_depth;       // [m] at which a splat may be max_radius large, and in proportion elsewhere; 0: everywhere
  std::uint64_t seed;       // of this step's noise
};

struct SplatState {
  float* parameters;        // (N, 8)
  float* first_moment;      // (N, 8)
  float* second_moment;     // (N, 8)
  std::uint32_t* num_steps; // (N,) Adam steps since the slot was filled, for the bias correction
  int num_splats;
};

// One step for the splats that the rasteriser saw; others keep parameters and moments. centers, radii and
// opacities are those the rasteriser was prepared with.
void optimiser_step(const SplatState& state, const Rasteriser& raster, const SplatGradient* gradients,
                    const OptimiserSettings& settings, int num_threads);

// parameters (N, 8) -> centers (N, 3), radii (N,), colors (N, 3), opacities (N,).
void unpack_parameters(const float* parameters, int num_splats, float* centers, float* radii, float* colors,
                       float* opacities, int num_threads);

}  // namespace splatctrl
