// Spheres in clusters of 16 neighbours, clusters in groups of 16, a box around each: what every distance here walks.
#pragma once

#include <vector>

#include "field_geometry.h"

namespace splatctrl {

struct Boxes8 {
  Float8 lower[3], upper[3];
};

// Eight boxes, the first of them at `box`.
inline Boxes8 boxes_at(const Clusters& s, int box) {
  return {{load8(s.boxes[0] + box), load8(s.boxes[1] + box), load8(s.boxes[2] + box)},
          {load8(s.boxes[3] + box), load8(s.boxes[4] + box), load8(s.boxes[5] + box)}};
}

// Squared distances from q to eight boxes.
inline Float8 squared_box_distances(const Clusters& s, int box, Point q) { return squared_box_distance(boxes_at(s, box), q); }

inline Float8 box_distances(const Clusters& s, int box, Point q) { return sqrt8(squared_box_distances(s, box, q)); }

// Distances from q to the farthest corners of eight boxes.
inline Float8 farthest_corners(const Clusters& s, int box, Point q) {
  return sqrt8(squared_farthest_corner(boxes_at(s, box), q));
}

// Squared distances from q to eight spheres' centres, the first of them at `entry`.
inline Float8 squared_center_distances(const Clusters& s, int entry, Point q) {
  const Float8 dx = q.x - load8(s.x + entry), dy = q.y - load8(s.y + entry), dz = q.z - load8(s.z + entry);
  return dx * dx + dy * dy + dz * dz;
}

inline Float8 center_distances(const Clusters& s, int entry, Point q) { return sqrt8(squared_center_distances(s, entry, q)); }

// Clusters whose bound at a point may count, and work space for finding them.
struct Candidates {
  std::vector<float> group_bounds, bound;
  std::vector<int> cluster;
  int size = 0;

  void reserve(const Clusters& s) {
    if (static_cast<int>(group_bounds.size()) >= s.num_groups && static_cast<int>(bound.size()) >= s.num_clusters) return;
    group_bounds.resize(s.num_groups), bound.resize(s.num_clusters), cluster.resize(s.num_clusters);
  }
};

// Lower bounds of the scores at q in each group; returns the group with the least.
template <typename Score>
int bound_groups(const Clusters& s, const Offsets& o, Point q, float* bounds) {
  Float8 lowest = splat8(kFar);
  for (int g = 0; g < s.num_groups; g += 8) {
    const Float8 bound = Score::of(squared_box_distances(s, s.num_clusters + g, q), load8(o.maximum + s.num_clusters + g));
    store8(bounds + g, bound);
    lowest = min8(lowest, bound);
  }
  const float least = min_of8(lowest);
  int g = 0;
  while (bounds[g] != least) ++g;
  return g;
}

// Lower bounds of the scores at q in half of the clusters of a group.
template <typename Score>
Float8 bound_clusters(const Clusters& s, const Offsets& o, int cluster, Point q) {
  return Score::of(squared_box_distances(s, cluster, q), load8(o.maximum + cluster));
}

// The least scores so far, by lane, and the first entries that have them.
struct LeastScores {
  Float8 score = splat8(kFar);
  Int8 entry = {};

  void take(Float8 other, int first_entry) {
    const Int8 place = Int8{0, 1, 2, 3, 4, 5, 6, 7} + first_entry;
    const Int8 is_less = (other < score) | ((other == score) & (place < entry));
    entry = is_less ? place : entry;
    score = min8(other, score);
  }
  float least() const { return min_of8(score); }
  Nearest nearest() const {
    Nearest best{score[0], entry[0]};
    for (int k = 1; k < 8; ++k)
      if (score[k] < best.score || (score[k] == best.score && entry[k] < best.entry)) best = {score[k], entry[k]};
    return best;
  }
};

template <typename Score>
void visit_cluster(const Clusters& s, const Offsets& o, int cluster, Point q, LeastScores& least) {
  for (int entry = kLanes * cluster; entry < kLanes * (cluster + 1); entry += 8)
    least.take(Score::of(squared_center_distances(s, entry, q), load8(o.value + entry)), entry);
}

// The nearest, and the clusters whose bounds are within `spread` of its score (some beyond, too); spread(lowest), of a
// lower bound of the score.
template <typename Score, typename Spread>
Nearest find_nearest(const Clusters& s, const Offsets& o, Point q, Candidates& found, const Spread& spread) {
  found.reserve(s);
  found.size = 0;
  LeastScores scores;
  const int first = bound_groups<Score>(s, o, q, found.group_bounds.data());
  int best = kLanes * first;
  float least = kFar;
  for (int cluster = kLanes * first; cluster < kLanes * (first + 1); cluster += 8) {
    const Float8 bound = bound_clusters<Score>(s, o, cluster, q);
    for (int k = 0; k < 8; ++k)
      if (bound[k] < least) least = bound[k], best = cluster + k;
  }
  visit_cluster<Score>(s, o, best, q, scores);
  float nearest = scores.least();
  const float slack = rounding_slack(q, nearest), room = slack + spread(found.group_bounds[first]);
  for (int g = 0; g < s.num_clusters / kLanes; ++g) {
    if (!(found.group_bounds[g] <= nearest + room)) continue;
    for (int cluster = kLanes * g; cluster < kLanes * (g + 1); cluster += 8) {
      const Float8 bound = bound_clusters<Score>(s, o, cluster, q);
      for (unsigned kept = signs8(bound <= nearest + room); kept != 0; kept &= kept - 1) {
        const int k = __builtin_ctz(kept);
        found.cluster[found.size] = cluster + k, found.bound[found.size] = bound[k];
        ++found.size;
        if (!(bound[k] <= nearest + slack)) continue;
        visit_cluster<Score>(s, o, cluster + k, q, scores);
        nearest = scores.least();
      }
    }
  }
  return scores.nearest();
}

template <typename Score>
Nearest find_nearest(const Clusters& s, const Offsets& o, Point q, Candidates& found) {
  return find_nearest<Score>(s, o, q, found, [](float) { return 0.0f; });
}

}  // namespace splatctrl
