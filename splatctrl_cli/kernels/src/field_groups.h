// Neighbouring spheres of a Matern field taken together, where they look alike from afar.
#pragma once

#include "field_clusters.h"

namespace splatctrl {

// n spheres with weights e^(o_i / l), seen from D away along u: with p their weighted mean and S their covariance,
//
//   log sum_i e^((o_i - |x - p_i|) / l) = (o - |x - p|) / l + (u.S.u - tr S) / (2 D l) + u.S.u / (2 l^2) + error,
//
// o = l log sum_i e^(o_i / l): mean and variance of the spheres' distances to second order in their spread.
struct Group {
  float place[3];       // p
  float covariance[6];  // S: xx, xy, xz, yy, yz, zz
  float extent[3];      // max |p_i - p| along each axis
  float radius;         // max |p_i - p|
  double offset;        // o
  int begin, count;     // entries
};

// Groups of four entries (4 C) and of sixteen (C), spare entries left out.
struct Groups {
  std::vector<Group> of_4, of_16;
};

Groups make_groups(const Clusters& spheres, const double* offset, float length);

// Single spheres, relative to a middle: score |x - p| - offset.
struct TermList {
  std::vector<float> x, y, z, offset, sign;
  int size = 0;

  void reserve(int n);  // before any `add` beyond it
  void add(float px, float py, float pz, float o, float c);
  // Fills up the last eight with terms of no weight.
  void pad();
};

// Groups, relative to a middle; score and error as seen from around a point m, once `view` was called:
// |x - p| - offset - seen_offset - slope.(x - m).
struct GroupList {
  std::vector<const Group*> group;
  std::vector<float> x, y, z, offset, covariance[6], extent[3], radius;
  std::vector<float> seen_offset, slope[3], error;
  int size = 0;

  void reserve(int n);
  void add(const Group& g, float px, float py, float pz, float o);
  void pad();
  // Looks from m, for points within `around` of it. The error bounds that of the exponent; infinite where too near.
  //
  // It has four parts: the third cumulant, at most (2 b)^3 sqrt(3) / 108 for distances that spread by 2 b; the
  // covariance of the distances' linear and curved parts, and the variance of the latter; the third order of their
  // mean; the second order in x - m of the correction, which is followed to the first.
  void view(Point m, float around, float length);
};

// What counts in a block or sub-block, relative to its middle; offsets less that of the block's nearest sphere.
struct Terms {
  TermList single;
  GroupList grouped;

  void clear(const Clusters& s) {
    single.reserve(kLanes * s.num_clusters), grouped.reserve(4 * s.num_clusters);
    single.size = grouped.size = 0;
  }
  void pad() { single.pad(), grouped.pad(); }
  template <bool kGroups>
  const auto& list() const {
    if constexpr (kGroups)
      return grouped;
    else
      return single;
  }
};

}  // namespace splatctrl
