#include "joint_edges.h"

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
      : room_(room), advance_(advance), start_(start), joints_(room.chain.num_bodies - 1) {
    for (int j = 0; j < joints_; ++j) {
      motion_.push_back(end[j] - start[j]);
      length_ += motion_[j] * motion_[j];
    }
    length_ = std::sqrt(length_);
    for (int g = 0; g < room.num_groups; ++g) group_speed_.push_back(lost_over_edge(room.group_levers + g * joints_));
    speed_.assign(room.num_moving + room.num_pairs, -1.0);
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

  double lost_over_edge(const double* levers) const {
    double lost = 0.0;
    for (int j = 0; j < joints_; ++j) lost += std::fabs(motion_[j]) * levers[j];
    return std::max(lost, advance_.still);
  }

  // The share of the edge that is free to both sides of a place on it, as far as `enough`; 0 in collision.
  double clear_to_both_sides(double place, double enough) {
    for (int j = 0; j < joints_; ++j) posture_[j] = start_[j] + place * motion_[j];
    sphere_centers(room_.chain, posture_.data(), 1, 1, centers_.data());
    covered_ = enough;
    for (int g = 0; g < room_.num_groups; ++g)
      if (!(room_.groups[g].second < 0 ? keep_scene_group(g) : keep_pair_group(g))) return 0.0;
    return covered_;
  }

  bool keep_scene_group(int g) {
    const RowGroup& group = room_.groups[g];
    const Vector3 middle = middle_of(group.first);
    const double radius = room_.radius[group.first];
    for (int k = 0; k < room_.num_balls; ++k) {
      const Ball& ball = room_.balls[k];
      const Vector3 to{ball.center[0], ball.center[1], ball.center[2]};
      if (squared(middle, to) >= square(group_needs(g) + radius + ball.radius)) continue;
      for (long row = group.begin; row < group.end; ++row)
        if (!keep_row(row, squared(center(room_.moving[row]), to), ball.radius)) return false;
    }
    for (int k = 0; k < room_.num_boxes; ++k)
      if (!keep_solid(g, middle, radius, room_.boxes[k], 0.0)) return false;
    for (int k = 0; k < room_.num_rods; ++k)
      if (!keep_solid(g, middle, radius, room_.rods[k], room_.rods[k].round)) return false;
    return true;
  }

  template <typename Solid>
  bool keep_solid(int g, Vector3 middle, double radius, const Solid& solid, double round) {
    const Vector3 away = beyond_faces(solid, middle);
    if (squared_outside(away.x, away.y, away.z) >= square(group_needs(g) + radius + round)) return true;
    for (long row = room_.groups[g].begin; row < room_.groups[g].end; ++row) {
      const Vector3 beyond = beyond_faces(solid, center(room_.moving[row]));
      if (squared_outside(beyond.x, beyond.y, beyond.z) >= square(needs(row) + round)) continue;
      if (!take(row, signed_distance(beyond) - round)) return false;
    }
    return true;
  }

  bool keep_pair_group(int g) {
    const RowGroup& group = room_.groups[g];
    const double reach = group_needs(g) + room_.radius[group.first] + room_.radius[group.second];
    if (squared(middle_of(group.first), middle_of(group.second)) >= square(reach)) return true;
    for (long row = group.begin; row < group.end; ++row) {
      const long* pair = room_.pairs + 2 * (row - room_.num_moving);
      if (!keep_row(row, squared(center(pair[0]), center(pair[1])), 0.0)) return false;
    }
    return true;
  }

  Vector3 center(long sphere) const { return {centers_[3 * sphere], centers_[3 * sphere + 1], centers_[3 * sphere + 2]}; }

  Vector3 middle_of(long part) const { return center(room_.chain.num_spheres - room_.num_parts + part); }

  static double square(double v) { return v * v; }

  static double squared(Vector3 a, Vector3 b) { return square(a.x - b.x) + square(a.y - b.y) + square(a.z - b.z); }

  // The distance that rows need so as neither to shorten `covered_` nor to be in collision.
  double group_needs(int g) const {
    return room_.group_taken[g] + advance_.rounding + std::max(covered_ * group_speed_[g], advance_.contact);
  }

  double needs(long row) { return room_.taken[row] + advance_.rounding + std::max(covered_ * speed_of(row), advance_.contact); }

  double speed_of(long row) {
    if (speed_[row] < 0.0) speed_[row] = lost_over_edge(room_.levers + row * joints_);
    return speed_[row];
  }

  // Takes in a row whose distance is the root of `apart` less `more`; false in collision. Most need no root.
  bool keep_row(long row, double apart, double more) {
    return apart >= square(needs(row) + more) || take(row, std::sqrt(apart) - more);
  }

  bool take(long row, double distance) {
    const double left = distance - room_.taken[row] - advance_.rounding;
    covered_ = std::min(covered_, left / speed_of(row));
    return left >= advance_.contact;
  }

  const Room& room_;
  const Advance& advance_;
  const double* start_;
  int joints_;
  double length_ = 0.0, covered_ = 0.0;
  std::vector<double> motion_, group_speed_, speed_, posture_, centers_;
};

}  // namespace

void advance_edges(const Room& room, const Advance& advance, const double* start, const double* end, int num_edges, int num_threads,
                   double* free_share, long* num_checks) {
  const long joints = room.chain.num_bodies - 1;
  parallel_for(num_edges, num_threads, [&](int e) {
    num_checks[e] = 0;
    free_share[e] = Edge(room, advance, start + e * joints, end + e * joints).proved(num_checks[e]);
  });
}

}  // namespace splatctrl
