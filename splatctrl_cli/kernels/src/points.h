// What is asked of many points at once: whether views see through them, in which cubes they lie, how far splats and
// solids are. Every answer has the bytes of the NumPy expressions in tests/reference/points.py, at any thread count.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "surface_image.h"

namespace splatctrl {

constexpr int kPointsAtOnce = 1024;  // of a chunk that a thread takes

// out = R p + t, R (9) row-major. As BLAS adds up products where there is a fused multiply-add.
inline void moved(const double* R, const double* t, const double* p, double* out) {
  for (int i = 0; i < 3; ++i) {
#if defined(__FMA__)
    const double turned = std::fma(p[2], R[3 * i + 2], std::fma(p[1], R[3 * i + 1], p[0] * R[3 * i]));
#else
    const double turned = p[0] * R[3 * i] + p[1] * R[3 * i + 1] + p[2] * R[3 * i + 2];
#endif
    out[i] = turned + t[i];
  }
}

// A depth image (H, W) [m], where its camera is, and which of its pixels count: all where chosen is null.
struct ChosenDepth {
  double fx, fy, cx, cy;
  int width, height;
  double rotation[9], translation[3];  // from camera to world
  const float* depth;
  const std::uint8_t* chosen;
};

// The point (3) [m], world, of a pixel.
inline void back_project_pixel(const ChosenDepth& image, std::size_t pixel, double* point) {
  const double u = static_cast<double>(pixel % image.width), v = static_cast<double>(pixel / image.width);
  const double z = image.depth[pixel];
  const double p[3] = {(u - image.cx) / image.fx * z, (v - image.cy) / image.fy * z, z};
  moved(image.rotation, image.translation, p, point);
}

// The points (K, 3) [m], world, of the chosen pixels, row after row.
void back_project(const ChosenDepth& image, double* points, int num_threads);

// is_inside (H, W): 1 where a pixel has a depth of at least min_range [m], and its point lies in a box, low to
// high [m].
void mark_inside(const ChosenDepth& image, const double* low, const double* high, float min_range,
                 std::uint8_t* is_inside, int num_threads);

// nearest (H, W) [m]: the least depth around each pixel, infinite where there is none.
struct NearestDepth {
  double fx, fy, cx, cy;
  int width, height;
  double rotation[9], translation[3];  // from world to camera
  const float* depth;
};

// Pixel (N), row after row, that shows a point (N, 3), -1 outside the image, and the point's depth (N) [m]. The view's
// own depth is not used.
void pixels_at(const double* points, int num_points, const NearestDepth& view, std::int64_t* pixel, float* depth);

// is_seen_through (N): 1 where a view measured a depth more than `tolerance` [m] behind a point (N, 3).
void seen_through(const float* points, int num_points, const NearestDepth* views, int num_views, float tolerance,
                  std::uint8_t* is_seen_through, int num_threads);

// What a cube's points have in common, K cubes in the order of their places, x first: count (K), mean of points and of
// colours (K, 3), mean of the squares of colours (K, 3), covariance xx, xy, xz, yy, yz, zz (K, 6), and the point
// nearest to the mean (K), the first of equals. Sums run in the order of the points.
struct CubeMeans {
  double *count, *center, *color, *square, *covariance;
  std::int64_t* nearest;
};

// The occupied cubes of one edge over points (N, 3) [m].
class Cubes {
 public:
  Cubes(const float* points, int num_points, double edge, int num_threads);

  int size() const { return static_cast<int>(start_.size()) - 1; }
  int num_points() const { return static_cast<int>(order_.size()); }

  // of_point (N): its cube; first (K): the first point of each cube.
  void members(std::int32_t* of_point, std::int64_t* first, int num_threads) const;
  void measure(const float* points, const float* colors, const CubeMeans& out, int num_threads) const;

 private:
  std::vector<std::uint32_t> order_, start_;  // points by cube, and where each cube begins; one more at the end
};

// Balls to look for from many points: a tree that halves their centres.
class SplatTree {
 public:
  SplatTree(const float* centers, const float* radii, int num);

  int size() const { return static_cast<int>(index_.size()); }

  // 1 where a point (K, 3) lies further than `gap` [m] from each of the eight balls with the nearest centres.
  void are_further(const double* points, int num_points, double gap, std::uint8_t* out, int num_threads) const;

 private:
  struct Nearest;
  void build(const float* centers, int first, int last);
  void look(const double* p, int first, int last, Nearest& found) const;

  std::vector<int> index_, axis_;
  std::vector<double> center_, radius_;
  double largest_ = 0.0;
};

// Signed distance (N) [m] of points (N, 3) to the nearest of solids, negative inside, infinite without any.
void solid_distance(const double* points, int num_points, const SurfaceSolid* solids, int num_solids, double* distance,
                    int num_threads);

}  // namespace splatctrl
