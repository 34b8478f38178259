// Rasteriser, image loss, optimiser: see kernels/raster.py for shapes.
#include <algorithm>

#include "bind.h"
#include "loss.h"
#include "optimiser.h"
#include "raster.h"

namespace splatctrl {
namespace {

using Floats = Array<float>;
using ConstFloats = Array<const float>;

static_assert(sizeof(SplatGradient) == 10 * sizeof(float), "gradients cross as rows of ten floats");

std::size_t num_pixels(const Camera& camera) { return static_cast<std::size_t>(camera.width) * camera.height; }

void bind_rasteriser(nb::module_& m) {
  nb::class_<Rasteriser>(m, "Rasteriser")
      .def(nb::init<>())
      .def(
          "prepare",
          [](Rasteriser& self, const Array<const double>& camera, const ConstFloats& centers,
             const ConstFloats& radii, const ConstFloats& opacities, const ConstFloats& colors, int num_threads) {
            const auto n = radii.size();
            expect(centers.size() == 3 * n && opacities.size() == n && colors.size() == 3 * n,
                   "splats: expected centers (N, 3), radii (N,), opacities (N,), colors (N, 3)");
            const Camera c = camera_from(camera);
            const nb::gil_scoped_release release;
            self.prepare(c, static_cast<int>(n), centers.data(), radii.data(), opacities.data(), colors.data(),
                         num_threads);
          },
          nb::arg("camera").noconvert(), nb::arg("centers").noconvert(), nb::arg("radii").noconvert(),
          nb::arg("opacities").noconvert(), nb::arg("colors").noconvert(), nb::arg("num_threads"))
      .def(
          "forward",
          [](Rasteriser& self, const Floats& planes, int num_threads) {
            expect(planes.size() == kNumPlanes * num_pixels(self.camera()), "planes: expected (5, H, W)");
            const nb::gil_scoped_release release;
            self.forward(planes.data(), num_threads);
          },
          nb::arg("planes").noconvert(), nb::arg("num_threads"))
      .def(
          "backward",
          [](Rasteriser& self, const ConstFloats& planes, const ConstFloats& plane_gradients,
             const Floats& gradients, int num_threads) {
            const auto size = kNumPlanes * num_pixels(self.camera());
            expect(planes.size() == size && plane_gradients.size() == size, "planes: expected (5, H, W)");
            expect(gradients.size() == 10 * static_cast<std::size_t>(self.num_splats()),
                   "gradients: expected (N, 10)");
            const nb::gil_scoped_release release;
            self.backward(planes.data(), plane_gradients.data(),
                          reinterpret_cast<SplatGradient*>(gradients.data()), num_threads);
          },
          nb::arg("planes").noconvert(), nb::arg("plane_gradients").noconvert(), nb::arg("gradients").noconvert(),
          nb::arg("num_threads"))
      .def(
          "project_backward",
          [](Rasteriser& self, const ConstFloats& centers, const ConstFloats& radii, const ConstFloats& gradients,
             const Floats& out) {
            const auto n = static_cast<std::size_t>(self.num_splats());
            expect(centers.size() == 3 * n && radii.size() == n && gradients.size() == 10 * n && out.size() == 4 * n,
                   "expected centers (N, 3), radii (N,), gradients (N, 10), out (N, 4)");
            const auto* g = reinterpret_cast<const SplatGradient*>(gradients.data());
            for (std::size_t i = 0; i < n; ++i) {
              float* row = out.data() + 4 * i;
              row[0] = row[1] = row[2] = row[3] = 0.0f;
              if (!self.visible()[i]) continue;
              project_isotropic_backward(self.camera(), centers.data() + 3 * i, radii.data()[i], g[i].footprint, row,
                                         row + 3);
            }
          },
          nb::arg("centers").noconvert(), nb::arg("radii").noconvert(), nb::arg("gradients").noconvert(),
          nb::arg("out").noconvert())
      .def(
          "visible",
          [](const Rasteriser& self, const Array<std::uint8_t>& out) {
            expect(out.size() == self.visible().size(), "visible: expected (N,)");
            std::copy(self.visible().begin(), self.visible().end(), out.data());
          },
          nb::arg("out").noconvert())
      .def("splats_per_tile", [](const Rasteriser& self) {
        const auto& start = self.tile_start();
        return start.size() < 2 ? 0.0 : static_cast<double>(start.back()) / static_cast<double>(start.size() - 1);
      });
}

void bind_loss(nb::module_& m) {
  nb::class_<ImageLoss>(m, "ImageLoss")
      .def(nb::init<>())
      .def(
          "evaluate",
          [](ImageLoss& self, const ConstFloats& planes, const Array<const std::uint8_t>& color,
             const ConstFloats& depth, const Array<const std::uint8_t>& counted, int width, int height, const Array<const double>& weights,
             bool normalised, const Floats& plane_gradients, int num_threads) {
            const auto size = static_cast<std::size_t>(width) * height;
            expect(planes.size() == 5 * size && color.size() == 3 * size && depth.size() == size &&
                       counted.size() == size && plane_gradients.size() == 5 * size,
                   "expected planes (5, H, W), color (3, H, W), depth and counted (H, W), plane_gradients (5, H, W)");
            expect(weights.size() == 7, "weights: expected 7 numbers");
            const auto w = [&weights](int k) { return static_cast<float>(weights.data()[k]); };
            const LossWeights values{w(0), w(1), w(2), w(3), normalised, {w(4), w(5), w(6)}};
            LossTerms terms;
            {
              const nb::gil_scoped_release release;
              terms = self.evaluate(planes.data(), color.data(), depth.data(), counted.data(), width, height,
                                    values, plane_gradients.data(), num_threads);
            }
            return nb::make_tuple(terms.l1, terms.dssim, terms.depth, terms.transmittance, terms.squared);
          },
          nb::arg("planes").noconvert(), nb::arg("color").noconvert(), nb::arg("depth").noconvert(),
          nb::arg("counted").noconvert(), nb::arg("width"), nb::arg("height"), nb::arg("weights").noconvert(),
          nb::arg("normalised"), nb::arg("plane_gradients").noconvert(), nb::arg("num_threads"));
}

void bind_optimiser(nb::module_& m) {
  m.def(
      "optimiser_step",
      [](const Rasteriser& raster, const ConstFloats& gradients, const Floats& parameters,
         const Floats& first_moment, const Floats& second_moment, const Array<std::uint32_t>& num_steps,
         const Array<const double>& settings, std::uint64_t seed, int num_threads) {
        const auto n = num_steps.size();
        expect(n == static_cast<std::size_t>(raster.num_splats()) && gradients.size() == 10 * n &&
                   parameters.size() == 8 * n && first_moment.size() == 8 * n && second_moment.size() == 8 * n,
               "expected gradients (N, 10), parameters and moments (N, 8), num_steps (N,)");
        expect(settings.size() == 10, "settings: expected 10 numbers");
        const double* s = settings.data();
        const auto f = [s](int k) { return static_cast<float>(s[k]); };
        const OptimiserSettings values{f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7), f(8), f(9), seed};
        const SplatState state{parameters.data(), first_moment.data(), second_moment.data(), num_steps.data(),
                               static_cast<int>(n)};
        const nb::gil_scoped_release release;
        optimiser_step(state, raster, reinterpret_cast<const SplatGradient*>(gradients.data()), values, num_threads);
      },
      nb::arg("raster"), nb::arg("gradients").noconvert(), nb::arg("parameters").noconvert(),
      nb::arg("first_moment").noconvert(), nb::arg("second_moment").noconvert(), nb::arg("num_steps").noconvert(),
      nb::arg("settings").noconvert(), nb::arg("seed"), nb::arg("num_threads"));
  m.def(
      "unpack_parameters",
      [](const ConstFloats& parameters, const Floats& centers, const Floats& radii, const Floats& colors,
         const Floats& opacities, int num_threads) {
        const auto n = radii.size();
        expect(parameters.size() == 8 * n && centers.size() == 3 * n && colors.size() == 3 * n &&
                   opacities.size() == n,
               "expected parameters (N, 8), centers (N, 3), radii (N,), colors (N, 3), opacities (N,)");
        const nb::gil_scoped_release release;
        unpack_parameters(parameters.data(), static_cast<int>(n), centers.data(), radii.data(), colors.data(),
                          opacities.data(), num_threads);
      },
      nb::arg("parameters").noconvert(), nb::arg("centers").noconvert(), nb::arg("radii").noconvert(),
      nb::arg("colors").noconvert(), nb::arg("opacities").noconvert(), nb::arg("num_threads"));
}

}  // namespace

void bind_raster(nb::module_& m) {
  bind_rasteriser(m);
  bind_loss(m);
  bind_optimiser(m);
}

}  // namespace splatctrl
