#include <nanobind/stl/optional.h>

#include <cmath>
#include <optional>
#include <vector>

#include "bind.h"
#include "field_bake.h"
#include "field_density.h"
#include "field_grid.h"
#include "field_query.h"

namespace splatctrl {
namespace {

using Rows3 = Array<const float, nb::shape<3, -1>>;
using Rows6 = Array<const float, nb::shape<6, -1>>;
using Floats = Array<const float, nb::shape<-1>>;
using Doubles = Array<const double, nb::shape<-1>>;
using Bytes = Array<const unsigned char, nb::shape<-1>>;
using Points = Array<const float, nb::shape<-1, 3>>;
using Points64 = Array<const double, nb::shape<-1, 3>>;
using Values = Array<float, nb::shape<-1>>;
using Vectors = Array<float, nb::shape<-1, 3>>;
using Values64 = Array<double, nb::shape<-1>>;
using Vectors64 = Array<double, nb::shape<-1, 3>>;
using Entries = Array<int, nb::shape<-1>>;
using Volume = Array<float, nb::shape<-1, -1, -1>>;
using ConstVolume = Array<const float, nb::shape<-1, -1, -1>>;
using VectorVolume = Array<float, nb::shape<-1, -1, -1, 3>>;
using EntryVolume = Array<int, nb::shape<-1, -1, -1>>;
using ByteVolume = Array<unsigned char, nb::shape<-1, -1, -1>>;
using ConstByteVolume = Array<const unsigned char, nb::shape<-1, -1, -1>>;
using Triple = Array<const double, nb::shape<3>>;
using Sizes = Array<const long, nb::shape<5>>;  // of the grid (3), and the planes [first, last)

template <typename T>
using Maybe = std::optional<T>;

template <typename T>
auto* data_or_null(const Maybe<T>& array) {
  return array ? array->data() : nullptr;
}

Clusters view_clusters(const Rows3& centers, const Rows6& boxes) {
  const size_t m = centers.shape(1), all = boxes.shape(1), n = m / kLanes;
  expect(n > 0 && m % (kLanes * kLanes) == 0 && all > n && (all - n) % 8 == 0 && kLanes * (all - n) >= n,
         "clusters: expected centers (3, 16 C), C a multiple of 16, and boxes (6, C + G), G a multiple of 8");
  const float *c = centers.data(), *b = boxes.data();
  return {static_cast<int>(n), static_cast<int>(all - n), c, c + m, c + 2 * m,
          {b, b + all, b + 2 * all, b + 3 * all, b + 4 * all, b + 5 * all}};
}

Offsets view_offsets(const Clusters& s, const Floats& values, const Floats& maxima) {
  expect(values.shape(0) == static_cast<size_t>(kLanes * s.num_clusters), "offsets: expected (16 C)");
  expect(maxima.shape(0) == static_cast<size_t>(s.num_clusters + s.num_groups), "maxima: expected (C + G)");
  return {values.data(), maxima.data()};
}

template <typename T>
void expect_per_sphere(const Clusters& s, const T& array, const char* what) {
  expect(array.shape(0) == static_cast<size_t>(kLanes * s.num_clusters), what);
}

Query view_query(const Points& points, int threads, const Values& score, const Vectors& gradient) {
  const size_t q = points.shape(0);
  expect(score.shape(0) == q && gradient.shape(0) == q, "score, gradient: expected one entry per point");
  return {points.data(), static_cast<int>(q), threads, score.data(), gradient.data()};
}

void nearest(const Rows3& centers, const Rows6& boxes, const Floats& radii, const Floats& maxima, const Points& points,
             int threads, const Values& score, const Vectors& gradient, const Entries& entry) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, radii, maxima);
  const Query query = view_query(points, threads, score, gradient);
  expect(entry.shape(0) == points.shape(0), "entry: expected one per point");
  const nb::gil_scoped_release release;
  query_nearest(spheres, offsets, query, entry.data());
}

void matern(const Rows3& centers, const Rows6& boxes, const Floats& values, const Floats& maxima, const Maybe<Floats>& sign,
            float length, float truncation, const Points& points, int threads, const Values& score, const Vectors& gradient) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, values, maxima);
  if (sign) expect_per_sphere(spheres, *sign, "sign: expected (16 C)");
  const Query query = view_query(points, threads, score, gradient);
  const nb::gil_scoped_release release;
  query_matern(spheres, offsets, data_or_null(sign), length, truncation, query);
}

