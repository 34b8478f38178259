// Spheres in clusters of 16 neighbours with a box around each: what distance queries and the bake both walk.
//
// Every field here is made of scores s_i(x) = |x - p_i| - o_i: the exact distance is min_i s_i with o_i = r_i, the
// Matern field is -l log sum_i exp(-s_i / l) with o_i = r_i + l log w_i. A score changes by at most |x - y| from x to
// y, and inside a cluster it is at least (distance to the box) - (largest o): both culls below rest on these two facts.
#pragma once

#include <cmath>
#include <vector>

namespace splatctrl {

constexpr int kLanes = 16;

struct Point {
  float x, y, z;
};

// Views of C clusters; entry 16 c + k is sphere k of cluster c; spare entries have an offset of -1e30.
struct Clusters {
  int num_clusters;
  const float *x, *y, *z, *offset;                                          // (16 C)
  const float *lower_x, *lower_y, *lower_z, *upper_x, *upper_y, *upper_z;  // (C)
  const float* max_offset;                                                 // (C)
  float offset_scale;                                                      // the largest |max_offset|
};

// Work space of one thread.
struct Scratch {
  std::vector<float> bounds;  // (C) lower bound of the scores in each cluster
  std::vector<int> kept;
};

// Smallest of 16 floats.
inline float min_lanes(const float* values) {
  float m[kLanes / 2];
  for (int k = 0; k < 8; ++k) m[k] = values[k] < values[k + 8] ? values[k] : values[k + 8];
  for (int k = 0; k < 4; ++k) m[k] = m[k] < m[k + 4] ? m[k] : m[k + 4];
  for (int k = 0; k < 2; ++k) m[k] = m[k] < m[k + 2] ? m[k] : m[k + 2];
  return m[0] < m[1] ? m[0] : m[1];
}

// Sum of 16 floats, in one fixed order.
inline float sum_lanes(const float* values) {
  float s[kLanes / 2];
  for (int k = 0; k < 8; ++k) s[k] = values[k] + values[k + 8];
  for (int k = 0; k < 4; ++k) s[k] += s[k + 4];
  return (s[0] + s[2]) + (s[1] + s[3]);
}

// Scores (16) of cluster c at q.
inline void cluster_scores(const Clusters& s, int c, Point q, float* scores) {
  const float *x = s.x + kLanes * c, *y = s.y + kLanes * c, *z = s.z + kLanes * c, *o = s.offset + kLanes * c;
  for (int k = 0; k < kLanes; ++k) {
    const float dx = q.x - x[k], dy = q.y - y[k], dz = q.z - z[k];
    scores[k] = std::sqrt(dx * dx + dy * dy + dz * dz) - o[k];
  }
}

// What float32 may have lost in any score near `score` at q: added to every threshold, so that culls stay exact.
inline float rounding_slack(const Clusters& s, Point q, float score) {
  return 2e-6f * (std::fabs(q.x) + std::fabs(q.y) + std::fabs(q.z) + std::fabs(score) + s.offset_scale);
}

// Lower bounds of the scores at q, by cluster; returns the cluster with the least.
inline int bound_clusters(const Clusters& s, Point q, std::vector<float>& bounds) {
  bounds.resize(s.num_clusters);
  float* out = bounds.data();
  for (int c = 0; c < s.num_clusters; ++c) {
    const float below_x = s.lower_x[c] - q.x, above_x = q.x - s.upper_x[c];
    const float below_y = s.lower_y[c] - q.y, above_y = q.y - s.upper_y[c];
    const float below_z = s.lower_z[c] - q.z, above_z = q.z - s.upper_z[c];
    float dx = below_x > above_x ? below_x : above_x, dy = below_y > above_y ? below_y : above_y;
    float dz = below_z > above_z ? below_z : above_z;
    dx = dx > 0.0f ? dx : 0.0f;
    dy = dy > 0.0f ? dy : 0.0f;
    dz = dz > 0.0f ? dz : 0.0f;
    out[c] = std::sqrt(dx * dx + dy * dy + dz * dz) - s.max_offset[c];
  }
  int least = 0;
  for (int c = 1; c < s.num_clusters; ++c) least = out[c] < out[least] ? c : least;
  return least;
}

// The least score at q and the entry that has it (the first, among equals in the order visited).
struct Nearest {
  float score;
  int entry;
};

// Fills scratch.bounds on the way.
inline Nearest find_nearest(const Clusters& s, Point q, Scratch& scratch) {
  Nearest nearest{3e38f, 0};
  float scores[kLanes];
  const auto visit = [&](int c) {
    cluster_scores(s, c, q, scores);
    if (!(min_lanes(scores) < nearest.score)) return;
    for (int k = 0; k < kLanes; ++k)
      if (scores[k] < nearest.score) nearest = {scores[k], kLanes * c + k};
  };
  const int first = bound_clusters(s, q, scratch.bounds);
  visit(first);
  const float slack = rounding_slack(s, q, nearest.score);
  for (int c = 0; c < s.num_clusters; ++c)
    if (scratch.bounds[c] <= nearest.score + slack && c != first) visit(c);
  return nearest;
}

}  // namespace splatctrl
