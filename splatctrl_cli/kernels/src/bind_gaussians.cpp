// Anisotropic Gaussians: see kernels/raster.py for shapes.
#include "bind.h"
#include "gaussians.h"

namespace splatctrl {
namespace {

using Floats = Array<float>;
using ConstFloats = Array<const float>;

const GaussianParameters* rows(const ConstFloats& values) {
  return reinterpret_cast<const GaussianParameters*>(values.data());
}

GaussianParameters* rows(const Floats& values) { return reinterpret_cast<GaussianParameters*>(values.data()); }

}  // namespace

void bind_gaussians(nb::module_& m) {
  m.def(
      "prepare_gaussians",
      [](Rasteriser& raster, const Array<const double>& camera, const ConstFloats& parameters, int degree,
         const Floats& colors, int num_threads) {
        const auto n = colors.size() / 3;
        expect(parameters.size() == kGaussianFloats * n && degree >= 0 && degree <= 3,
               "expected parameters (N, 59), colors (N, 3), degree 0 to 3");
        const Camera c = camera_from(camera);
        const nb::gil_scoped_release release;
        prepare_gaussians(&raster, c, rows(parameters), static_cast<int>(n), degree, colors.data(), num_threads);
      },
      nb::arg("raster"), nb::arg("camera").noconvert(), nb::arg("parameters").noconvert(), nb::arg("degree"),
      nb::arg("colors").noconvert(), nb::arg("num_threads"));
  m.def(
      "gaussian_gradients",
      [](const Rasteriser& raster, const ConstFloats& parameters, int degree, const ConstFloats& gradients,
         const Floats& out, int num_threads) {
        const auto n = static_cast<std::size_t>(raster.num_splats());
        expect(parameters.size() == kGaussianFloats * n && gradients.size() == 10 * n &&
                   out.size() == kGaussianFloats * n,
               "expected parameters and out (N, 59), gradients (N, 10)");
        const nb::gil_scoped_release release;
        gaussian_gradients(raster, rows(parameters), degree,
                           reinterpret_cast<const SplatGradient*>(gradients.data()), rows(out), num_threads);
      },
      nb::arg("raster"), nb::arg("parameters").noconvert(), nb::arg("degree"), nb::arg("gradients").noconvert(),
      nb::arg("out").noconvert(), nb::arg("num_threads"));
  m.def(
      "gaussian_step",
      [](const Rasteriser& raster, int degree, const ConstFloats& gradients, const Floats& parameters,
         const Floats& first_moment, const Floats& second_moment, const Array<std::uint32_t>& num_steps,
         const Floats& growth, const Array<const double>& rates, int num_threads) {
        const auto n = num_steps.size();
        expect(n == static_cast<std::size_t>(raster.num_splats()) && gradients.size() == 10 * n &&
                   parameters.size() == kGaussianFloats * n && first_moment.size() == kGaussianFloats * n &&
                   second_moment.size() == kGaussianFloats * n && growth.size() == 3 * n,
               "expected gradients (N, 10), parameters and moments (N, 59), num_steps (N,), growth (N, 3)");
        expect(rates.size() == 7, "rates: expected 7 numbers");
        const auto f = [&rates](int k) { return static_cast<float>(rates.data()[k]); };
        const GaussianRates values{f(0), f(1), f(2), f(3), f(4), f(5), f(6)};
        const GaussianState state{rows(parameters), rows(first_moment), rows(second_moment), num_steps.data(),
                                  reinterpret_cast<GaussianGrowth*>(growth.data()), static_cast<int>(n)};
        const nb::gil_scoped_release release;
        gaussian_step(state, raster, degree, reinterpret_cast<const SplatGradient*>(gradients.data()), values,
                      num_threads);
      },
      nb::arg("raster"), nb::arg("degree"), nb::arg("gradients").noconvert(), nb::arg("parameters").noconvert(),
      nb::arg("first_moment").noconvert(), nb::arg("second_moment").noconvert(), nb::arg("num_steps").noconvert(),
      nb::arg("growth").noconvert(), nb::arg("rates").noconvert(), nb::arg("num_threads"));
}

}  // namespace splatctrl
