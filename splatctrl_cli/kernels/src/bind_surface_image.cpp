// Rendered surfaces of solids: see kernels/surface.py for shapes.
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <utility>
#include <vector>

#include "bind.h"
#include "depth_errors.h"
#include "depth_shadows.h"
#include "points.h"
#include "surface_image.h"
#include "surface_pieces.h"
#include "surface_steps.h"

namespace splatctrl {
namespace {

constexpr std::size_t kColumns = 16;  // kind, rotation (9), shift (3), size (3)

std::vector<SurfaceSolid> solids_from(const Array<const double>& rows, const Array<const std::int16_t>& links) {
  expect(rows.size() == kColumns * links.size(), "solids: expected (P, 16) and links (P,)");
  std::vector<SurfaceSolid> solids(links.size());
  for (std::size_t i = 0; i < solids.size(); ++i) {
    const double* p = rows.data() + kColumns * i;
    expect(p[0] >= 0 && p[0] <= 3, "solids: expected kinds 0 to 3");
    solids[i].kind = static_cast<SolidKind>(static_cast<int>(p[0]));
    std::copy(p + 1, p + 10, solids[i].turn);
    std::copy(p + 10, p + 13, solids[i].shift);
    std::copy(p + 13, p + 16, solids[i].size);
    solids[i].link = links.data()[i];
  }
  return solids;
}

}  // namespace

void bind_surface(nb::module_& m) {
  m.def(
      "solid_distance",
      [](const Array<const double>& points, const Array<const double>& solids,
         const Array<const std::int16_t>& solid_links, const Array<double>& distance, int num_threads) {
        expect(points.size() == 3 * distance.size(), "expected points (N, 3), distance (N,)");
        const std::vector<SurfaceSolid> shapes = solids_from(solids, solid_links);
        const nb::gil_scoped_release release;
        solid_distance(points.data(), static_cast<int>(distance.size()), shapes.data(),
                       static_cast<int>(shapes.size()), distance.data(), num_threads);
      },
      nb::arg("points").noconvert(), nb::arg("solids").noconvert(), nb::arg("solid_links").noconvert(),
      nb::arg("distance").noconvert(), nb::arg("num_threads"));
  nb::class_<SurfaceMesh>(m, "SurfaceMesh")
      .def(
          "__init__",
          [](SurfaceMesh* self, const Array<const double>& corners, const Array<const std::int16_t>& links) {
            expect(corners.size() == 9 * links.size(), "expected corners (F, 3, 3) and links (F,)");
            expect(std::all_of(links.data(), links.data() + links.size(), [](int link) { return link >= 0; }),
                   "links: expected numbers of at least 0");
            const nb::gil_scoped_release release;
            new (self) SurfaceMesh(corners.data(), links.data(), static_cast<int>(links.size()));
          },
          nb::arg("corners").noconvert(), nb::arg("links").noconvert());
  m.def(
      "render_surface",
      [](const Array<const double>& intrinsics, const Array<const double>& solids,
         const Array<const std::int16_t>& solid_links, const SurfaceMesh& mesh, const Array<const double>& link_poses,
         const Array<const float>& measured, float tolerance, float quadratic, const Array<float>& depth,
         const Array<std::int16_t>& link, const Array<std::int16_t>& inside, int num_threads) {
        expect(intrinsics.size() == 6, "intrinsics: expected 6 numbers");
        const double* k = intrinsics.data();
        const SurfaceCamera camera{k[0], k[1], k[2], k[3], static_cast<int>(k[4]), static_cast<int>(k[5])};
        const std::size_t size = static_cast<std::size_t>(camera.width) * camera.height;
        expect(measured.size() == size && depth.size() == size && link.size() == size && inside.size() == size,
               "expected images (H, W)");
        expect(link_poses.size() >= 12 * static_cast<std::size_t>(mesh.num_links()), "triangles: no such link");
        const std::vector<SurfaceSolid> shapes = solids_from(solids, solid_links);
        const nb::gil_scoped_release release;
        render_surface(camera, shapes.data(), static_cast<int>(shapes.size()),
                       {mesh, link_poses.data()}, {measured.data(), tolerance, quadratic},
                       {depth.data(), link.data(), inside.data()}, num_threads);
      },
      nb::arg("intrinsics").noconvert(), nb::arg("solids").noconvert(), nb::arg("solid_links").noconvert(),
      nb::arg("mesh"), nb::arg("link_poses").noconvert(),
      nb::arg("measured").noconvert(), nb::arg("tolerance"), nb::arg("quadratic"),
      nb::arg("depth").noconvert(), nb::arg("link").noconvert(), nb::arg("inside").noconvert(), nb::arg("num_threads"));
  m.def(
      "surface_steps",
      [](const Array<const float, nb::ndim<2>>& depth, const Array<const float>& tolerance,
         const Array<const std::uint8_t>& support, const Array<const std::uint8_t>& asked, int reach, double variance,
         double residual, const Array<float>& steps) {
        const std::size_t size = depth.size();
        expect(tolerance.size() == size && support.size() == size && asked.size() == size && steps.size() == size,
               "expected images (H, W)");
        const PlaneImage image{depth.data(), tolerance.data(), support.data(), asked.data(),
                               static_cast<int>(depth.shape(0)), static_cast<int>(depth.shape(1))};
        const nb::gil_scoped_release release;
        surface_steps(image, reach, {variance, residual}, steps.data());
      },
      nb::arg("depth").noconvert(), nb::arg("tolerance").noconvert(), nb::arg("support").noconvert(),
      nb::arg("asked").noconvert(), nb::arg("reach"), nb::arg("variance"), nb::arg("residual"),
      nb::arg("steps").noconvert());
  m.def(
      "depth_errors",
      [](const Array<const float>& depth, const Array<const float>& opacity, const Array<const float>& measured,
         const Array<const std::uint8_t>& counted, float hole, float opaque, const Array<float>& error,
         const Array<float>& sizes) {
        const std::size_t size = depth.size();
        expect(opacity.size() == size && measured.size() == size && counted.size() == size && error.size() == size &&
                   sizes.size() == size,
               "expected images (H, W), sizes (H W,)");
        const nb::gil_scoped_release release;
        return depth_errors({depth.data(), opacity.data(), measured.data(), counted.data(), size}, hole, opaque,
                            error.data(), sizes.data());
      },
      nb::arg("depth").noconvert(), nb::arg("opacity").noconvert(), nb::arg("measured").noconvert(),
      nb::arg("counted").noconvert(), nb::arg("hole"), nb::arg("opaque"), nb::arg("error").noconvert(),
      nb::arg("sizes").noconvert());
  m.def(
      "shadow_steps",
      [](const Array<const float, nb::ndim<2>>& depth, float focal, float step, const Array<float>& height,
         const Array<std::int32_t>& lost) {
        const std::size_t size = depth.size();
        expect(height.size() == 2 * size && lost.size() == 2 * size, "expected height and lost (2, H W)");
        const ShadowImage image{depth.data(), static_cast<int>(depth.shape(0)), static_cast<int>(depth.shape(1))};
        ShadowSteps right{height.data(), lost.data(), 0}, left{height.data() + size, lost.data() + size, 0};
        const nb::gil_scoped_release release;
        shadow_steps(image, focal, step, right, left);
        return std::make_pair(right.num, left.num);
      },
      nb::arg("depth").noconvert(), nb::arg("focal"), nb::arg("step"), nb::arg("height").noconvert(),
      nb::arg("lost").noconvert());
  m.def(
      "mark_shadows",
      [](const Array<const float, nb::ndim<2>>& depth, const Array<const float>& behind, bool is_turned,
         float focal_baseline, float fattened, const Array<std::uint8_t>& is_shadow) {
        expect(behind.size() == depth.size() && is_shadow.size() == depth.size(), "expected images (H, W)");
        const ShadowImage image{depth.data(), static_cast<int>(depth.shape(0)), static_cast<int>(depth.shape(1))};
        const nb::gil_scoped_release release;
        mark_shadows(image, is_turned, behind.data(), focal_baseline, fattened, is_shadow.data());
      },
      nb::arg("depth").noconvert(), nb::arg("behind").noconvert(), nb::arg("is_turned"), nb::arg("focal_baseline"),
      nb::arg("fattened"), nb::arg("is_shadow").noconvert());
  m.def(
      "piece_areas",
      [](const Array<const float, nb::ndim<2>>& depth, const Array<const float>& steps, const Array<const double>& area,
         const Array<const std::uint8_t>& is_object, const Array<const std::uint8_t>& asked,
         const Array<double>& total) {
        const std::size_t size = depth.size();
        expect(steps.size() == size && area.size() == size && is_object.size() == size && asked.size() == size &&
                   total.size() == size,
               "expected images (H, W)");
        const PieceImage image{depth.data(),     steps.data(), area.data(), is_object.data(), asked.data(),
                               static_cast<int>(depth.shape(0)), static_cast<int>(depth.shape(1))};
        const nb::gil_scoped_release release;
        piece_areas(image, total.data());
      },
      nb::arg("depth").noconvert(), nb::arg("steps").noconvert(), nb::arg("area").noconvert(),
      nb::arg("is_object").noconvert(), nb::arg("asked").noconvert(), nb::arg("total").noconvert());
}

}  // namespace splatctrl
