// What is asked of many points: see kernels/points.py for shapes.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <vector>

#include "bind.h"
#include "points.h"
#include "robot_votes.h"

namespace splatctrl {
namespace {

using Floats = Array<const float>;
using Bytes = Array<std::uint8_t>;

// camera: as of camera_from, in double precision.
NearestDepth view_from(const Array<const double>& camera, const float* nearest) {
  expect(camera.size() == 18, "camera: expected 18 numbers");
  const double* p = camera.data();
  NearestDepth view{p[0], p[1], p[2], p[3], static_cast<int>(p[4]), static_cast<int>(p[5]), {}, {}, nearest};
  std::copy(p + 6, p + 15, view.rotation);
  std::copy(p + 15, p + 18, view.translation);
  return view;
}

// camera: as of view_from, but from camera to world; chosen: all pixels where null.
ChosenDepth image_from(const Array<const double>& camera, const Floats& depth, const std::uint8_t* chosen) {
  expect(camera.size() == 18, "camera: expected 18 numbers");
  const double* p = camera.data();
  ChosenDepth image{p[0], p[1], p[2],         p[3],  static_cast<int>(p[4]), static_cast<int>(p[5]),
                    {},   {},   depth.data(), chosen};
  expect(depth.size() == static_cast<std::size_t>(p[4] * p[5]), "depth: expected (H, W), as the camera");
  std::copy(p + 6, p + 15, image.rotation);
  std::copy(p + 15, p + 18, image.translation);
  return image;
}

}  // namespace

void bind_points(nb::module_& m) {
  m.def(
      "back_project",
      [](const Array<const double>& camera, const Floats& depth, const std::optional<Array<const std::uint8_t>>& chosen,
         const Array<double>& points, int num_threads) {
        const ChosenDepth image = image_from(camera, depth, chosen ? chosen->data() : nullptr);
        expect(!chosen || chosen->size() == depth.size(), "chosen: expected (H, W), as the camera");
        const std::size_t num = depth.size() - (chosen ? std::count(chosen->data(), chosen->data() + depth.size(), 0) : 0);
        expect(points.size() == 3 * num, "expected points (K, 3)");
        const nb::gil_scoped_release release;
        back_project(image, points.data(), num_threads);
      },
      nb::arg("camera").noconvert(), nb::arg("depth").noconvert(), nb::arg("chosen").none(),
      nb::arg("points").noconvert(), nb::arg("num_threads"));
  m.def(
      "outvote",
      [](const std::vector<Array<const double>>& cameras, const std::vector<Floats>& depths,
         const std::vector<Array<const std::uint8_t>>& chosen, const std::vector<Bytes>& kinds,
         const Array<const double>& origin, double voxel, double share, std::uint8_t robot, std::uint8_t object,
         std::uint8_t outvoted) {
        expect(depths.size() == cameras.size() && chosen.size() == cameras.size() && kinds.size() == cameras.size(),
               "expected as many images as cameras");
        expect(origin.size() == 3, "origin: expected 3 numbers");
        std::vector<VoteImage> images;
        for (std::size_t i = 0; i < cameras.size(); ++i) {
          expect(chosen[i].size() == depths[i].size() && kinds[i].size() == depths[i].size(), "expected images (H, W)");
          images.push_back({image_from(cameras[i], depths[i], chosen[i].data()), kinds[i].data()});
        }
        const double* o = origin.data();
        const nb::gil_scoped_release release;
        outvote(images, {{o[0], o[1], o[2]}, voxel, share, robot, object, outvoted});
      },
      nb::arg("cameras"), nb::arg("depths"), nb::arg("chosen"), nb::arg("kinds"), nb::arg("origin").noconvert(),
      nb::arg("voxel"), nb::arg("share"), nb::arg("robot"), nb::arg("object"), nb::arg("outvoted"));
  m.def(
      "mark_inside",
      [](const Array<const double>& camera, const Floats& depth, const Array<const double>& box, float min_range,
         const Bytes& is_inside, int num_threads) {
        const ChosenDepth image = image_from(camera, depth, nullptr);
        expect(box.size() == 6 && is_inside.size() == depth.size(), "expected box (2, 3), is_inside (H, W)");
        const nb::gil_scoped_release release;
        mark_inside(image, box.data(), box.data() + 3, min_range, is_inside.data(), num_threads);
      },
      nb::arg("camera").noconvert(), nb::arg("depth").noconvert(), nb::arg("box").noconvert(), nb::arg("min_range"),
      nb::arg("is_inside").noconvert(), nb::arg("num_threads"));
  m.def(
      "pixels_at",
      [](const Array<const double>& points, const Array<const double>& camera, const Array<std::int64_t>& pixel,
         const Array<float>& depth) {
        expect(points.size() == 3 * pixel.size() && depth.size() == pixel.size(),
               "expected points (N, 3), pixel and depth (N,)");
        const NearestDepth view = view_from(camera, nullptr);
        const nb::gil_scoped_release release;
        pixels_at(points.data(), static_cast<int>(pixel.size()), view, pixel.data(), depth.data());
      },
      nb::arg("points").noconvert(), nb::arg("camera").noconvert(), nb::arg("pixel").noconvert(),
      nb::arg("depth").noconvert());
  m.def(
      "seen_through",
      [](const Floats& points, const std::vector<Array<const double>>& cameras, const std::vector<Floats>& nearest,
         float tolerance, const Bytes& out, int num_threads) {
        expect(points.size() == 3 * out.size(), "expected points (N, 3), out (N,)");
        expect(cameras.size() == nearest.size(), "expected as many images as cameras");
        std::vector<NearestDepth> views;
        for (std::size_t i = 0; i < cameras.size(); ++i) {
          views.push_back(view_from(cameras[i], nearest[i].data()));
          expect(nearest[i].size() == static_cast<std::size_t>(views[i].width) * views[i].height,
                 "nearest: expected (H, W), as the camera");
        }
        const nb::gil_scoped_release release;
        seen_through(points.data(), static_cast<int>(out.size()), views.data(), static_cast<int>(views.size()),
                     tolerance, out.data(), num_threads);
      },
      nb::arg("points").noconvert(), nb::arg("cameras"), nb::arg("nearest"), nb::arg("tolerance"),
      nb::arg("out").noconvert(), nb::arg("num_threads"));
  nb::class_<Cubes>(m, "Cubes")
      .def(
          "__init__",
          [](Cubes* self, const Floats& points, double edge, int num_threads) {
            expect(points.ndim() == 2 && points.shape(1) == 3 && edge > 0.0, "expected points (N, 3), edge above 0");
            const nb::gil_scoped_release release;
            new (self) Cubes(points.data(), static_cast<int>(points.shape(0)), edge, num_threads);
          },
          nb::arg("points").noconvert(), nb::arg("edge"), nb::arg("num_threads"))
      .def("__len__", &Cubes::size)
      .def(
          "members",
          [](const Cubes& self, const Array<std::int32_t>& of_point, const Array<std::int64_t>& first,
             int num_threads) {
            expect(of_point.size() == static_cast<std::size_t>(self.num_points()) &&
                       first.size() == static_cast<std::size_t>(self.size()),
                   "expected of_point (N,), first (K,)");
            const nb::gil_scoped_release release;
            self.members(of_point.data(), first.data(), num_threads);
          },
          nb::arg("of_point").noconvert(), nb::arg("first").noconvert(), nb::arg("num_threads"))
      .def(
          "measure",
          [](const Cubes& self, const Floats& points, const Floats& colors, const Array<double>& count,
             const Array<double>& center, const Array<double>& color, const Array<double>& square,
             const Array<double>& covariance, const Array<std::int64_t>& nearest, int num_threads) {
            const auto n = static_cast<std::size_t>(self.num_points()), k = static_cast<std::size_t>(self.size());
            expect(points.size() == 3 * n && colors.size() == 3 * n, "expected points and colors (N, 3)");
            expect(count.size() == k && center.size() == 3 * k && color.size() == 3 * k && square.size() == 3 * k &&
                       covariance.size() == 6 * k && nearest.size() == k,
                   "expected count and nearest (K,), center, color and square (K, 3), covariance (K, 6)");
            const nb::gil_scoped_release release;
            self.measure(points.data(), colors.data(),
                         {count.data(), center.data(), color.data(), square.data(), covariance.data(), nearest.data()},
                         num_threads);
          },
          nb::arg("points").noconvert(), nb::arg("colors").noconvert(), nb::arg("count").noconvert(),
          nb::arg("center").noconvert(), nb::arg("color").noconvert(), nb::arg("square").noconvert(),
          nb::arg("covariance").noconvert(), nb::arg("nearest").noconvert(), nb::arg("num_threads"));
  nb::class_<SplatTree>(m, "SplatTree")
      .def(
          "__init__",
          [](SplatTree* self, const Floats& centers, const Floats& radii) {
            expect(centers.size() == 3 * radii.size(), "expected centers (N, 3), radii (N,)");
            const nb::gil_scoped_release release;
            new (self) SplatTree(centers.data(), radii.data(), static_cast<int>(radii.size()));
          },
          nb::arg("centers").noconvert(), nb::arg("radii").noconvert())
      .def(
          "are_further",
          [](const SplatTree& self, const Array<const double>& points, double gap, const Bytes& out,
             int num_threads) {
            expect(points.size() == 3 * out.size(), "expected points (K, 3), out (K,)");
            const nb::gil_scoped_release release;
            self.are_further(points.data(), static_cast<int>(out.size()), gap, out.data(), num_threads);
          },
          nb::arg("points").noconvert(), nb::arg("gap"), nb::arg("out").noconvert(), nb::arg("num_threads"));
}

}  // namespace splatctrl
