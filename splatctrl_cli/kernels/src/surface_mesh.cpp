#include "surface_mesh.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>

#if defined(__AVX__)
#include <immintrin.h>
#endif

namespace splatctrl {
namespace {

constexpr double kNear = 1e-3;      // [m] before the camera's plane; nearer, nothing is projected
constexpr double kNeedle = 1e-9;    // area over squared size, below which rounding decides what a triangle shows
constexpr double kRounding = 1e-5;  // of a depth, at most, on a triangle that is no needle
constexpr float kFar = std::numeric_limits<float>::max();

// Of a corner on the image: its pixel u and v, its depth and 1 / depth.
typedef double Double4 __attribute__((vector_size(32), aligned(32)));
typedef std::int64_t Long4 __attribute__((vector_size(32), aligned(32)));

#if defined(__AVX__)
inline Double4 min4(Double4 a, Double4 b) { return (Double4)_mm256_min_pd((__m256d)a, (__m256d)b); }
inline Double4 max4(Double4 a, Double4 b) { return (Double4)_mm256_max_pd((__m256d)a, (__m256d)b); }
inline unsigned signs4(Long4 v) { return static_cast<unsigned>(_mm256_movemask_pd((__m256d)v)); }
#else
inline Double4 min4(Double4 a, Double4 b) { return a < b ? a : b; }
inline Double4 max4(Double4 a, Double4 b) { return a > b ? a : b; }
inline unsigned signs4(Long4 v) {
  unsigned bits = 0;
  for (int lane = 0; lane < 4; ++lane) bits |= static_cast<unsigned>(v[lane] < 0) << lane;
  return bits;
}
#endif

struct Corner {
  Double4 at;
};

// What a triangle may show: pixels from left to right and from top to bottom, the last included, and a depth [m] that
// none of it lies before.
struct Candidate {
  std::int32_t number;
  int left, right, top, bottom;
  float nearest;
};

// Twice the area of three corners on the image; below 0 where they are seen from outside: v points down.
inline double area_of(Double4 a, Double4 b, Double4 c) {
  return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
}

// False where no pixel of the image shows the triangle.
inline bool find_pixels(Double4 a, Double4 b, Double4 c, double area, const TriangleImage& image, Candidate& out) {
  const Double4 low = min4(min4(a, b), c), high = max4(max4(a, b), c);
  if (low[2] < kNear || area == 0.0) return false;
  const double left = image.left, top = image.top;
  out.left = static_cast<int>(std::ceil(std::clamp(low[0], left, left + image.width)));
  out.right = static_cast<int>(std::floor(std::clamp(high[0], left - 1, left + image.width - 1)));
  out.top = static_cast<int>(std::ceil(std::clamp(low[1], top, top + image.height)));
  out.bottom = static_cast<int>(std::floor(std::clamp(high[1], top - 1, top + image.height - 1)));
  if (out.left > out.right || out.top > out.bottom) return false;
  const double size = std::max({-low[0], -low[1], high[0], high[1]});
  const bool is_needle = !(std::fabs(area) > kNeedle * size * size);
  out.nearest = is_needle ? 0.0f : static_cast<float>((1.0 - kRounding) * low[2]);
  return true;
}

// a, b, c are seen from outside; area: twice theirs.
void draw_triangle(Double4 a, Double4 b, Double4 c, double area, const Candidate& one, TriangleImage& out) {
  // Edge k lies opposite to corner k. Of two triangles that share an edge through a pixel's centre one owns the pixel.
  const Double4 u = {b[0], c[0], a[0], 0.0}, du = Double4{c[0], a[0], b[0], 0.0} - u;
  const Double4 v = {b[1], c[1], a[1], 0.0}, dv = Double4{c[1], a[1], b[1], 0.0} - v;
  const unsigned owned = signs4((dv < 0.0) | ((dv == 0.0) & (du > 0.0)));
  for (int y = one.top; y <= one.bottom; ++y) {
    const std::size_t row = static_cast<std::size_t>(y - out.top) * out.width;
    const Double4 down = du * (static_cast<double>(y) - v);
    for (int x = one.left; x <= one.right; ++x) {
      const std::size_t pixel = row + (x - out.left);
      float& near = out.near[pixel];
      if (near < one.nearest) continue;
      const Double4 w = down - dv * (static_cast<double>(x) - u);  // below 0 inside
      const unsigned inside = signs4(w < 0.0) | (signs4(w == 0.0) & owned);
      if ((inside & 7u) != 7u) continue;
      const float z = static_cast<float>(area / (w[0] * a[3] + w[1] * b[3] + w[2] * c[3]));
      std::int32_t& number = out.number[pixel];
      if (z > near || (z == near && number < one.number)) continue;
      near = z;
      number = one.number;
    }
  }
}

}  // namespace

SurfaceMesh::SurfaceMesh(const double* corners, const std::int16_t* links, int num)
    : links_(links, links + num), faces_(3 * static_cast<std::size_t>(num)) {
  std::size_t size = 8;
  while (size < 2 * faces_.size()) size *= 2;
  std::vector<std::int32_t> table(size, -1);  // of corners, by their bytes and their link
  for (std::size_t i = 0; i < faces_.size(); ++i) {
    const std::int16_t link = links[i / 3];
    std::uint64_t bits[3], hash = static_cast<std::uint64_t>(link);
    std::memcpy(bits, corners + 3 * i, sizeof bits);
    for (const std::uint64_t part : bits) hash = (hash ^ part) * 0x9e3779b97f4a7c15u;
    std::size_t at = (hash >> 20) & (size - 1);
    const auto is_other = [&](std::size_t k) {
      return corner_links_[k] != link || std::memcmp(&corners_[3 * k], bits, sizeof bits) != 0;
    };
    while (table[at] >= 0 && is_other(table[at])) at = (at + 1) & (size - 1);
    if (table[at] < 0) {
      table[at] = static_cast<std::int32_t>(corner_links_.size());
      corner_links_.push_back(link);
      corners_.insert(corners_.end(), corners + 3 * i, corners + 3 * i + 3);
      num_links_ = std::max(num_links_, link + 1);
    }
    faces_[i] = table[at];
  }
}

TriangleImage SurfaceMesh::draw(const double* poses, const SurfaceCamera& camera) const {
  constexpr double kInfinite = std::numeric_limits<double>::infinity();
  std::vector<Corner> there(corner_links_.size());
  Double4 low = Double4{} + kInfinite, high = Double4{} - kInfinite;
  for (std::size_t i = 0; i < there.size(); ++i) {
    const double *T = poses + 12 * corner_links_[i], *c = &corners_[3 * i];
    double p[3];
    for (int k = 0; k < 3; ++k, T += 4) p[k] = T[0] * c[0] + T[1] * c[1] + T[2] * c[2] + T[3];
    const double inverse = 1.0 / p[2];
    const Double4 at = {camera.fx * p[0] * inverse + camera.cx, camera.fy * p[1] * inverse + camera.cy, p[2], inverse};
    there[i].at = at;
    if (p[2] < kNear) continue;
    low = min4(low, at);
    high = max4(high, at);
  }
  TriangleImage out;
  if (!(low[0] <= high[0])) return out;
  out.left = static_cast<int>(std::ceil(std::clamp(low[0], 0.0, double(camera.width))));
  out.top = static_cast<int>(std::ceil(std::clamp(low[1], 0.0, double(camera.height))));
  out.width = static_cast<int>(std::floor(std::clamp(high[0], -1.0, camera.width - 1.0))) + 1 - out.left;
  out.height = static_cast<int>(std::floor(std::clamp(high[1], -1.0, camera.height - 1.0))) + 1 - out.top;
  if (out.width <= 0 || out.height <= 0) return {};
  const std::size_t size = static_cast<std::size_t>(out.width) * out.height;
  out.near.assign(size, kFar);
  out.number.assign(size, -1);
  std::vector<Candidate> from_inside;  // behind the others, most of them
  from_inside.reserve(links_.size());
  Candidate one;
  for (one.number = 0; one.number < static_cast<int>(links_.size()); ++one.number) {
    const std::int32_t* face = &faces_[3 * static_cast<std::size_t>(one.number)];
    const Double4 a = there[face[0]].at, b = there[face[1]].at, c = there[face[2]].at;
    const double area = area_of(a, b, c);
    if (!find_pixels(a, b, c, area, out, one)) continue;
    if (area < 0.0) {
      draw_triangle(a, b, c, area, one, out);
    } else {
      from_inside.push_back(one);
    }
  }
  for (const Candidate& each : from_inside) {
    const std::int32_t* face = &faces_[3 * static_cast<std::size_t>(each.number)];
    const Double4 a = there[face[0]].at, b = there[face[1]].at, c = there[face[2]].at;
    draw_triangle(a, c, b, -area_of(a, b, c), each, out);
  }
  return out;
}

}  // namespace splatctrl
