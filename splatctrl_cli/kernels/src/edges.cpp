#include "edges.h"

#include <algorithm>
#include <vector>

#include "parallel.h"

namespace splatctrl {
namespace {

struct Interval {
  double low, high;
};

// One edge, and what a posture on it is measured with; the vectors are kept from posture to posture.
class Edge {
 public:
  Edge(const Room& room, const Advance& advance, const double* start, const double* end)
      : room_(room), advance_(advance), start_(start), joints_(room.chain.num_bodies - 1), rows_(room.num_moving + room.num_pairs) {
    for (int j = 0; j < joints_; ++j) {
      motion_.push_back(end[j] - start[j]);
      length_ += motion_[j] * motion_[j];
    }
    length_ = std::sqrt(length_);
    speed_.assign(rows_, 0.0);
    for (int j = 0; j < joints_; ++j) {
      const double moved = std::fabs(motion_[j]), *lever = room.levers + static_cast<long>(j) * rows_;
      for (int r = 0; r < rows_; ++r) speed_[r] += moved * lever[r];
    }
    for (double& v : speed_) v = std::max(v, advance.still);
    posture_.resize(joints_);
    centers_.resize(3 * static_cast<size_t>(room.chain.num_spheres));
  }

  // Breadth first: the middles of what is open, then of what they leave open.
  double proved(long& num_checks) {
    std::vector<Interval> open{{0.0, 1.0}}, next;
    double free = 1.0;
    while (!open.empty()) {
      next.clear();
      for (const Interval& part : open) {
        const double middle = (part.low + part.high) / 2;
        const double covered = clear_to_both_sides(middle, part.high - part.low);
        ++num_checks;
        if (!(covered > 0.0)) {
          if (advance_.only_whole) return 0.0;
          free = std::min(free, middle);
        }
        next.push_back({part.low, middle - covered});
        next.push_back({middle + covered, part.high});
      }
      const double bound = free;  // before what is too short lowers it
      for (const Interval& part : next)
        if (is_open(part, bound) && is_too_short(part, bound)) free = std::min(free, part.low);
      if (advance_.only_whole && free < 1.0) return 0.0;
      open.clear();
      for (const Interval& part : next)
        if (is_open(part, bound) && !is_too_short(part, bound) && part.low < free) open.push_back({part.low, std::min(part.high, bound)});
    }
    return free;
  }

 private:
  static bool is_open(const Interval& part, double free) { return part.low < std::min(part.high, free); }

  // Of what is left before a collision.
  bool is_too_short(const Interval& part, double free) const {
    return free < 1.0 && part.high >= free && (free - part.low) * length_ < advance_.give_up;
  }

  // The share of the edge that is free to both sides of a place on it, as far as `enough`; 0 in collision.
  double clear_to_both_sides(double place, double enough) {
    for (int j = 0; j < joints_; ++j) posture_[j] = start_[j] + place * motion_[j];
    sphere_centers(room_.chain, posture_.data(), 1, 1, centers_.data());
    covered_ = enough;
    for (int m = 0; m < room_.num_moving; ++m) {
      const Vector3 p = center(room_.moving[m]);
      for (int k = 0; k < room_.num_balls; ++k) {
        const Ball& ball = room_.balls[k];
        if (!keep_row(m, square(p, {ball.center[0], ball.center[1], ball.center[2]}), ball.radius)) return 0.0;
      }
      for (int k = 0; k < room_.num_boxes; ++k)
        if (!keep_solid(m, beyond_faces(room_.boxes[k], p), 0.0)) return 0.0;
      for (int k = 0; k < room_.num_rods; ++k)
        if (!keep_solid(m, beyond_faces(room_.rods[k], p), room_.rods[k].round)) return 0.0;
    }
    for (int k = 0; k < room_.num_pairs; ++k)
      if (!keep_row(room_.num_moving + k, square(center(room_.pairs[2 * k]), center(room_.pairs[2 * k + 1])), 0.0)) return 0.0;
    return covered_;
  }

  Vector3 center(long sphere) const { return {centers_[3 * sphere], centers_[3 * sphere + 1], centers_[3 * sphere + 2]}; }

  static double square(Vector3 a, Vector3 b) {
    const double x = a.x - b.x, y = a.y - b.y, z = a.z - b.z;
    return x * x + y * y + z * z;
  }

  // The distance that a row needs so as not to shorten `covered_`, nor to be in collision.
  double needed(int row) const {
    return room_.taken[row] + advance_.rounding + std::max(covered_ * speed_[row], advance_.contact);
  }

  // Takes in a row whose distance is the root of `squared` less `more`; false in collision. Most need no root.
  bool keep_row(int row, double squared, double more) {
    const double enough = needed(row) + more;
    return squared >= enough * enough || take(row, std::sqrt(squared) - more);
  }

  bool keep_solid(int row, Vector3 beyond, double more) {
    const double enough = needed(row) + more;
    return squared_outside(beyond.x, beyond.y, beyond.z) >= enough * enough || take(row, signed_distance(beyond) - more);
  }

  bool take(int row, double distance) {
    const double left = distance - room_.taken[row] - advance_.rounding;
    covered_ = std::min(covered_, left / speed_[row]);
    return left >= advance_.contact;
  }

  const Room& room_;
  const Advance& advance_;
  const double* start_;
  int joints_, rows_;
  double length_ = 0.0, covered_ = 0.0;
  std::vector<double> motion_, speed_, posture_, centers_;
};

}  // namespace

void advance_edges(const Room& room, const Advance& advance, const double* start, const double* end, int num_edges, int num_threads,
                   double* free_share, long* num_checks) {
  const int joints = room.chain.num_bodies - 1;
  parallel_for(num_edges, num_threads, [&](int e) {
    num_checks[e] = 0;
    free_share[e] = Edge(room, advance, start + static_cast<long>(e) * joints, end + static_cast<long>(e) * joints).proved(num_checks[e]);
  });
}

}  // namespace splatctrl
