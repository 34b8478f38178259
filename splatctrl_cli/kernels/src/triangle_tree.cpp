#include "triangle_tree.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numeric>
#include <utility>

#include "parallel.h"
#include "points.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

constexpr int kLeaf = 8;        // triangles that are not split further
constexpr int kDepth = 64;      // of the tree
constexpr int kQueries = 256;   // of a chunk
constexpr double kFarOff = 2.3;  // radii of a node, beyond which it is one dipole
constexpr double kPi = 3.14159265358979323846;

inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline void minus(const double* a, const double* b, double* out) {
  for (int k = 0; k < 3; ++k) out[k] = a[k] - b[k];
}

inline void cross(const double* a, const double* b, double* out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

// Barycentric coordinates of the point of a triangle nearest to p: the cases of Ericson, Real-Time Collision Detection
// (2005), 5.1.5.
void nearest_shares(const double* corner, const double* p, double* shares) {
  const double *a = corner, *b = corner + 3, *c = corner + 6;
  double ab[3], ac[3], away[3];
  minus(b, a, ab);
  minus(c, a, ac);
  minus(p, a, away);
  const double d1 = dot(ab, away), d2 = dot(ac, away);
  const auto set = [&](double x, double y, double z) {
    shares[0] = x;
    shares[1] = y;
    shares[2] = z;
  };
  if (d1 <= 0 && d2 <= 0) return set(1, 0, 0);
  minus(p, b, away);
  const double d3 = dot(ab, away), d4 = dot(ac, away);
  if (d3 >= 0 && d4 <= d3) return set(0, 1, 0);
  minus(p, c, away);
  const double d5 = dot(ab, away), d6 = dot(ac, away);
  if (d6 >= 0 && d5 <= d6) return set(0, 0, 1);
  const double vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return set(1 - d1 / (d1 - d3), d1 / (d1 - d3), 0);
  const double vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return set(1 - d2 / (d2 - d6), 0, d2 / (d2 - d6));
  const double va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 >= d3 && d5 >= d6) {
    const double share = (d4 - d3) / ((d4 - d3) + (d5 - d6));
    return set(0, 1 - share, share);
  }
  const double total = va + vb + vc;
  set(va / total, vb / total, vc / total);
}

// The solid angle of a triangle over 4 pi (van Oosterom, Strackee, 1983).
double solid_angle(const double* corner, const double* p) {
  double v[3][3], turned[3], length[3];
  for (int k = 0; k < 3; ++k) {
    minus(corner + 3 * k, p, v[k]);
    length[k] = std::sqrt(dot(v[k], v[k]));
  }
  cross(v[1], v[2], turned);
  const double below = length[0] * length[1] * length[2] + dot(v[0], v[1]) * length[2] + dot(v[1], v[2]) * length[0] +
                       dot(v[2], v[0]) * length[1];
  return std::atan2(dot(v[0], turned), below) / (2 * kPi);
}

}  // namespace

TriangleTree::TriangleTree(const double* corners, int num) : order_(num) {
  std::iota(order_.begin(), order_.end(), 0);
  if (num > 0) build(corners, 0, num);
  corners_.reserve(9 * static_cast<std::size_t>(num));
  for (const int face : order_) {
    const double* corner = corners + 9 * static_cast<std::size_t>(face);
    corners_.insert(corners_.end(), corner, corner + 9);
  }
}

