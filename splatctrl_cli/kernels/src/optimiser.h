// The step of splat_step.h on parameters (N, 8).
#pragma once

#include <cstdint>

#include "raster.h"
#include "splat_step.h"

namespace splatctrl {

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
