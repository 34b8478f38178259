// Spheres in clusters of 16 neighbours, clusters in groups of 16, a box around each: what every distance here walks.
//
// The fields are made of scores s_i(x) = |x - p_i| - o_i (exact distance: o = r; Matern: o = r + l log w) or of
// squared ones q_i(x) = |x - p_i|^2 - b_i (squared exponential: b = 2 l^2 log w). A score changes by no more than one
// moves, and inside a box it is at least (distance to the box) - (largest offset): all culls rest on these two facts.
#pragma once

#include <cmath>
#include <vector>

#include "simd.h"

namespace splatctrl {

constexpr int kLanes = 16;  // spheres of a cluster, clusters of a group
constexpr float kFar = 3e38f;

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

// Squared distances from q to eight boxes, the first of them at `box`.
inline Float8 squared_box_distances(const Clusters& s, int box, Point q) {
  const Float8 zero{};
  const Float8 dx = max8(load8(s.boxes[0] + box) - q.x, q.x - load8(s.boxes[3] + box));
  const Float8 dy = max8(load8(s.boxes[1] + box) - q.y, q.y - load8(s.boxes[4] + box));
  const Float8 dz = max8(load8(s.boxes[2] + box) - q.z, q.z - load8(s.boxes[5] + box));
  const Float8 x = max8(dx, zero), y = max8(dy, zero), z = max8(dz, zero);
  return x * x + y * y + z * z;
}

inline Float8 box_distances(const Clusters& s, int box, Point q) { return sqrt8(squared_box_distances(s, box, q)); }

// Distances from q to the farthest corners of eight boxes.
inline Float8 farthest_corners(const Clusters& s, int box, Point q) {
  const Float8 dx = max8(q.x - load8(s.boxes[0] + box), load8(s.boxes[3] + box) - q.x);
  const Float8 dy = max8(q.y - load8(s.boxes[1] + box), load8(s.boxes[4] + box) - q.y);
  const Float8 dz = max8(q.z - load8(s.boxes[2] + box), load8(s.boxes[5] + box) - q.z);
  return sqrt8(dx * dx + dy * dy + dz * dz);
}

// Squared distances from q to eight spheres' centres, the first of them at `entry`.
inline Float8 squared_center_distances(const Clusters& s, int entry, Point q) {
  const Float8 dx = q.x - load8(s.x + entry), dy = q.y - load8(s.y + entry), dz = q.z - load8(s.z + entry);
  return dx * dx + dy * dy + dz * dz;
}

inline Float8 center_distances(const Clusters& s, int entry, Point q) { return sqrt8(squared_center_distances(s, entry, q)); }

// The kinds of score, of a squared distance and an offset; a bound of a box is the same of its distance and maximum.
struct LinearScore {
  static Float8 of(Float8 squared, Float8 offset) { return sqrt8(squared) - offset; }
};
struct SquaredScore {
  static Float8 of(Float8 squared, Float8 offset) { return squared - offset; }
};

// What float32 may have lost in any score near `score` at q: added to every threshold, so that culls stay exact.
inline float rounding_slack(Point q, float score) {
  return 4e-6f * (std::fabs(q.x) + std::fabs(q.y) + std::fabs(q.z) + std::fabs(score)) + 1e-30f;
}

// The least score at q and the first entry that has it.
struct Nearest {
  float score;
  int entry;
};

// Lower bounds of the scores at q in each group; returns the group with the least.
template <typename Score>
int bound_groups(const Clusters& s, const Offsets& o, Point q, std::vector<float>& bounds) {
  bounds.resize(s.num_groups);
  for (int g = 0; g < s.num_groups; g += 8)
    store8(&bounds[g], Score::of(squared_box_distances(s, s.num_clusters + g, q), load8(o.maximum + s.num_clusters + g)));
  int least = 0;
  for (int g = 1; g < s.num_groups; ++g) least = bounds[g] < bounds[least] ? g : least;
  return least;
}

// Lower bounds (16) of the scores at q in the clusters of a group.
template <typename Score>
void bound_clusters(const Clusters& s, const Offsets& o, int group, Point q, float* bounds) {
  for (int k = 0; k < kLanes; k += 8) {
    const int cluster = kLanes * group + k;
    store8(bounds + k, Score::of(squared_box_distances(s, cluster, q), load8(o.maximum + cluster)));
  }
}

// Calls visit(cluster) where a cluster's bound does not exceed limit(), which may fall on the way. `bounds` as filled
// by bound_groups at q.
template <typename Score, typename Limit, typename Visit>
void walk_clusters(const Clusters& s, const Offsets& o, Point q, const std::vector<float>& bounds, const Limit& limit,
                   const Visit& visit) {
  float cluster_bounds[kLanes];
  const int groups = (s.num_clusters + kLanes - 1) / kLanes;
  for (int g = 0; g < groups; ++g) {
    if (!(bounds[g] <= limit())) continue;
    bound_clusters<Score>(s, o, g, q, cluster_bounds);
    for (int k = 0; k < kLanes; ++k)
      if (cluster_bounds[k] <= limit()) visit(kLanes * g + k);
  }
}

// Fills `bounds` on the way.
template <typename Score>
Nearest find_nearest(const Clusters& s, const Offsets& o, Point q, std::vector<float>& bounds) {
  Nearest nearest{kFar, 0};
  float slack = 0.0f;
  const auto visit = [&](int cluster) {
    Float8 score[2];
    for (int h = 0; h < 2; ++h) {
      const int entry = kLanes * cluster + 8 * h;
      score[h] = Score::of(squared_center_distances(s, entry, q), load8(o.value + entry));
    }
    if (!any8((score[0] <= nearest.score) | (score[1] <= nearest.score))) return;
    for (int k = 0; k < kLanes; ++k) {
      const Nearest other{score[k / 8][k % 8], kLanes * cluster + k};
      if (other.score < nearest.score || (other.score == nearest.score && other.entry < nearest.entry)) nearest = other;
    }
  };
  const int group = bound_groups<Score>(s, o, q, bounds);
  float cluster_bounds[kLanes];
  bound_clusters<Score>(s, o, group, q, cluster_bounds);
  int first = 0;
  for (int k = 1; k < kLanes; ++k) first = cluster_bounds[k] < cluster_bounds[first] ? k : first;
  visit(kLanes * group + first);
  slack = rounding_slack(q, nearest.score);
  walk_clusters<Score>(s, o, q, bounds, [&] { return nearest.score + slack; }, [&](int c) {
    if (c != kLanes * group + first) visit(c);
  });
  return nearest;
}

}  // namespace splatctrl