// Halves [first, last) at its middle along the axis in which its triangles' middles are spread widest.
int TriangleTree::build(const double* corners, int first, int last) {
  constexpr double kFar = std::numeric_limits<double>::infinity();
  const int number = static_cast<int>(nodes_.size());
  nodes_.push_back({});
  Node node{};
  node.first = first;
  node.last = last;
  double low[3] = {kFar, kFar, kFar}, high[3] = {-kFar, -kFar, -kFar}, area = 0.0;
  std::fill_n(node.low, 3, kFar);
  std::fill_n(node.high, 3, -kFar);
  for (int i = first; i < last; ++i) {
    const double* corner = corners + 9 * static_cast<std::size_t>(order_[i]);
    double ab[3], ac[3], normal[3];
    minus(corner + 3, corner, ab);
    minus(corner + 6, corner, ac);
    cross(ab, ac, normal);
    const double size = 0.5 * std::sqrt(dot(normal, normal));
    area += size;
    for (int k = 0; k < 3; ++k) {
      const double middle = (corner[k] + corner[3 + k] + corner[6 + k]) / 3;
      node.low[k] = std::min({node.low[k], corner[k], corner[3 + k], corner[6 + k]});
      node.high[k] = std::max({node.high[k], corner[k], corner[3 + k], corner[6 + k]});
      low[k] = std::min(low[k], middle);
      high[k] = std::max(high[k], middle);
      node.normal[k] += 0.5 * normal[k];
      node.middle[k] += size * middle;
    }
  }
  for (int k = 0; k < 3; ++k) {
    node.middle[k] = area > 0 ? node.middle[k] / area : (node.low[k] + node.high[k]) / 2;
    node.radius += std::pow(std::max(node.high[k] - node.middle[k], node.middle[k] - node.low[k]), 2);
  }
  node.radius = std::sqrt(node.radius);
  if (last - first > kLeaf) {
    int axis = 0;
    for (int k = 1; k < 3; ++k) {
      if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    }
    const int middle = first + (last - first) / 2;
    const auto at = [&](int face) {
      const double* corner = corners + 9 * static_cast<std::size_t>(face);
      return corner[axis] + corner[3 + axis] + corner[6 + axis];
    };
    std::nth_element(order_.begin() + first, order_.begin() + middle, order_.begin() + last,
                     [&](int a, int b) { return at(a) < at(b) || (at(a) == at(b) && a < b); });
    build(corners, first, middle);
    node.second = build(corners, middle, last);
  }
  nodes_[number] = node;
  return number;
}

// How deep a point is in a node's box.
double TriangleTree::depth_in(const Node& node, const double* p) const {
  double depth = std::numeric_limits<double>::infinity();
  for (int k = 0; k < 3; ++k) depth = std::min({depth, p[k] - node.low[k], node.high[k] - p[k]});
  return depth;
}

double TriangleTree::box_squared(const Node& node, const double* p) const {
  double squared = 0.0;
  for (int k = 0; k < 3; ++k) {
    const double beyond = std::max({node.low[k] - p[k], p[k] - node.high[k], 0.0});
    squared += beyond * beyond;
  }
  return squared;
}

// Betters `best` by what is nearer; of equals, the triangle with the least number.
void TriangleTree::look(const double* p, Hit& best) const {
  if (nodes_.empty()) return;
  std::pair<double, int> waiting[kDepth];
  int num = 0;
  waiting[num++] = {box_squared(nodes_[0], p), 0};
  while (num > 0) {
    const auto [squared, number] = waiting[--num];
    if (squared > best.squared) continue;
    const Node& node = nodes_[number];
    if (node.second == 0) {
      for (int i = node.first; i < node.last; ++i) {
        const double* corner = corners_.data() + 9 * static_cast<std::size_t>(i);
        double shares[3], away[3];
        nearest_shares(corner, p, shares);
        for (int k = 0; k < 3; ++k) {
          away[k] = p[k] - (shares[0] * corner[k] + shares[1] * corner[3 + k] + shares[2] * corner[6 + k]);
        }
        const double found = dot(away, away);
        if (found < best.squared || (found == best.squared && (best.face < 0 || order_[i] < best.face))) {
          best = {found, order_[i], {shares[0], shares[1], shares[2]}};
        }
      }
      continue;
    }
    const double one = box_squared(nodes_[number + 1], p), other = box_squared(nodes_[node.second], p);
    const bool is_first = one <= other;  // the nearer is looked at first: it is put last
    waiting[num++] = is_first ? std::pair{other, node.second} : std::pair{one, number + 1};
    waiting[num++] = is_first ? std::pair{one, number + 1} : std::pair{other, node.second};
  }
}

