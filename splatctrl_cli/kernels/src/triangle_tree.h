// Distances from points and balls to triangles, and whether triangles enclose a point: a tree of boxes about them.
#pragma once

#include <cstdint>
#include <vector>

namespace splatctrl {

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
  };
  struct Hit {
    double squared;
    int face;
    double shares[3];
  };

  int build(const double* corners, int first, int last);
  void look(const double* p, Hit& best) const;
  double surrounds(const double* p) const;
  double box_squared(const Node& node, const double* p) const;
  double depth_in(const Node& node, const double* p) const;

  std::vector<Node> nodes_;
  std::vector<int> order_;       // triangles as the leaves have them
  std::vector<double> corners_;  // (F, 3, 3) in that order
};

}  // namespace splatctrl
