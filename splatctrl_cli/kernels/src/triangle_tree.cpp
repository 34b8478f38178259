#include "triangle_tree.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <numeric>
#include <utility>

#include "parallel.h"
#include "points.h"
#include "simd.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

constexpr int kDepth = 64;      // of the tree
constexpr double kRounding = 1e-9;  // [m] that a box seems farther off at most
constexpr double kFarOff = 2.3;  // radii of a node, beyond which it is one dipole
constexpr double kInside = 0.5;  // of a winding number, from which a point is inside
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

// No less than any number whose root is at most `root`.
inline double square_above(double root) { return root * root * (1 + 1e-12); }

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
    for (int k = 0; k < 9; ++k) farthest_ = std::max(farthest_, std::fabs(corner[k]));
  }
  for (Node& node : nodes_) {
    if (node.second != 0) continue;
    node.leaf = static_cast<int>(leaves_.size());
    Leaf leaf;
    for (int k = 0; k < 3; ++k) {
      std::fill_n(leaf.low[k], kLeaf, std::numeric_limits<float>::infinity());
      std::fill_n(leaf.high[k], kLeaf, -std::numeric_limits<float>::infinity());
      for (int i = node.first; i < node.last; ++i) {
        const double* c = corners_.data() + 9 * static_cast<std::size_t>(i) + k;
        leaf.low[k][i - node.first] = static_cast<float>(std::min({c[0], c[3], c[6]}));
        leaf.high[k][i - node.first] = static_cast<float>(std::max({c[0], c[3], c[6]}));
      }
    }
    leaves_.push_back(leaf);
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
    const double below = node.low[k] - p[k], above = p[k] - node.high[k], most = below > above ? below : above;
    const double beyond = most > 0.0 ? most : 0.0;
    squared += beyond * beyond;
  }
  return squared;
}

// Betters `best` by a leaf's triangles, without those whose boxes are farther off.
void TriangleTree::look_in(const Node& node, const double* p, Hit& best) const {
  const Leaf& leaf = leaves_[node.leaf];
  const double reach = std::max({std::fabs(p[0]), std::fabs(p[1]), std::fabs(p[2]), farthest_});
  const Float8 rounding = splat8(static_cast<float>(4e-7 * reach));
  Float8 squared = splat8(0.0f);
  for (int k = 0; k < 3; ++k) {
    const Float8 at = splat8(static_cast<float>(p[k]));
    const Float8 beyond = max8(load8(leaf.low[k]) - at, at - load8(leaf.high[k])) - rounding;
    squared += max8(beyond, splat8(0.0f)) * max8(beyond, splat8(0.0f));
  }
  const unsigned far = signs8(squared > static_cast<float>(best.squared * 1.000002));
  unsigned near = ~far & ((1u << (node.last - node.first)) - 1);
  for (; near != 0; near &= near - 1) {
    const int i = node.first + __builtin_ctz(near);
    const double* corner = corners_.data() + 9 * static_cast<std::size_t>(i);
    double shares[3], away[3];
    nearest_shares(corner, p, shares);
    for (int k = 0; k < 3; ++k) {
      away[k] = p[k] - (shares[0] * corner[k] + shares[1] * corner[3 + k] + shares[2] * corner[6 + k]);
    }
    const double found = dot(away, away);
    if (found < best.squared || (found == best.squared && (best.face < 0 || order_[i] < best.face))) {
      best = {found, order_[i], {shares[0], shares[1], shares[2]}, best.leaf};
    }
  }
}

// Betters `best` by what is nearer; of equals, the triangle with the least number. Where `enough` is not negative, the
// first triangle does, but one within `enough` is looked for. The leaf of `best` is looked at first.
void TriangleTree::look(const double* p, Hit& best, double enough) const {
  if (nodes_.empty() || box_squared(nodes_[0], p) > best.squared) return;
  double most = best.squared;
  const auto is_found_in = [&](int leaf) {
    const int before = best.face;
    look_in(nodes_[leaf], p, best);
    if (best.face != before) best.leaf = leaf;
    const bool is_any = enough >= 0.0 && best.face >= 0;
    most = is_any ? square_above(enough) : best.squared;
    return is_any && std::sqrt(best.squared) <= enough;
  };
  if (best.leaf >= 0 && is_found_in(best.leaf)) return;
  struct {
    double squared;
    int number;
  } waiting[kDepth];  // not filled with zeros
  int num = 0;
  waiting[num++] = {0.0, 0};
  while (num > 0) {
    const int number = waiting[--num].number;
    if (waiting[num].squared > most) continue;
    const int second = nodes_[number].second;
    if (second == 0) {
      if (is_found_in(number)) return;
      continue;
    }
    const double one = box_squared(nodes_[number + 1], p), other = box_squared(nodes_[second], p);
    const bool is_first = one <= other;  // the nearer is looked at first: it is put last
    if (is_first && other <= most) waiting[num++] = {other, second};
    if (one <= most) waiting[num++] = {one, number + 1};
    if (!is_first && other <= most) waiting[num++] = {other, second};
  }
}

