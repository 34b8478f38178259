// Spheres, the boxes around them, and the cells of a grid: what bounds a distance, of one float or of eight. The card's
// kernels are made of the same lines.
//
// The fields are made of scores s_i(x) = |x - p_i| - o_i (exact distance: o = r; Matern: o = r + l log w) or of
// squared ones q_i(x) = |x - p_i|^2 - b_i (squared exponential: b = 2 l^2 log w). A score changes by no more than one
// moves, and inside a box it is at least (distance to the box) - (largest offset): all culls rest on these two facts.
#pragma once

#include <cmath>

#include "host_device.h"
#if !defined(__CUDACC__)
#include "simd.h"
#endif

namespace splatctrl {

constexpr int kLanes = 16;  // spheres of a cluster, clusters of a group
constexpr float kFar = 3e38f;
constexpr int kBlock = 8, kSubBlock = 4;  // cells along each axis
constexpr float kSqrt3 = 1.7320508f;

struct Point {
  float x, y, z;
};

// Views of C clusters (a multiple of 16) and G groups (a multiple of 8). Boxes (6, C + G): lower then upper corner,
// clusters then groups. Spare entries stand far away with an offset of -1e30.
struct Clusters {
  int num_clusters, num_groups;
  const float *x, *y, *z;  // (16 C)
  const float* boxes[6];   // (C + G) each
};

// One offset for each sphere, and the largest of each cluster and group.
struct Offsets {
  const float* value;    // (16 C)
  const float* maximum;  // (C + G)
};

// The least score at a point and the first entry that has it.
struct Nearest {
  float score;
  int entry;
};

SPLATCTRL_HOST_DEVICE inline float root(float v) { return std::sqrt(v); }
SPLATCTRL_HOST_DEVICE inline float smaller(float a, float b) { return a < b ? a : b; }
SPLATCTRL_HOST_DEVICE inline float larger(float a, float b) { return a > b ? a : b; }
#if !defined(__CUDACC__)
inline Float8 root(Float8 v) { return sqrt8(v); }
inline Float8 smaller(Float8 a, Float8 b) { return min8(a, b); }
inline Float8 larger(Float8 a, Float8 b) { return max8(a, b); }
#endif

struct Box {
  float lower[3], upper[3];
};

// Of a Box, or of eight.
template <typename Boxes>
SPLATCTRL_HOST_DEVICE inline auto squared_box_distance(const Boxes& box, Point q) {
  const auto dx = larger(box.lower[0] - q.x, q.x - box.upper[0]);
  const auto dy = larger(box.lower[1] - q.y, q.y - box.upper[1]);
  const auto dz = larger(box.lower[2] - q.z, q.z - box.upper[2]);
  const decltype(dx + dy) zero{};
  const auto x = larger(dx, zero), y = larger(dy, zero), z = larger(dz, zero);
  return x * x + y * y + z * z;
}

template <typename Boxes>
SPLATCTRL_HOST_DEVICE inline auto squared_farthest_corner(const Boxes& box, Point q) {
  const auto dx = larger(q.x - box.lower[0], box.upper[0] - q.x);
  const auto dy = larger(q.y - box.lower[1], box.upper[1] - q.y);
  const auto dz = larger(q.z - box.lower[2], box.upper[2] - q.z);
  return dx * dx + dy * dy + dz * dz;
}

// The kinds of score, of a squared distance and an offset; a bound of a box is the same of its distance and maximum.
struct LinearScore {
  template <typename F>
  SPLATCTRL_HOST_DEVICE static F of(F squared, F offset) {
    return root(squared) - offset;
  }
};
struct SquaredScore {
  template <typename F>
  SPLATCTRL_HOST_DEVICE static F of(F squared, F offset) {
    return squared - offset;
  }
};

SPLATCTRL_HOST_DEVICE inline float size_of(float v) { return v < 0.0f ? -v : v; }

// What float32 may have lost in any score near `score` at q: added to every threshold, so that culls stay exact.
SPLATCTRL_HOST_DEVICE inline float rounding_slack(Point q, float score) {
  return 4e-6f * (size_of(q.x) + size_of(q.y) + size_of(q.z) + size_of(score)) + 1e-30f;
}

// By how much the logarithm of the Gaussian sum may fall short where the distance is `distance`, so that the distance
// grows by no more than `tolerance`: (d + t)^2 - d^2 = 2 l^2 log_share. At most a thousandth, for the gradient's sake.
SPLATCTRL_HOST_DEVICE inline float gaussian_log_share(float distance, float tolerance, float length) {
  const float d = distance > tolerance ? 2.0f * distance - tolerance : tolerance;
  const float share = 0.5f * (tolerance / length) * (d / length);
  return share < 1e-3f ? share : 1e-3f;
}

// How much the difference of the distances to a and b can change within `radius` of a point at distances d_a and d_b
// from them; apart = |a - b|. Unit vectors u = (x - a) / |x - a|, v alike differ by at most 2 |a - b| / (|x - a| + |x - b|)
// (Dunkl and Williams, 1964), and by no more than 2.
template <typename F>
SPLATCTRL_HOST_DEVICE inline F turn(F apart, F d_a, float d_b, float radius) {
  const F reach = larger(d_a + (d_b - 2.0f * radius), F{} + 1e-30f);
  return radius * smaller(2.0f * apart / reach, F{} + 2.0f);
}

// Cells (i, j, k) centred at origin + voxel (i, j, k), in the frame of the spheres. Only the x-planes [first, last) are
// baked, into arrays of their own; `first` is a multiple of 8. mask: one byte per block of the whole grid (8 cells
// each way), zero where the block keeps what it has; null where all are baked.
struct GridSpan {
  double origin[3];
  double voxel;
  int size[3];
  int first, last;
  const unsigned char* mask;
  int num_threads;

  SPLATCTRL_HOST_DEVICE int blocks(int axis) const { return (size[axis] + kBlock - 1) / kBlock; }
  // Where cell (i, j, k) stands in the arrays.
  SPLATCTRL_HOST_DEVICE long cell(int i, int j, int k) const {
    return (static_cast<long>(i - first) * size[1] + j) * size[2] + k;
  }
  // Half the diagonal of the centres of `cells`^3 cells.
  SPLATCTRL_HOST_DEVICE float radius(int cells) const {
    return 0.5f * static_cast<float>((cells - 1) * voxel) * kSqrt3 * 1.000001f;
  }
};

// The middle of the centres of `cells`^3 cells.
SPLATCTRL_HOST_DEVICE inline Point middle(const GridSpan& grid, const int* lowest, int cells) {
  const double half = 0.5 * (cells - 1);
  return {static_cast<float>(grid.origin[0] + grid.voxel * (lowest[0] + half)),
          static_cast<float>(grid.origin[1] + grid.voxel * (lowest[1] + half)),
          static_cast<float>(grid.origin[2] + grid.voxel * (lowest[2] + half))};
}

// The same relative to `base`: less is lost than in the difference of two rounded points.
SPLATCTRL_HOST_DEVICE inline Point middle_from(const GridSpan& grid, const int* lowest, int cells, Point base) {
  const double half = 0.5 * (cells - 1);
  return {static_cast<float>(grid.origin[0] + grid.voxel * (lowest[0] + half) - base.x),
          static_cast<float>(grid.origin[1] + grid.voxel * (lowest[1] + half) - base.y),
          static_cast<float>(grid.origin[2] + grid.voxel * (lowest[2] + half) - base.z)};
}

}  // namespace splatctrl
