#include "surface_image.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

#include "parallel.h"
#include "simd.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

constexpr int kLanes = 8;
constexpr int kRows = 16;      // of a chunk
constexpr double kNear = 1e-3;  // [m] before the camera's plane; nearer, nothing is projected
constexpr float kFar = std::numeric_limits<float>::max();
constexpr float kTiny = 1e-9f;  // stands for a direction's component of 0

struct Span {
  Float8 near, far;
};

struct Ray8 {
  float origin[3];
  Float8 direction[3];
};

inline Float8 choose8(Int8 mask, Float8 yes, Float8 no) { return (Float8)((mask & (Int8)yes) | (~mask & (Int8)no)); }

inline Float8 not_zero(Float8 v) { return choose8((v < kTiny) & (v > -kTiny), splat8(kTiny), v); }

// Between the faces at -half and half of an axis.
inline Span slab(float origin, Float8 direction, float half) {
  const Float8 d = 1.0f / not_zero(direction);
  const Float8 a = (-half - origin) * d, b = (half - origin) * d;
  return {min8(a, b), max8(a, b)};
}

// Inside a circle or ball from a quadratic a t^2 + 2 b t + c <= 0; empty where it has no root.
inline Span round_span(Float8 a, Float8 b, float c) {
  a = max8(a, splat8(kTiny * kTiny));
  const Float8 square = b * b - a * c, root = sqrt8(max8(square, splat8(0.0f)));
  const Int8 is_hit = square >= 0.0f;
  return {choose8(is_hit, (-b - root) / a, splat8(kFar)), choose8(is_hit, (root - b) / a, splat8(-kFar))};
}

inline Span both(Span s, Span t) { return {max8(s.near, t.near), min8(s.far, t.far)}; }

inline Span either(Span s, Span t) {
  const Int8 has_s = s.near <= s.far, has_t = t.near <= t.far;
  return {min8(choose8(has_s, s.near, splat8(kFar)), choose8(has_t, t.near, splat8(kFar))),
          max8(choose8(has_s, s.far, splat8(-kFar)), choose8(has_t, t.far, splat8(-kFar)))};
}

inline Span ball(const Ray8& ray, float radius, float z) {
  const float* o = ray.origin;
  const Float8* d = ray.direction;
  const float up = o[2] - z;
  return round_span(d[0] * d[0] + d[1] * d[1] + d[2] * d[2], o[0] * d[0] + o[1] * d[1] + up * d[2],
                    o[0] * o[0] + o[1] * o[1] + up * up - radius * radius);
}

inline Span cylinder(const Ray8& ray, float radius, float half) {
  const float* o = ray.origin;
  const Float8* d = ray.direction;
  const Span side = round_span(d[0] * d[0] + d[1] * d[1], o[0] * d[0] + o[1] * d[1],
                               o[0] * o[0] + o[1] * o[1] - radius * radius);
  return both(side, slab(o[2], d[2], half));
}

inline Span span_of(const SurfaceSolid& solid, const Ray8& ray) {
  const float a = static_cast<float>(solid.size[0]), b = static_cast<float>(solid.size[1]);
  switch (solid.kind) {
    case SolidKind::kBox:
      return both(both(slab(ray.origin[0], ray.direction[0], a), slab(ray.origin[1], ray.direction[1], b)),
                  slab(ray.origin[2], ray.direction[2], static_cast<float>(solid.size[2])));
    case SolidKind::kCylinder:
      return cylinder(ray, a, b);
    case SolidKind::kBall:
      return ball(ray, a, 0.0f);
    default:  // a capsule is convex: from the first to the last of its parts
      return either(cylinder(ray, a, b), either(ball(ray, a, b), ball(ray, a, -b)));
  }
}

struct PixelBox {
  int left, right, top, bottom;  // from left up to, not including, right
};

// The pixels on which a solid may be seen: those of the box about it.
PixelBox pixels_of(const SurfaceSolid& solid, const SurfaceCamera& camera) {
  double half[3] = {solid.size[0], solid.size[1], solid.size[2]};
  if (solid.kind != SolidKind::kBox) {
    const double end = solid.kind == SolidKind::kCylinder ? solid.size[1] : solid.size[0];
    half[0] = half[1] = solid.size[0];
    half[2] = end + (solid.kind == SolidKind::kCapsule ? solid.size[1] : 0.0);
  }
  double low[2] = {1e9, 1e9}, high[2] = {-1e9, -1e9};
  for (int corner = 0; corner < 8; ++corner) {
    double local[3], p[3];
    for (int i = 0; i < 3; ++i) local[i] = ((corner >> i & 1) ? half[i] : -half[i]) - solid.shift[i];
    for (int i = 0; i < 3; ++i) {
      p[i] = solid.turn[i] * local[0] + solid.turn[3 + i] * local[1] + solid.turn[6 + i] * local[2];
    }
    if (p[2] < kNear) return {0, camera.width, 0, camera.height};
    const double pixel[2] = {camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy};
    for (int i = 0; i < 2; ++i) {
      low[i] = std::min(low[i], pixel[i]);
      high[i] = std::max(high[i], pixel[i]);
    }
  }
  const auto inside = [](double v, int size) { return static_cast<int>(std::clamp(v, 0.0, double(size))); };
  return {inside(std::floor(low[0]), camera.width), inside(std::ceil(high[0]) + 1, camera.width),
          inside(std::floor(low[1]), camera.height), inside(std::ceil(high[1]) + 1, camera.height)};
}

