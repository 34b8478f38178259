// Many anisotropic Gaussians: footprints and colours for the rasteriser, and Adam on their parameters.
#pragma once

#include <cstdint>

#include "gaussian.h"
#include "raster.h"

namespace splatctrl {

// Prepares the rasteriser with count Gaussians whose harmonics count up to `degree`. colors (N, 3) is written where a
// Gaussian can be seen, and must live as long as the rasteriser's lists.
void prepare_gaussians(Rasteriser* raster, const Camera& camera, const GaussianParameters* parameters, int count,
                       int degree, float* colors, int num_threads);

// Derivatives with respect to every parameter from those of the footprints; zero for what was not seen.
void gaussian_gradients(const Rasteriser& raster, const GaussianParameters* parameters, int degree,
                        const SplatGradient* gradients, GaussianParameters* out, int num_threads);

// What decides where Gaussians are added or removed, since the last time that was done.
struct GaussianGrowth {
  float gradient_sum;   // of |dL/d(u, v)| in units of half an image, over the views that saw it
  float num_views;
  float screen_radius;  // the largest seen [px]
};
static_assert(sizeof(GaussianGrowth) == 3 * sizeof(float), "rows cross as three floats");

struct GaussianState {
  GaussianParameters *parameters, *first_moment, *second_moment;
  std::uint32_t* num_steps;  // Adam steps of each Gaussian, for the bias correction
  GaussianGrowth* growth;
  int count;
};

struct GaussianRates {
  float center, log_scale, quat, logit_opacity, color, harmonics;  // harmonics: those of degree 1 and up
  float regulariser;  // lambda_reg / N: the derivative of lambda_reg * mean |alpha|
};

// One Adam step for the Gaussians that the rasteriser saw; others keep parameters and moments.
void gaussian_step(const GaussianState& state, const Rasteriser& raster, int degree, const SplatGradient* gradients,
                   const GaussianRates& rates, int num_threads);

}  // namespace splatctrl
