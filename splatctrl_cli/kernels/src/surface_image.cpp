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

// What triangles alone show: nearest depth and its link.
struct TriangleImage {
  std::vector<float> near;
  std::vector<std::int16_t> link;
};

inline double cross(const double* a, const double* b, const double* p) {
  return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
}

// Of two triangles that share an edge through a pixel's centre exactly one has the pixel.
inline bool owns_edge(const double* a, const double* b) { return b[1] < a[1] || (b[1] == a[1] && b[0] > a[0]); }

// corner (3, 3): in the optical frame.
void draw(const double* corner, std::int16_t link, const SurfaceCamera& camera, TriangleImage& out) {
  double p[3][2], inverse[3];  // pixels, 1 / depth
  for (int i = 0; i < 3; ++i) {
    const double* c = corner + 3 * i;
    if (c[2] < kNear) return;
    inverse[i] = 1.0 / c[2];
    p[i][0] = camera.fx * c[0] * inverse[i] + camera.cx;
    p[i][1] = camera.fy * c[1] * inverse[i] + camera.cy;
  }
  const auto least = [&](int k) { return std::min({p[0][k], p[1][k], p[2][k]}); };
  const auto most = [&](int k) { return std::max({p[0][k], p[1][k], p[2][k]}); };
  if (most(0) < 0 || most(1) < 0 || least(0) > camera.width - 1 || least(1) > camera.height - 1) return;
  const int left = static_cast<int>(std::ceil(std::max(least(0), 0.0)));
  const int right = static_cast<int>(std::floor(std::min(most(0), camera.width - 1.0)));
  const int top = static_cast<int>(std::ceil(std::max(least(1), 0.0)));
  const int bottom = static_cast<int>(std::floor(std::min(most(1), camera.height - 1.0)));
  if (left > right || top > bottom) return;
  double area = cross(p[0], p[1], p[2]);
  if (area == 0.0) return;
  if (area > 0.0) {  // v points down: seen from inside
    std::swap(p[1], p[2]);
    std::swap(inverse[1], inverse[2]);
    area = -area;
  }
  for (int v = top; v <= bottom; ++v) {
    for (int u = left; u <= right; ++u) {
      const double at[2] = {double(u), double(v)};
      const double w[3] = {cross(p[1], p[2], at), cross(p[2], p[0], at), cross(p[0], p[1], at)};  // below 0 inside
      bool is_in = true;
      for (int i = 0; i < 3; ++i) {
        is_in &= w[i] < 0.0 || (w[i] == 0.0 && owns_edge(p[(i + 1) % 3], p[(i + 2) % 3]));
      }
      if (!is_in) continue;
      const float z = static_cast<float>(area / (w[0] * inverse[0] + w[1] * inverse[1] + w[2] * inverse[2]));
      const std::size_t pixel = static_cast<std::size_t>(v) * camera.width + u;
      if (z >= out.near[pixel]) continue;
      out.near[pixel] = z;
      out.link[pixel] = link;
    }
  }
}

}  // namespace

void render_surface(const SurfaceCamera& camera, const SurfaceSolid* solids, int num_solids,
                    const SurfaceTriangles& triangles, const SurfaceMeasurement& measured, const SurfaceImage& out,
                    int num_threads) {
  TriangleImage drawn;
  if (triangles.num > 0) {
    const std::size_t size = static_cast<std::size_t>(camera.width) * camera.height;
    drawn = {std::vector<float>(size, kFar), std::vector<std::int16_t>(size, -1)};
    for (int i = 0; i < triangles.num; ++i) {
      const double* pose = triangles.poses + 12 * triangles.link[i];
      double there[9];
      for (int k = 0; k < 9; ++k) {
        const double *row = pose + k % 3 * 4, *c = triangles.corners + 9 * static_cast<std::size_t>(i) + k / 3 * 3;
        there[k] = row[0] * c[0] + row[1] * c[1] + row[2] * c[2] + row[3];
      }
      draw(there, triangles.link[i], camera, drawn);
    }
  }
  std::vector<PixelBox> boxes(num_solids);
  for (int i = 0; i < num_solids; ++i) boxes[i] = pixels_of(solids[i], camera);
  parallel_for(parts(camera.height, kRows), num_threads, [&](int chunk) {
    Row row(camera.width);
    for (int v = chunk * kRows; v < std::min(camera.height, (chunk + 1) * kRows); ++v) {
      const std::size_t first = static_cast<std::size_t>(v) * camera.width;
      std::fill(row.near.begin(), row.near.end(), kFar);
      std::fill(row.link.begin(), row.link.end(), -1);
      std::fill(row.inside.begin(), row.inside.end(), -1);
      for (int u = 0; u < camera.width; ++u) {
        const float m = measured.depth[first + u];
        row.measured[u] = m;
        row.tolerance[u] = measured.tolerance + measured.quadratic * m * m;
        if (triangles.num == 0) continue;
        row.near[u] = drawn.near[first + u];
        row.link[u] = drawn.link[first + u];
      }
      for (int i = 0; i < num_solids; ++i) {
        if (v >= boxes[i].top && v < boxes[i].bottom) cast_row(solids[i], boxes[i], camera, v, row);
      }
      for (int u = 0; u < camera.width; ++u) {
        const bool is_seen = row.link[u] >= 0;
        out.depth[first + u] = is_seen ? row.near[u] : 0.0f;
        out.link[first + u] = static_cast<std::int16_t>(row.link[u]);
        out.inside[first + u] = static_cast<std::int16_t>(row.inside[u]);
      }
    }
  });
}

}  // namespace splatctrl