struct Row {  // padded to a multiple of kLanes
  std::vector<float> near, measured, tolerance;
  std::vector<std::int32_t> link, inside;

  explicit Row(int width)
      : near(parts(width, kLanes) * kLanes),
        measured(near.size()),
        tolerance(near.size()),
        link(near.size()),
        inside(near.size()) {}
};

inline Int8 load_int8(const std::int32_t* p) {
  Int8 v;
  std::memcpy(&v, p, sizeof v);
  return v;
}

inline void store_int8(std::int32_t* p, Int8 v) { std::memcpy(p, &v, sizeof v); }

void cast_row(const SurfaceSolid& solid, const PixelBox& box, const SurfaceCamera& camera, int v, Row& row) {
  const double y = (v - camera.cy) / camera.fy;
  Ray8 ray;
  float first[3], step[3];
  for (int i = 0; i < 3; ++i) {
    const double* R = solid.turn + 3 * i;
    ray.origin[i] = static_cast<float>(solid.shift[i]);
    first[i] = static_cast<float>(R[0] * -camera.cx / camera.fx + R[1] * y + R[2]);
    step[i] = static_cast<float>(R[0] / camera.fx);
  }
  const Float8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
  for (int u = box.left / kLanes * kLanes; u < box.right; u += kLanes) {
    const Float8 column = static_cast<float>(u) + lane;
    for (int i = 0; i < 3; ++i) ray.direction[i] = first[i] + column * step[i];
    const Span span = span_of(solid, ray);
    const Int8 is_hit = (span.near <= span.far) & (span.near > 0.0f);
    if (!any8(is_hit)) continue;
    const Float8 before = load8(&row.near[u]);
    const Int8 is_nearer = is_hit & (span.near < before);
    store8(&row.near[u], choose8(is_nearer, span.near, before));
    store_int8(&row.link[u], (is_nearer & solid.link) | (~is_nearer & load_int8(&row.link[u])));
    const Float8 measured = load8(&row.measured[u]), tolerance = load8(&row.tolerance[u]);
    const Int8 is_inside = is_hit & (span.near < measured - tolerance) & (measured + tolerance < span.far);
    store_int8(&row.inside[u], (is_inside & solid.link) | (~is_inside & load_int8(&row.inside[u])));
  }
}

// depth and link (W) where triangles are drawn on row v.
void show_row(const TriangleImage& drawn, const SurfaceMesh& mesh, int v, float* depth, std::int16_t* link) {
  const std::size_t row = static_cast<std::size_t>(v - drawn.top) * drawn.width;
  for (int x = 0; x < drawn.width; ++x) {
    const std::int32_t number = drawn.number[row + x];
    if (number < 0) continue;
    depth[drawn.left + x] = drawn.near[row + x];
    link[drawn.left + x] = mesh.link(number);
  }
}

}  // namespace

void render_surface(const SurfaceCamera& camera, const SurfaceSolid* solids, int num_solids,
                    const PlacedMesh& mesh, const SurfaceMeasurement& measured, const SurfaceImage& out,
                    int num_threads) {
  const TriangleImage drawn = mesh.triangles.draw(mesh.poses, camera);
  std::vector<PixelBox> boxes(num_solids);
  for (int i = 0; i < num_solids; ++i) boxes[i] = pixels_of(solids[i], camera);
  parallel_for(parts(camera.height, kRows), num_threads, [&](int chunk) {
    Row row(camera.width);
    for (int v = chunk * kRows; v < std::min(camera.height, (chunk + 1) * kRows); ++v) {
      const std::size_t first = static_cast<std::size_t>(v) * camera.width;
      float* depth = out.depth + first;
      std::int16_t *link = out.link + first, *inside = out.inside + first;
      std::fill_n(depth, camera.width, 0.0f);
      std::fill_n(link, camera.width, std::int16_t{-1});
      std::fill_n(inside, camera.width, std::int16_t{-1});
      if (v >= drawn.top && v < drawn.top + drawn.height) show_row(drawn, mesh.triangles, v, depth, link);
      const auto is_on_row = [&](const PixelBox& box) { return v >= box.top && v < box.bottom; };
      if (std::none_of(boxes.begin(), boxes.end(), is_on_row)) continue;
      std::fill(row.inside.begin(), row.inside.end(), -1);
      for (int u = 0; u < camera.width; ++u) {
        const float m = measured.depth[first + u];
        row.measured[u] = m;
        row.tolerance[u] = measured.tolerance + measured.quadratic * m * m;
        row.near[u] = link[u] >= 0 ? depth[u] : kFar;
        row.link[u] = link[u];
      }
      for (int i = 0; i < num_solids; ++i) {
        if (is_on_row(boxes[i])) cast_row(solids[i], boxes[i], camera, v, row);
      }
      for (int u = 0; u < camera.width; ++u) {
        const bool is_seen = row.link[u] >= 0;
        depth[u] = is_seen ? row.near[u] : 0.0f;
        link[u] = static_cast<std::int16_t>(row.link[u]);
        inside[u] = static_cast<std::int16_t>(row.inside[u]);
      }
    }
  });
}

}  // namespace splatctrl