void gaussian(const Rows3& centers, const Rows6& boxes, const Floats& values, const Floats& maxima, const Floats& radii,
              const Maybe<Floats>& sign, double common, float length, float tolerance, const Points& points, int threads,
              const Values& score, const Vectors& gradient) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, values, maxima);
  expect_per_sphere(spheres, radii, "radii: expected (16 C)");
  if (sign) expect_per_sphere(spheres, *sign, "sign: expected (16 C)");
  const Query query = view_query(points, threads, score, gradient);
  const nb::gil_scoped_release release;
  query_gaussian(spheres, offsets, radii.data(), data_or_null(sign), common, length, tolerance, query);
}

// True where every point is finite; else nothing is asked.
bool safe(const Rows3& centers, const Rows6& boxes, const Floats& values, const Floats& maxima, const Floats& radii,
          const Floats& radius_maxima, const Maybe<Floats>& sign, double common, float length, float tolerance,
          const Triple& anchor, const Points64& points, int threads, const Values64& score, const Vectors64& gradient) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, values, maxima), radius_offsets = view_offsets(spheres, radii, radius_maxima);
  if (sign) expect_per_sphere(spheres, *sign, "sign: expected (16 C)");
  const size_t q = points.shape(0);
  expect(score.shape(0) == q && gradient.shape(0) == q, "score, gradient: expected one entry per point");
  const nb::gil_scoped_release release;
  std::vector<float> local(7 * q);  // points, then scores, then gradients
  bool is_finite = true;
  for (size_t k = 0; k < 3 * q; ++k) {
    const double moved = points.data()[k] - anchor.data()[k % 3];
    is_finite = is_finite && std::isfinite(moved);
    local[k] = static_cast<float>(moved);
  }
  if (!is_finite) return false;
  float *scores = local.data() + 3 * q, *gradients = local.data() + 4 * q;
  const Query query{local.data(), static_cast<int>(q), threads, scores, gradients};
  query_safe(spheres, offsets, radius_offsets, data_or_null(sign), common, length, tolerance, query);
  for (size_t k = 0; k < q; ++k) score.data()[k] = scores[k];
  for (size_t k = 0; k < 3 * q; ++k) gradient.data()[k] = gradients[k];
  return true;
}

void density(const Rows3& centers, const Rows6& boxes, const Bytes& has_sphere, bool is_matern, float length, int threads,
             const Values64& sum) {
  const Clusters spheres = view_clusters(centers, boxes);
  expect_per_sphere(spheres, has_sphere, "has_sphere: expected (16 C)");
  expect_per_sphere(spheres, sum, "sum: expected (16 C)");
  const nb::gil_scoped_release release;
  row_sums(spheres, has_sphere.data(), is_matern ? Kernel::kMatern : Kernel::kGaussian, length, threads, sum.data());
}

GridSpan view_span(const Triple& origin, double voxel, const Sizes& sizes, const Maybe<ConstByteVolume>& mask, int threads) {
  GridSpan span{{origin.data()[0], origin.data()[1], origin.data()[2]}, voxel, {}, 0, 0, nullptr, threads};
  for (int a = 0; a < 3; ++a) span.size[a] = static_cast<int>(sizes.data()[a]);
  span.first = static_cast<int>(sizes.data()[3]), span.last = static_cast<int>(sizes.data()[4]);
  expect(span.first >= 0 && span.first % kBlock == 0 && span.first < span.last && span.last <= span.size[0] &&
             (span.last % kBlock == 0 || span.last == span.size[0]),
         "planes: expected [first, last) of whole blocks within the grid");
  if (mask) {
    for (int a = 0; a < 3; ++a)
      expect(mask->shape(a) == static_cast<size_t>(span.blocks(a)), "mask: expected one entry per block");
    span.mask = mask->data();
  }
  return span;
}

template <typename T>
void expect_span(const GridSpan& span, const T& array) {
  expect(array.shape(0) == static_cast<size_t>(span.last - span.first) && array.shape(1) == static_cast<size_t>(span.size[1]) &&
             array.shape(2) == static_cast<size_t>(span.size[2]),
         "channel: expected the planes of the span");
}

