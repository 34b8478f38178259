// What the kernels of the fields share: a warp walks the spheres of the processor's field_clusters.h for one point, or
// for 4^3 cells of a grid.
//
// A lane's sum is over terms in the order of the entries, and lanes are added in one fixed order: no result depends on
// the order in which threads run.
#pragma once

#include <cstdint>

#include "device.h"
#include "field_geometry.h"

namespace splatctrl {

constexpr int kWarp = 32, kWarps = 4;  // lanes of a warp, warps of a block
constexpr float kLog2e = 1.44269504f;

// One field, and what is asked of it. At points: (Q, 3) in the frame that the spheres' anchor is in, answers (Q) and
// (Q, 3). On a grid the answers are (X, Y, Z) and (X, Y, Z, 3) of the span. What is not wanted is null.
struct FieldTask {
  Clusters spheres;
  Offsets offsets;      // radii, or o or b of the scores: for the kernel fields they only cull
  const double* exact;  // (16 C): o, or log |w|
  const float* radius;  // (16 C)
  const float* sign;    // (16 C) or null
  float length, tolerance;  // of Matern the share that terms left out may have
  float largest_radius;     // a mean radius beyond it has no distance
  float log_count;          // of the entries
  GridSpan grid;
  double anchor[3];
  const double* points;
  int num_points;
  float *distance, *gradient;
  std::int32_t* entry;
};

__device__ inline int lane_of_thread() { return static_cast<int>(threadIdx.x) % kWarp; }
__device__ inline int warp_of_grid() {
  return static_cast<int>(blockIdx.x) * kWarps + static_cast<int>(threadIdx.x) / kWarp;
}

__device__ inline float warp_sum(float v) {
#pragma unroll
  for (int step = kWarp / 2; step > 0; step /= 2) v += __shfl_xor_sync(kAllLanes, v, step);
  return v;
}

__device__ inline bool is_less(Nearest a, Nearest b) {
  return a.score < b.score || (a.score == b.score && a.entry < b.entry);
}

__device__ inline Nearest warp_least(Nearest n) {
#pragma unroll
  for (int step = kWarp / 2; step > 0; step /= 2) {
    const Nearest other{__shfl_xor_sync(kAllLanes, n.score, step), __shfl_xor_sync(kAllLanes, n.entry, step)};
    if (is_less(other, n)) n = other;
  }
  return n;
}

__device__ inline Point place_of(const Clusters& s, int entry) { return {s.x[entry], s.y[entry], s.z[entry]}; }

__device__ inline float squared_length(float x, float y, float z) { return x * x + y * y + z * z; }

__device__ inline float squared_distance(Point a, Point b) { return squared_length(a.x - b.x, a.y - b.y, a.z - b.z); }

__device__ inline Box box_at(const Clusters& s, int box) {
  return {{s.boxes[0][box], s.boxes[1][box], s.boxes[2][box]}, {s.boxes[3][box], s.boxes[4][box], s.boxes[5][box]}};
}

// Takes the two lowest bits off a mask: the first for lanes 0 to 15, the second (-1 without one) for the others.
__device__ inline int take_two(unsigned& bits, int lane) {
  const int first = __ffs(static_cast<int>(bits)) - 1;
  bits &= bits - 1;
  const int second = bits == 0 ? -1 : __ffs(static_cast<int>(bits)) - 1;
  bits &= bits - 1;
  return lane < kLanes ? first : second;
}

// Calls visit(entry, or -1) for the spheres of the clusters that are kept, two clusters at a time in their order;
// keeps(box) of the boxes of groups, then of clusters. All lanes come along.
template <class Keeps, class Visit>
__device__ void walk(const Clusters& s, int lane, const Keeps& keeps, const Visit& visit) {
  const int num_groups = s.num_clusters / kLanes;
  for (int begin = 0; begin < num_groups; begin += kWarp) {
    const int group = begin + lane;
    unsigned groups = __ballot_sync(kAllLanes, group < num_groups && keeps(s.num_clusters + group));
    while (groups != 0) {
      const int mine = take_two(groups, lane);
      const int first = kLanes * (begin + mine);
      unsigned clusters = __ballot_sync(kAllLanes, mine >= 0 && keeps(first + lane % kLanes));
      const int low = __shfl_sync(kAllLanes, first, 0, kWarp), high = __shfl_sync(kAllLanes, first, kLanes, kWarp);
      while (clusters != 0) {
        const int bit = take_two(clusters, lane);
        visit(bit < 0 ? -1 : kLanes * ((bit < kLanes ? low : high) + bit % kLanes) + lane % kLanes);
      }
    }
  }
}

// The least score at q and the first entry that has it: the spheres of the cluster whose bound is the least tell how far
// to look.
template <class Score>
__device__ Nearest find_nearest(const Clusters& s, const Offsets& o, Point q, int lane) {
  const auto bound = [&](int box) { return Score::of(squared_box_distance(box_at(s, box), q), o.maximum[box]); };
  const auto scored = [&](int i) { return Nearest{Score::of(squared_distance(q, place_of(s, i)), o.value[i]), i}; };
  Nearest group{kFar, s.num_clusters / kLanes - 1};
  for (int g = lane; g < s.num_clusters / kLanes; g += kWarp) {
    const Nearest other{bound(s.num_clusters + g), g};
    if (is_less(other, group)) group = other;
  }
  const int first = kLanes * warp_least(group).entry + lane % kLanes;
  const int cluster = warp_least({bound(first), first}).entry;
  Nearest best = warp_least(scored(kLanes * cluster + lane % kLanes));
  const float limit = best.score + rounding_slack(q, best.score);
  walk(s, lane, [&](int box) { return bound(box) <= limit; }, [&](int i) {
    if (i >= 0 && is_less(scored(i), best)) best = scored(i);
  });
  return warp_least(best);
}

// What a warp has chosen, in the order of the entries: `place` says where a lane's goes.
struct Chosen {
  int size = 0;

  __device__ int place(bool is_chosen, int lane) {
    const unsigned mask = __ballot_sync(kAllLanes, is_chosen);
    const int at = size + __popc(mask & ((1u << lane) - 1u));
    size += __popc(mask);
    return at;
  }
};

// A distance at a point, and its gradient.
struct Distance {
  float value, x, y, z;

  __device__ void write(const FieldTask& task, long at) const {
    task.distance[at] = value;
    if (task.gradient == nullptr) return;
    task.gradient[3 * at] = x, task.gradient[3 * at + 1] = y, task.gradient[3 * at + 2] = z;
  }
};

__device__ inline Distance no_distance() { return {not_a_number(), not_a_number(), not_a_number(), not_a_number()}; }

// Of a sphere at (x, y, z) from the point; no direction at its centre.
__device__ inline Distance to_sphere(float x, float y, float z, float radius) {
  const float d = sqrtf(squared_length(x, y, z)), scale = d > 0.0f ? 1.0f / d : 0.0f;
  return {d - radius, scale * x, scale * y, scale * z};
}

}  // namespace splatctrl
