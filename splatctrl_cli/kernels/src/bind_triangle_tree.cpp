// Trees of triangles: see kernels/surface_image.py for shapes.
#include <nanobind/stl/vector.h>

#include "bind.h"
#include "triangle_tree.h"

namespace splatctrl {

void bind_triangles(nb::module_& m) {
  nb::class_<TriangleTree>(m, "TriangleTree")
      .def(
          "__init__",
          [](TriangleTree* self, const Array<const double>& corners) {
            expect(corners.size() % 9 == 0, "expected corners (F, 3, 3)");
            const nb::gil_scoped_release release;
            new (self) TriangleTree(corners.data(), static_cast<int>(corners.size() / 9));
          },
          nb::arg("corners").noconvert())
      .def(
          "closest",
          [](const TriangleTree& self, const Array<const double>& points, const Array<const double>& bound,
             const Array<double>& distance, const Array<std::int64_t>& face, const Array<double>& shares,
             int num_threads) {
            const std::size_t n = distance.size();
            expect(points.size() == 3 * n && bound.size() == n && face.size() == n && shares.size() == 3 * n,
                   "expected points and shares (N, 3), bound, distance and face (N,)");
            const nb::gil_scoped_release release;
            self.closest(points.data(), static_cast<int>(n), bound.data(), distance.data(), face.data(),
                         shares.data(), num_threads);
          },
          nb::arg("points").noconvert(), nb::arg("bound").noconvert(), nb::arg("distance").noconvert(),
          nb::arg("face").noconvert(), nb::arg("shares").noconvert(), nb::arg("num_threads"))
      .def(
          "winding",
          [](const TriangleTree& self, const Array<const double>& points, const Array<double>& number,
             int num_threads) {
            expect(points.size() == 3 * number.size(), "expected points (N, 3), number (N,)");
            const nb::gil_scoped_release release;
            self.winding(points.data(), static_cast<int>(number.size()), number.data(), num_threads);
          },
          nb::arg("points").noconvert(), nb::arg("number").noconvert(), nb::arg("num_threads"))
      .def(
          "gaps",
          [](const TriangleTree& self, const Array<const double>& poses, const Array<const double>& centers,
             const Array<const double>& radii, const Array<double>& gap, const Array<std::int64_t>& ball,
             int num_threads) {
            expect(poses.size() == 12 * gap.size() && ball.size() == gap.size() && centers.size() == 3 * radii.size(),
                   "expected poses (T, 3, 4), gap and ball (T,), centers (N, 3), radii (N,)");
            const nb::gil_scoped_release release;
            self.gaps(poses.data(), static_cast<int>(gap.size()), centers.data(), radii.data(),
                      static_cast<int>(radii.size()), gap.data(), ball.data(), num_threads);
          },
          nb::arg("poses").noconvert(), nb::arg("centers").noconvert(), nb::arg("radii").noconvert(),
          nb::arg("gap").noconvert(), nb::arg("ball").noconvert(), nb::arg("num_threads"));
  m.def(
      "signed_distance",
      [](const std::vector<const TriangleTree*>& trees, const Array<const double>& poses,
         const Array<const double>& points, const Array<const double>& within, const Array<const double>& enough,
         const Array<const std::uint8_t>& may_be_inside, const Array<double>& distance, int num_threads) {
        const std::size_t n = distance.size();
        expect(poses.size() == 12 * trees.size(), "expected poses (K, 3, 4), one for each tree");
        expect(points.size() == 3 * n && within.size() == n && enough.size() == n && may_be_inside.size() == n,
               "expected points (N, 3), within, enough, may_be_inside and distance (N,)");
        const nb::gil_scoped_release release;
        signed_distance({trees, poses.data()},
                        {points.data(), within.data(), enough.data(), may_be_inside.data(), static_cast<int>(n)},
                        distance.data(), num_threads);
      },
      nb::arg("trees"), nb::arg("poses").noconvert(), nb::arg("points").noconvert(), nb::arg("within").noconvert(),
      nb::arg("enough").noconvert(), nb::arg("may_be_inside").noconvert(), nb::arg("distance").noconvert(),
      nb::arg("num_threads"));
}

}  // namespace splatctrl