double TriangleTree::nearer(const double* p, double least, double within, double enough, bool may_be_inside,
                            int& leaf) const {
  constexpr double kFar = std::numeric_limits<double>::infinity();
  const double bound = enough >= 0.0 && least <= within ? enough : std::min(std::max(least, 0.0), within);
  Hit best{bound * bound, -1, {0, 0, 0}, leaf};
  look(p, best, enough);
  leaf = best.leaf;
  const double found = best.face < 0 ? kFar : std::sqrt(best.squared);
  if (found <= enough || !may_be_inside || !(surrounds(p) > kInside)) return std::min(least, found);
  if (enough >= 0.0) return std::min(least, enough);
  if (best.face < 0) {
    best.squared = kFar;
    look(p, best);
  }
  return std::min(least, -std::sqrt(best.squared));
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
      Hit best{bound[i] * bound[i], -1, {0, 0, 0}, -1};
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
      const bool is_inside = one.may_be_inside && surrounds(one.p) > kInside;
      const double most = is_inside ? kFar : gap[at] + radius;
      Hit best{most < 0 ? -1.0 : most * most, -1, {0, 0, 0}, -1};
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

void TriangleTree::are_near(const double (*points)[kQueries], int num, const double* pose, const double* within,
                            std::uint8_t* out) const {
  if (nodes_.empty()) return;
  const Node& all = nodes_[0];
  for (int i = 0; i < num; ++i) {
    double squared = 0.0;
    for (int k = 0; k < 3; ++k) {
      const double* T = pose + 4 * k;
      const double at = T[0] * points[0][i] + T[1] * points[1][i] + T[2] * points[2][i] + T[3];
      const double below = all.low[k] - at, above = at - all.high[k], most = below > above ? below : above;
      const double beyond = most > kRounding ? most - kRounding : 0.0;
      squared += beyond * beyond;
    }
    out[i] = squared <= within[i] * within[i];
  }
}

void signed_distance(const PlacedTrees& placed, const AskedPoints& asked, double* distance, int num_threads) {
  const std::size_t num = placed.trees.size();
  parallel_for(parts(asked.num, kQueries), num_threads, [&](int chunk) {
    const int begin = chunk * kQueries, size = std::min(asked.num - begin, kQueries);
    double points[3][kQueries];
    for (int i = 0; i < size; ++i) {
      for (int k = 0; k < 3; ++k) points[k][i] = asked.points[3 * static_cast<std::size_t>(begin + i) + k];
    }
    std::vector<std::uint8_t> is_near(num * kQueries, 0);
    for (std::size_t k = 0; k < num; ++k) {
      placed.trees[k]->are_near(points, size, placed.poses + 12 * k, asked.within + begin, &is_near[k * kQueries]);
    }
    std::vector<int> leaves(num, -1);  // where the point before had its nearest triangle
    std::size_t nearest = 0;           // and of which tree
    for (int i = begin; i < begin + size; ++i) {
      std::size_t k = nearest;
      for (std::size_t n = 0; n < num && !(distance[i] <= asked.enough[i]); ++n, k = k + 1 < num ? k + 1 : 0) {
        if (!is_near[k * kQueries + i - begin]) continue;
        const double* T = placed.poses + 12 * k;
        const double R[9] = {T[0], T[1], T[2], T[4], T[5], T[6], T[8], T[9], T[10]}, t[3] = {T[3], T[7], T[11]};
        double p[3];
        moved(R, t, asked.points + 3 * static_cast<std::size_t>(i), p);
        const double found = placed.trees[k]->nearer(p, distance[i], asked.within[i], asked.enough[i],
                                                     asked.may_be_inside[i] != 0, leaves[k]);
        if (found < distance[i]) nearest = k;
        distance[i] = found;
      }
    }
  });
}

}  // namespace splatctrl