void hard(const Rows3& centers, const Rows6& boxes, const Floats& radii, const Floats& maxima, const Triple& origin, double voxel,
          const Sizes& sizes, const Maybe<ConstByteVolume>& mask, int threads, const Volume& distance,
          const Maybe<VectorVolume>& gradient, const Maybe<EntryVolume>& entry) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, radii, maxima);
  const GridSpan span = view_span(origin, voxel, sizes, mask, threads);
  expect_span(span, distance);
  if (gradient) expect_span(span, *gradient);
  if (entry) expect_span(span, *entry);
  const nb::gil_scoped_release release;
  bake_hard(spheres, offsets, span, distance.data(), data_or_null(gradient), data_or_null(entry));
}

void bake_gaussian_field(const Rows3& centers, const Rows6& boxes, const Floats& values, const Floats& maxima,
                         const Doubles& log_weight, const Floats& radii, const Maybe<Floats>& sign, float length,
                         float tolerance, const Triple& origin, double voxel, const Sizes& sizes,
                         const Maybe<ConstByteVolume>& mask, int threads, const Volume& distance,
                         const Maybe<VectorVolume>& gradient) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, values, maxima);
  expect_per_sphere(spheres, log_weight, "log_weight: expected (16 C)");
  expect_per_sphere(spheres, radii, "radii: expected (16 C)");
  if (sign) expect_per_sphere(spheres, *sign, "sign: expected (16 C)");
  const GridSpan span = view_span(origin, voxel, sizes, mask, threads);
  expect_span(span, distance);
  if (gradient) expect_span(span, *gradient);
  const nb::gil_scoped_release release;
  bake_gaussian(spheres, offsets, {log_weight.data(), radii.data(), data_or_null(sign)}, length, tolerance, span,
                distance.data(), data_or_null(gradient));
}

void bake_matern_field(const Rows3& centers, const Rows6& boxes, const Floats& values, const Floats& maxima,
                       const Doubles& offset, const Maybe<Floats>& sign, float length, float truncation, const Triple& origin,
                       double voxel, const Sizes& sizes, const Maybe<ConstByteVolume>& mask, int threads,
                       const Volume& distance, const Maybe<VectorVolume>& gradient) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, values, maxima);
  expect_per_sphere(spheres, offset, "offset: expected (16 C)");
  if (sign) expect_per_sphere(spheres, *sign, "sign: expected (16 C)");
  const GridSpan span = view_span(origin, voxel, sizes, mask, threads);
  expect_span(span, distance);
  if (gradient) expect_span(span, *gradient);
  const nb::gil_scoped_release release;
  bake_matern(spheres, offsets, offset.data(), data_or_null(sign), length, truncation, span, distance.data(),
              data_or_null(gradient));
}

void touched(const Rows3& centers, const Rows6& boxes, const Floats& values, const Floats& maxima, const Bytes& changed,
             float length, const Triple& origin, double voxel, const Sizes& sizes, int threads, const ByteVolume& is_touched) {
  const Clusters spheres = view_clusters(centers, boxes);
  const Offsets offsets = view_offsets(spheres, values, maxima);
  expect_per_sphere(spheres, changed, "changed: expected (16 C)");
  const GridSpan span = view_span(origin, voxel, sizes, std::nullopt, threads);
  for (int a = 0; a < 3; ++a)
    expect(is_touched.shape(a) == static_cast<size_t>(span.blocks(a)), "is_touched: expected one entry per block");
  const nb::gil_scoped_release release;
  touched_blocks(spheres, offsets, changed.data(), length, span, is_touched.data());
}

GridView view_grid(const ConstVolume& values, const Triple& origin, double voxel) {
  GridView grid{values.data(), {}, {origin.data()[0], origin.data()[1], origin.data()[2]}, voxel};
  for (size_t a = 0; a < 3; ++a) {
    expect(values.shape(a) > 1, "values: expected at least two nodes along each axis");
    grid.size[a] = static_cast<long>(values.shape(a));
  }
  return grid;
}

void interpolate(const ConstVolume& values, const Triple& origin, double voxel, const Points64& points,
                 const Values64& value, const Vectors64& gradient) {
  const GridView grid = view_grid(values, origin, voxel);
  const size_t q = points.shape(0);
  expect(value.shape(0) == q && gradient.shape(0) == q, "value, gradient: expected one entry per point");
  const nb::gil_scoped_release release;
  interpolate_grid(grid, points.data(), static_cast<long>(q), value.data(), gradient.data());
}

void bound(const ConstVolume& values, const Triple& origin, double voxel, const Points64& points,
           const Values64& lowest) {
  const GridView grid = view_grid(values, origin, voxel);
  expect(lowest.shape(0) == points.shape(0), "bound: expected one entry per point");
  const nb::gil_scoped_release release;
  bound_grid(grid, points.data(), static_cast<long>(points.shape(0)), lowest.data());
}

}  // namespace

