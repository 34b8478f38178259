// Straight edges in joint space proved free of solids and of the arm itself by conservative advancement.
#pragma once

#include "chain.h"
#include "solids.h"

namespace splatctrl {

// Rows [begin, end) of one part's spheres against the solids (second is -1), or between those of two parts.
struct RowGroup {
  long first, second, begin, end;
};

// R rows: M moving spheres against the solids, then P pairs of spheres. A row is the distance of its centres, or of its
// centre to the nearest solid, less `taken`; over a motion dq it loses at most levers |dq|. The last K spheres of the chain
// are middles of parts of its bodies: a ball of `radius` about one holds the centres of that part's spheres. Rows come in
// groups, of which group_taken and group_levers are the largest of any row: of a group that is far enough no row is looked at.
struct Room {
  Chain chain;
  int num_moving, num_pairs, num_parts, num_groups;
  const long *moving, *pairs;                // (M), (P, 2)
  const double *taken, *levers;              // (R), (R, J)
  const double* radius;                      // (K)
  const RowGroup* groups;                    // (G)
  const double *group_taken, *group_levers;  // (G), (G, J)
  int num_balls, num_boxes, num_rods;
  const Ball* balls;
  const Cuboid* boxes;
  const Rod* rods;
};

// A posture with a row below `contact` is in collision; `rounding` is taken off every row, a row that an edge does not
// move loses `still`; less than `give_up` [rad] before a collision is left unproved.
struct Advance {
  double contact, give_up, rounding, still;
  bool only_whole;
};

// For each of E edges start (E, J) to end (E, J): the share (E) from its start that is proved free, and the postures (E)
// asked. With only_whole an edge that is not all free has share 0.
void advance_edges(const Room& room, const Advance& advance, const double* start, const double* end, int num_edges, int num_threads,
                   double* free_share, long* num_checks);

}  // namespace splatctrl
