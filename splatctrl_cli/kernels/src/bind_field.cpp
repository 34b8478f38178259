#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "bind.h"
#include "field_bake.h"
#include "field_grid.h"
#include "field_query.h"

namespace splatctrl {
namespace {

using Centers = Array<const float, nb::shape<3, -1>>;
using Offsets = Array<const float, nb::shape<-1>>;
using Bounds = Array<const float, nb::shape<6, -1>>;
using Points = Array<const float, nb::shape<-1, 3>>;
using Points64 = Array<const double, nb::shape<-1, 3>>;
using Values = Array<float, nb::shape<-1>>;
using Vectors = Array<float, nb::shape<-1, 3>>;
using Values64 = Array<double, nb::shape<-1>>;
using Vectors64 = Array<double, nb::shape<-1, 3>>;
using Volume = Array<float, nb::shape<-1, -1, -1>>;
using ConstVolume = Array<const float, nb::shape<-1, -1, -1>>;
using VectorVolume = Array<float, nb::shape<-1, -1, -1, 3>>;
using Triple = Array<const double, nb::shape<3>>;

void require(bool holds, const char* message) {
  if (!holds) throw std::invalid_argument(message);
}

Clusters view_clusters(const Centers& centers, const Offsets& offsets, const Bounds& bounds,
                       const Offsets& max_offsets) {
  const size_t n = bounds.shape(1), m = centers.shape(1);
  require(n > 0 && m == kLanes * n, "centers: expected (3, 16 C) with C > 0");
  require(offsets.shape(0) == m && max_offsets.shape(0) == n, "offsets: expected (16 C) and (C)");
  const float *c = centers.data(), *b = bounds.data();
  float scale = 0.0f;
  for (size_t i = 0; i < n; ++i) scale = std::max(scale, std::fabs(max_offsets.data()[i]));
  return {static_cast<int>(n), c,         c + m,     c + 2 * m, offsets.data(),     b,    b + n,
          b + 2 * n,           b + 3 * n, b + 4 * n, b + 5 * n, max_offsets.data(), scale};
}

void nearest(const Centers& centers, const Offsets& offsets, const Bounds& bounds, const Offsets& max_offsets,
             const Points& points, int threads, const Values& score, const Vectors& gradient) {
  const Clusters spheres = view_clusters(centers, offsets, bounds, max_offsets);
  const size_t q = points.shape(0);
  require(score.shape(0) == q && gradient.shape(0) == q, "score, gradient: expected one entry per point");
  const nb::gil_scoped_release release;
  query_nearest(spheres, points.data(), static_cast<int>(q), threads, score.data(), gradient.data());
}

void soft(const Centers& centers, const Offsets& offsets, const Bounds& bounds, const Offsets& max_offsets,
          float length, float truncation, const Points& points, int threads, const Values& score,
          const Vectors& gradient) {
  const Clusters spheres = view_clusters(centers, offsets, bounds, max_offsets);
  const size_t q = points.shape(0);
  require(score.shape(0) == q && gradient.shape(0) == q, "score, gradient: expected one entry per point");
  const nb::gil_scoped_release release;
  query_soft(spheres, length, truncation, points.data(), static_cast<int>(q), threads, score.data(), gradient.data());
}

void bake(const Centers& centers, const Offsets& radii, const Offsets& max_radii, const Offsets& offsets,
          const Offsets& max_offsets, const Bounds& bounds, double soft_common_offset, float length, float truncation,
          const Triple& origin, double voxel, int threads, const Volume& sdf, const Volume& gpdf, const Volume& hard,
          const VectorVolume& gradient) {
  const Clusters exact = view_clusters(centers, radii, bounds, max_radii);
  const Clusters smooth = view_clusters(centers, offsets, bounds, max_offsets);
  GridLayout grid{{origin.data()[0], origin.data()[1], origin.data()[2]}, voxel, {}};
  for (size_t a = 0; a < 3; ++a) {
    const size_t n = sdf.shape(a);
    require(n > 0 && gpdf.shape(a) == n && hard.shape(a) == n && gradient.shape(a) == n, "channels: sizes differ");
    grid.size[a] = static_cast<int>(n);
  }
  const nb::gil_scoped_release release;
  bake_grid(exact, smooth, soft_common_offset, length, truncation, grid, threads, sdf.data(), gpdf.data(), hard.data(), gradient.data());
}

GridView view_grid(const ConstVolume& values, const Triple& origin, double voxel) {
  GridView grid{values.data(), {}, {origin.data()[0], origin.data()[1], origin.data()[2]}, voxel};
  for (size_t a = 0; a < 3; ++a) {
    require(values.shape(a) > 1, "values: expected at least two nodes along each axis");
    grid.size[a] = static_cast<long>(values.shape(a));
  }
  return grid;
}

void interpolate(const ConstVolume& values, const Triple& origin, double voxel, const Points64& points,
                 const Values64& value, const Vectors64& gradient) {
  const GridView grid = view_grid(values, origin, voxel);
  const size_t q = points.shape(0);
  require(value.shape(0) == q && gradient.shape(0) == q, "value, gradient: expected one entry per point");
  const nb::gil_scoped_release release;
  interpolate_grid(grid, points.data(), static_cast<long>(q), value.data(), gradient.data());
}

void bound(const ConstVolume& values, const Triple& origin, double voxel, const Points64& points,
           const Values64& lowest) {
  const GridView grid = view_grid(values, origin, voxel);
  require(lowest.shape(0) == points.shape(0), "bound: expected one entry per point");
  const nb::gil_scoped_release release;
  bound_grid(grid, points.data(), static_cast<long>(points.shape(0)), lowest.data());
}

}  // namespace

void bind_field(nb::module_& m) {
  m.def("field_nearest", &nearest, nb::arg("centers").noconvert(), nb::arg("offsets").noconvert(),
        nb::arg("bounds").noconvert(), nb::arg("max_offsets").noconvert(), nb::arg("points").noconvert(),
        nb::arg("threads"), nb::arg("score").noconvert(), nb::arg("gradient").noconvert());
  m.def("field_soft", &soft, nb::arg("centers").noconvert(), nb::arg("offsets").noconvert(),
        nb::arg("bounds").noconvert(), nb::arg("max_offsets").noconvert(), nb::arg("length"), nb::arg("truncation"),
        nb::arg("points").noconvert(), nb::arg("threads"), nb::arg("score").noconvert(),
        nb::arg("gradient").noconvert());
  m.def("field_bake", &bake, nb::arg("centers").noconvert(), nb::arg("radii").noconvert(),
        nb::arg("max_radii").noconvert(), nb::arg("offsets").noconvert(), nb::arg("max_offsets").noconvert(),
        nb::arg("bounds").noconvert(), nb::arg("soft_common_offset"), nb::arg("length"), nb::arg("truncation"),
        nb::arg("origin").noconvert(), nb::arg("voxel"), nb::arg("threads"), nb::arg("sdf").noconvert(), nb::arg("gpdf").noconvert(),
        nb::arg("hard").noconvert(), nb::arg("gradient").noconvert());
  m.def("grid_interpolate", &interpolate, nb::arg("values").noconvert(), nb::arg("origin").noconvert(),
        nb::arg("voxel"), nb::arg("points").noconvert(), nb::arg("value").noconvert(),
        nb::arg("gradient").noconvert());
  m.def("grid_bound", &bound, nb::arg("values").noconvert(), nb::arg("origin").noconvert(), nb::arg("voxel"),
        nb::arg("points").noconvert(), nb::arg("bound").noconvert());
}

}  // namespace splatctrl
