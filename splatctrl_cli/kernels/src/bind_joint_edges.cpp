#include <cstring>
#include <vector>

#include "bind_chain.h"
#include "joint_edges.h"

namespace splatctrl {
namespace {

// Rows of doubles as the solids that they are.
template <typename Solid, typename Rows>
std::vector<Solid> solids_from(const Rows& rows) {
  static_assert(sizeof(Solid) % sizeof(double) == 0);
  expect(rows.shape(1) * sizeof(double) == sizeof(Solid), "solids: expected a row of numbers for each");
  std::vector<Solid> solids(rows.shape(0));
  if (!solids.empty()) std::memcpy(static_cast<void*>(solids.data()), rows.data(), solids.size() * sizeof(Solid));
  return solids;
}

void edges(const Integers& parent, const Integers& kind, const Placements& placement, const Triples& axis,
           const Integers& sphere_body, const Triples& offset, const Integers& moving,
           const Array<const long, nb::shape<-1, 2>>& pairs, const Doubles& taken, const Postures& levers, const Doubles& radius,
           const Array<const long, nb::shape<-1, 4>>& groups, const Doubles& group_taken, const Postures& group_levers,
           const Postures& balls, const Postures& boxes, const Postures& rods, const Postures& start, const Postures& end,
           double contact, double give_up, double rounding, double still, bool only_whole, int threads,
           const Array<double, nb::shape<-1>>& free_share, const Array<long, nb::shape<-1>>& num_checks) {
  const Chain chain = view_chain(parent, kind, placement, axis, sphere_body, offset);
  const size_t joints = parent.shape(0) - 1, rows = moving.shape(0) + pairs.shape(0), num = start.shape(0);
  expect(taken.shape(0) == rows && levers.shape(0) == rows && levers.shape(1) == joints, "rows: expected taken (R,), levers (R, J)");
  expect(start.shape(1) == joints && end.shape(0) == num && end.shape(1) == joints, "edges: expected start and end (E, J)");
  expect(free_share.shape(0) == num && num_checks.shape(0) == num, "edges: expected a share and a count for each");
  expect(contact > 0.0 && still > 0.0, "edges: expected contact and still above 0");
  for (size_t k = 0; k < moving.shape(0); ++k)
    expect(moving.data()[k] >= 0 && moving.data()[k] < chain.num_spheres, "moving: expected spheres that are there");
  for (size_t k = 0; k < 2 * pairs.shape(0); ++k)
    expect(pairs.data()[k] >= 0 && pairs.data()[k] < chain.num_spheres, "pairs: expected spheres that are there");
  const size_t num_groups = groups.shape(0), num_parts = radius.shape(0);
  expect(sphere_body.shape(0) >= num_parts, "chain: expected a middle of every part");
  expect(group_taken.shape(0) == num_groups && group_levers.shape(0) == num_groups && group_levers.shape(1) == joints,
         "groups: expected taken (G,), levers (G, J)");
  std::vector<RowGroup> row_groups(num_groups);
  const long parts = static_cast<long>(num_parts), num_moving = static_cast<long>(moving.shape(0));
  long next_row = 0;
  for (size_t g = 0; g < num_groups; ++g) {
    const long* row = groups.data() + 4 * g;
    row_groups[g] = {row[0], row[1], row[2], row[3]};
    const bool is_scene = row[1] == -1, are_of_one_kind = is_scene ? row[3] <= num_moving : row[2] >= num_moving;
    expect(row[0] >= 0 && row[0] < parts && row[1] >= -1 && row[1] < parts, "groups: expected parts that are there");
    expect(row[2] == next_row && row[3] >= next_row && are_of_one_kind, "groups: expected every row in one of them, in order");
    next_row = row[3];
  }
  expect(next_row == static_cast<long>(rows), "groups: expected every row in one of them, in order");
  const std::vector<Ball> all_balls = solids_from<Ball>(balls);
  const std::vector<Cuboid> all_boxes = solids_from<Cuboid>(boxes);
  const std::vector<Rod> all_rods = solids_from<Rod>(rods);
  const Room room{chain,
                  static_cast<int>(moving.shape(0)),
                  static_cast<int>(pairs.shape(0)),
                  static_cast<int>(num_parts),
                  static_cast<int>(num_groups),
                  moving.data(),
                  pairs.data(),
                  taken.data(),
                  levers.data(),
                  radius.data(),
                  row_groups.data(),
                  group_taken.data(),
                  group_levers.data(),
                  static_cast<int>(all_balls.size()),
                  static_cast<int>(all_boxes.size()),
                  static_cast<int>(all_rods.size()),
                  all_balls.data(),
                  all_boxes.data(),
                  all_rods.data()};
  const Advance advance{contact, give_up, rounding, still, only_whole};
  const nb::gil_scoped_release release;
  advance_edges(room, advance, start.data(), end.data(), static_cast<int>(num), threads, free_share.data(), num_checks.data());
}

}  // namespace

void bind_edges(nb::module_& m) {
  m.def("advance_edges", &edges, nb::arg("parent").noconvert(), nb::arg("kind").noconvert(), nb::arg("placement").noconvert(),
        nb::arg("axis").noconvert(), nb::arg("sphere_body").noconvert(), nb::arg("offset").noconvert(), nb::arg("moving").noconvert(),
        nb::arg("pairs").noconvert(), nb::arg("taken").noconvert(), nb::arg("levers").noconvert(), nb::arg("radius").noconvert(),
        nb::arg("groups").noconvert(), nb::arg("group_taken").noconvert(), nb::arg("group_levers").noconvert(),
        nb::arg("balls").noconvert(),
        nb::arg("boxes").noconvert(), nb::arg("rods").noconvert(), nb::arg("start").noconvert(), nb::arg("end").noconvert(),
        nb::arg("contact"), nb::arg("give_up"), nb::arg("rounding"), nb::arg("still"), nb::arg("only_whole"), nb::arg("threads"),
        nb::arg("free_share").noconvert(), nb::arg("num_checks").noconvert());
}

}  // namespace splatctrl
