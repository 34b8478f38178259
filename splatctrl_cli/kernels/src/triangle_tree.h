// Distances from points and balls to triangles, and whether triangles enclose a point: a tree of boxes about them.
#pragma once

#include <cstdint>
#include <limits>
#include <vector>

namespace splatctrl {

constexpr int kLeaf = 8;       // triangles that are not split further
constexpr int kQueries = 256;  // points that a thread takes at once

class TriangleTree {
 public:
  // corners (F, 3, 3) [m], counter-clockwise seen from outside.
  TriangleTree(const double* corners, int num);

  int size() const { return static_cast<int>(order_.size()); }

  // Of points (N, 3): distance (N) [m] to the nearest triangle, its number, -1 and an infinite distance where none is
  // within `bound` (N) [m]; shares (N, 3): barycentric coordinates of the nearest point on it, exactly 0 off a corner
  // or an edge.
  void closest(const double* points, int num_points, const double* bound, double* distance, std::int64_t* face,
               double* shares, int num_threads) const;

  // The signed distance [m] of a point to other surfaces, `least`, or to the triangles where they are nearer and within
  // `within`; whether the point is inside them is asked only where it may be. Where `enough` is not negative, it is any
  // distance that is on the same side of `enough` and of `within`. leaf: the node of one that is looked at first, -1 =
  // none; becomes that of the triangle that was found.
  double nearer(const double* p, double least, double within, double enough, bool may_be_inside, int& leaf) const;

  // out (num): whether the box about all triangles may be within `within` (num) [m] of points (3, num), which a pose
  // (3, 4) leads to the triangles' frame.
  void are_near(const double (*points)[kQueries], int num, const double* pose, const double* within,
                std::uint8_t* out) const;

  // How often the triangles surround each point (N), 0 outside the box about them: more than a half inside. Far triangles count as one dipole
  // (Barill, Dickson, Schmidt, Levin, Jacobson, Fast winding numbers for soups and clouds, 2018).
  void winding(const double* points, int num_points, double* number, int num_threads) const;

  // Signed gap (T) [m] between the triangles and the nearest of balls (N, 3), (N), negative inside, in each of poses
  // (T, 3, 4), from the balls' frame to the triangles'. ball (T): which, -1 = none.
  void gaps(const double* poses, int num_poses, const double* centers, const double* radii, int num_balls,
            double* gap, std::int64_t* ball, int num_threads) const;

 private:
  struct Node {
    double low[3], high[3];
    double normal[3], middle[3], radius;  // areas' sum, their centre, and a ball about it that holds all
    int first, last, second;              // triangles; the second child (the first follows), 0 of a leaf
    int leaf;                             // number of a leaf
  };
  struct Leaf {  // boxes about its triangles, empty past the last
    float low[3][kLeaf], high[3][kLeaf];
  };
  struct Hit {
    double squared;
    int face;
    double shares[3];
    int leaf;  // node that it was found in by `look`
  };

  int build(const double* corners, int first, int last);
  void look(const double* p, Hit& best, double enough = -1.0) const;
  void look_in(const Node& node, const double* p, Hit& best) const;
  double surrounds(const double* p) const;
  double box_squared(const Node& node, const double* p) const;
  double depth_in(const Node& node, const double* p) const;

  std::vector<Node> nodes_;
  std::vector<int> order_;       // triangles as the leaves have them
  std::vector<double> corners_;  // (F, 3, 3) in that order
  std::vector<Leaf> leaves_;
  double farthest_ = 0.0;  // coordinate of a corner
};

// Trees, each with a pose (3, 4) from the points' frame to its own.
struct PlacedTrees {
  std::vector<const TriangleTree*> trees;
  const double* poses;
};

// What is asked of each of `num` points (num, 3): within, enough [m] and may_be_inside as `TriangleTree::nearer` has
// them.
struct AskedPoints {
  const double *points, *within, *enough;
  const std::uint8_t* may_be_inside;
  int num;
};

// Betters the signed distance (N) [m] of points to other surfaces by that to the trees' triangles.
void signed_distance(const PlacedTrees& placed, const AskedPoints& asked, double* distance, int num_threads);

}  // namespace splatctrl
