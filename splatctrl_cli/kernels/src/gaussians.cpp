#include "gaussians.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr float kBeta1 = 0.9f, kBeta2 = 0.999f, kEpsilon = 1e-15f;
constexpr int kChunk = 512;

struct Eye {
  float at[3];
};

Eye eye_of(const Camera& camera) {
  const float* R = camera.rotation;
  const float* t = camera.translation;
  Eye eye;
  for (int k = 0; k < 3; ++k) eye.at[k] = -(R[k] * t[0] + R[3 + k] * t[1] + R[6 + k] * t[2]);
  return eye;
}

template <typename Visit>
void for_visible(const Rasteriser& raster, int num_threads, const Visit& visit) {
  const int count = raster.num_splats();
  parallel_for((count + kChunk - 1) / kChunk, num_threads, [&](int chunk) {
    for (int i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk); ++i) {
      if (raster.visible()[i]) visit(i);
    }
  });
}

// The learning rate of every float of a row.
struct RowRates {
  float rate[kGaussianFloats];
  explicit RowRates(const GaussianRates& rates) {
    GaussianParameters row;
    std::fill_n(row.center, 3, rates.center);
    std::fill_n(row.log_scale, 3, rates.log_scale);
    std::fill_n(row.quat_wxyz, 4, rates.quat);
    row.logit_opacity = rates.logit_opacity;
    for (auto& channel : row.harmonics) {
      std::fill_n(channel, kMaxHarmonics, rates.harmonics);
      channel[0] = rates.color;
    }
    std::memcpy(rate, &row, sizeof rate);
  }
};

void adam(const float* gradient, const RowRates& rates, std::uint32_t num_steps, float* p, float* m, float* v) {
  const auto t = static_cast<float>(num_steps);
  const float correct1 = 1.0f / (1.0f - std::pow(kBeta1, t)), correct2 = 1.0f / (1.0f - std::pow(kBeta2, t));
  for (int k = 0; k < kGaussianFloats; ++k) {
    m[k] = kBeta1 * m[k] + (1.0f - kBeta1) * gradient[k];
    v[k] = kBeta2 * v[k] + (1.0f - kBeta2) * gradient[k] * gradient[k];
    p[k] -= rates.rate[k] * (m[k] * correct1) / (std::sqrt(v[k] * correct2) + kEpsilon);
  }
}

void record_growth(const Camera& camera, const CameraGaussian& seen, const FootprintGradient& g,
                   GaussianGrowth* growth) {
  const float gu = 0.5f * static_cast<float>(camera.width) * g.u;
  const float gv = 0.5f * static_cast<float>(camera.height) * g.v;
  growth->gradient_sum += std::sqrt(gu * gu + gv * gv);
  growth->num_views += 1.0f;
  growth->screen_radius = std::max(growth->screen_radius, screen_radius(seen));
}

}  // namespace

void prepare_gaussians(Rasteriser* raster, const Camera& camera, const GaussianParameters* parameters, int count,
                       int degree, float* colors, int num_threads) {
  const Eye eye = eye_of(camera);
  const Projection project = [&](int first, int last, Footprint* footprints, std::uint8_t* visible) {
    for (int i = first; i < last; ++i) {
      visible[i] = project_gaussian(camera, parameters[i], &footprints[i]);
      if (visible[i]) gaussian_color(degree, eye.at, parameters[i], colors + 3 * static_cast<std::size_t>(i));
    }
  };
  raster->prepare(camera, count, project, colors, num_threads);
}

void gaussian_gradients(const Rasteriser& raster, const GaussianParameters* parameters, int degree,
                        const SplatGradient* gradients, GaussianParameters* out, int num_threads) {
  const Eye eye = eye_of(raster.camera());
  std::fill_n(out, raster.num_splats(), GaussianParameters{});
  for_visible(raster, num_threads, [&](int i) {
    const CameraGaussian seen = see_gaussian(raster.camera(), parameters[i]);
    gaussian_backward(raster.camera(), degree, eye.at, parameters[i], seen, gradients[i].footprint,
                      gradients[i].color, &out[i]);
  });
}

void gaussian_step(const GaussianState& state, const Rasteriser& raster, int degree, const SplatGradient* gradients,
                   const GaussianRates& rates, int num_threads) {
  const Eye eye = eye_of(raster.camera());
  const RowRates row_rates(rates);
  for_visible(raster, num_threads, [&](int i) {
    GaussianParameters& p = state.parameters[i];
    const SplatGradient& g = gradients[i];
    const CameraGaussian seen = see_gaussian(raster.camera(), p);
    GaussianParameters gradient;
    gaussian_backward(raster.camera(), degree, eye.at, p, seen, g.footprint, g.color, &gradient);
    const float opacity = gaussian_opacity(p.logit_opacity);
    gradient.logit_opacity += rates.regulariser * opacity * (1.0f - opacity);
    record_growth(raster.camera(), seen, g.footprint, &state.growth[i]);
    adam(gradient.center, row_rates, ++state.num_steps[i], p.center, state.first_moment[i].center,
         state.second_moment[i].center);
  });
}

}  // namespace splatctrl