void bind_field(nb::module_& m) {
  m.def("field_nearest", &nearest, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(), nb::arg("radii").noconvert(),
        nb::arg("maxima").noconvert(), nb::arg("points").noconvert(), nb::arg("threads"), nb::arg("score").noconvert(),
        nb::arg("gradient").noconvert(), nb::arg("entry").noconvert());
  m.def("field_matern", &matern, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(), nb::arg("offsets").noconvert(),
        nb::arg("maxima").noconvert(), nb::arg("sign").noconvert().none(), nb::arg("length"), nb::arg("truncation"),
        nb::arg("points").noconvert(), nb::arg("threads"), nb::arg("score").noconvert(), nb::arg("gradient").noconvert());
  m.def("field_gaussian", &gaussian, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(),
        nb::arg("offsets").noconvert(), nb::arg("maxima").noconvert(), nb::arg("radii").noconvert(),
        nb::arg("sign").noconvert().none(), nb::arg("common"), nb::arg("length"), nb::arg("tolerance"),
        nb::arg("points").noconvert(), nb::arg("threads"), nb::arg("score").noconvert(), nb::arg("gradient").noconvert());
  m.def("field_safe", &safe, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(), nb::arg("offsets").noconvert(),
        nb::arg("maxima").noconvert(), nb::arg("radii").noconvert(), nb::arg("radius_maxima").noconvert(),
        nb::arg("sign").noconvert().none(), nb::arg("common"), nb::arg("length"), nb::arg("tolerance"),
        nb::arg("anchor").noconvert(), nb::arg("points").noconvert(), nb::arg("threads"), nb::arg("score").noconvert(),
        nb::arg("gradient").noconvert());
  m.def("field_density", &density, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(),
        nb::arg("has_sphere").noconvert(), nb::arg("is_matern"), nb::arg("length"), nb::arg("threads"),
        nb::arg("sum").noconvert());
  m.def("field_bake_hard", &hard, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(), nb::arg("radii").noconvert(),
        nb::arg("maxima").noconvert(), nb::arg("origin").noconvert(), nb::arg("voxel"), nb::arg("sizes").noconvert(),
        nb::arg("mask").noconvert().none(), nb::arg("threads"), nb::arg("distance").noconvert(),
        nb::arg("gradient").noconvert().none(), nb::arg("entry").noconvert().none());
  m.def("field_bake_gaussian", &bake_gaussian_field, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(),
        nb::arg("offsets").noconvert(), nb::arg("maxima").noconvert(), nb::arg("log_weight").noconvert(),
        nb::arg("radii").noconvert(), nb::arg("sign").noconvert().none(), nb::arg("length"), nb::arg("tolerance"),
        nb::arg("origin").noconvert(), nb::arg("voxel"), nb::arg("sizes").noconvert(), nb::arg("mask").noconvert().none(),
        nb::arg("threads"), nb::arg("distance").noconvert(), nb::arg("gradient").noconvert().none());
  m.def("field_bake_matern", &bake_matern_field, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(),
        nb::arg("offsets").noconvert(), nb::arg("maxima").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("sign").noconvert().none(), nb::arg("length"), nb::arg("truncation"), nb::arg("origin").noconvert(),
        nb::arg("voxel"), nb::arg("sizes").noconvert(), nb::arg("mask").noconvert().none(), nb::arg("threads"),
        nb::arg("distance").noconvert(), nb::arg("gradient").noconvert().none());
  m.def("field_touched", &touched, nb::arg("centers").noconvert(), nb::arg("boxes").noconvert(), nb::arg("offsets").noconvert(),
        nb::arg("maxima").noconvert(), nb::arg("changed").noconvert(), nb::arg("length"), nb::arg("origin").noconvert(),
        nb::arg("voxel"), nb::arg("sizes").noconvert(), nb::arg("threads"), nb::arg("is_touched").noconvert());
  m.def("grid_interpolate", &interpolate, nb::arg("values").noconvert(), nb::arg("origin").noconvert(),
        nb::arg("voxel"), nb::arg("points").noconvert(), nb::arg("value").noconvert(),
        nb::arg("gradient").noconvert());
  m.def("grid_bound", &bound, nb::arg("values").noconvert(), nb::arg("origin").noconvert(), nb::arg("voxel"),
        nb::arg("points").noconvert(), nb::arg("bound").noconvert());
}

}  // namespace splatctrl