double TriangleTree::surrounds(const double* p) const {
  if (nodes_.empty() || box_squared(nodes_[0], p) > 0.0) return 0.0;
  double total = 0.0;
  int waiting[kDepth], num = 0;
  waiting[num++] = 0;
  while (num > 0) {
    const int number = waiting[--num];
    const Node& node = nodes_[number];
    double away[3];
    minus(node.middle, p, away);
    const double squared = dot(away, away), far = kFarOff * node.radius;
    if (squared > far * far) {
      total += dot(away, node.normal) / (4 * kPi * squared * std::sqrt(squared));
    } else if (node.second == 0) {
      for (int i = node.first; i < node.last; ++i) {
        total += solid_angle(corners_.data() + 9 * static_cast<std::size_t>(i), p);
      }
    } else {
      waiting[num++] = number + 1;
      waiting[num++] = node.second;
    }
  }
  return total;
}

void TriangleTree::closest(const double* points, int num_points, const double* bound, double* distance,
                           std::int64_t* face, double* shares, int num_threads) const {
  parallel_for(parts(num_points, kQueries), num_threads, [&](int chunk) {
    for (int i = chunk * kQueries; i < std::min(num_points, (chunk + 1) * kQueries); ++i) {
      Hit best{bound[i] * bound[i], -1, {0, 0, 0}};
      look(points + 3 * static_cast<std::size_t>(i), best);
      distance[i] = best.face < 0 ? std::numeric_limits<double>::infinity() : std::sqrt(best.squared);
      face[i] = best.face;
      std::copy_n(best.shares, 3, shares + 3 * static_cast<std::size_t>(i));
    }
  });
}

void TriangleTree::winding(const double* points, int num_points, double* number, int num_threads) const {
  parallel_for(parts(num_points, kQueries), num_threads, [&](int chunk) {
    for (int i = chunk * kQueries; i < std::min(num_points, (chunk + 1) * kQueries); ++i) {
      number[i] = surrounds(points + 3 * static_cast<std::size_t>(i));
    }
  });
}

void TriangleTree::gaps(const double* poses, int num_poses, const double* centers, const double* radii, int num_balls,
                        double* gap, std::int64_t* ball, int num_threads) const {
  constexpr double kFar = std::numeric_limits<double>::infinity();
  parallel_for(num_poses, num_threads, [&](int at) {
    const double* pose = poses + 12 * static_cast<std::size_t>(at);
    const double R[9] = {pose[0], pose[1], pose[2], pose[4], pose[5], pose[6], pose[8], pose[9], pose[10]};
    const double t[3] = {pose[3], pose[7], pose[11]};
    struct Ball {
      double least, p[3];  // the gap is not below it: by the box about all
      int which;
      bool may_be_inside;
    };
    std::vector<Ball> balls(nodes_.empty() ? 0 : num_balls);
    std::size_t first = 0;
    for (std::size_t i = 0; i < balls.size(); ++i) {
      balls[i].which = static_cast<int>(i);
      moved(R, t, centers + 3 * i, balls[i].p);
      const double squared = box_squared(nodes_[0], balls[i].p);
      balls[i].may_be_inside = squared == 0.0;
      balls[i].least = std::sqrt(squared) - (squared == 0.0 ? depth_in(nodes_[0], balls[i].p) : 0.0) - radii[i];
      if (balls[i].least < balls[first].least) first = i;
    }
    gap[at] = kFar;
    ball[at] = -1;
    const auto ask = [&](const Ball& one) {
      const double radius = radii[one.which];
      const bool is_inside = one.may_be_inside && surrounds(one.p) > 0.5;
      const double most = is_inside ? kFar : gap[at] + radius;
      Hit best{most < 0 ? -1.0 : most * most, -1, {0, 0, 0}};
      look(one.p, best);
      if (best.face < 0) return;
      const double found = (is_inside ? -1 : 1) * std::sqrt(best.squared) - radius;
      if (found < gap[at]) {
        gap[at] = found;
        ball[at] = one.which;
      }
    };
    if (!balls.empty()) ask(balls[first]);
    std::vector<Ball> near;
    for (const Ball& one : balls) {
      if (one.least < gap[at]) near.push_back(one);
    }
    std::sort(near.begin(), near.end(), [](const Ball& a, const Ball& b) {
      return a.least < b.least || (a.least == b.least && a.which < b.which);
    });
    for (const Ball& one : near) {
      if (one.least >= gap[at]) break;
      ask(one);
    }
  });
}

}  // namespace splatctrl
