// Occupancy grid: see kernels/occupancy.py for shapes.
#include <stdexcept>

#include "bind.h"
#include "voxel_labels.h"
#include "occupancy.h"

namespace splatctrl {
namespace {

// grid: origin (3), voxel, size (3).
VoxelGrid grid_from(const Array<const double>& values, std::size_t num_voxels) {
  if (values.size() != 7) throw std::invalid_argument("grid: expected 7 numbers");
  const double* p = values.data();
  const VoxelGrid grid{{p[0], p[1], p[2]},
                       p[3],
                       {static_cast<int>(p[4]), static_cast<int>(p[5]), static_cast<int>(p[6])}};
  if (static_cast<std::size_t>(grid.size[0]) * grid.size[1] * grid.size[2] != num_voxels) {
    throw std::invalid_argument("grid: its size and the voxel arrays disagree");
  }
  return grid;
}

// intrinsics: fx, fy, cx, cy, width, height.
DepthImage image_from(const Array<const double>& intrinsics, const Array<const double>& T_world_camera,
                      const Array<const float>& depth, float min_range, float max_range) {
  const double* k = intrinsics.data();
  if (intrinsics.size() != 6 || T_world_camera.size() != 16 || depth.size() != static_cast<std::size_t>(k[4] * k[5])) {
    throw std::invalid_argument("expected intrinsics (6,), T_world_camera (4, 4), depth (H, W)");
  }
  return {k[0],      k[1], k[2], k[3], static_cast<int>(k[4]), static_cast<int>(k[5]), T_world_camera.data(),
          depth.data(), min_range, max_range};
}

}  // namespace

void bind_occupancy(nb::module_& m) {
  m.def(
      "integrate_depth",
      [](const Array<const double>& grid, const Array<float>& log_odds, const Array<std::uint16_t>& num_updates,
         const Array<std::uint16_t>& last_seen, const Array<std::uint8_t>& hits, const Array<const double>& intrinsics,
         const Array<const double>& T_world_camera, const Array<const float>& depth, float min_range,
         float max_range, float hit, float miss, float limit, std::uint16_t step, int num_threads) {
        const VoxelGrid g = grid_from(grid, log_odds.size());
        const DepthImage image = image_from(intrinsics, T_world_camera, depth, min_range, max_range);
        if (num_updates.size() != log_odds.size() || last_seen.size() != log_odds.size() ||
            hits.size() != log_odds.size()) {
          throw std::invalid_argument("expected voxel arrays of one shape");
        }
        const nb::gil_scoped_release release;
        integrate_depth(g, {log_odds.data(), num_updates.data(), last_seen.data(), hits.data()}, image,
                        {hit, miss, limit}, step, num_threads);
      },
      nb::arg("grid").noconvert(), nb::arg("log_odds").noconvert(), nb::arg("num_updates").noconvert(),
      nb::arg("last_seen").noconvert(), nb::arg("hits").noconvert(), nb::arg("intrinsics").noconvert(), nb::arg("T_world_camera").noconvert(),
      nb::arg("depth").noconvert(), nb::arg("min_range"), nb::arg("max_range"), nb::arg("hit"), nb::arg("miss"),
      nb::arg("limit"), nb::arg("step"), nb::arg("num_threads"));
  m.def(
      "label_hits",
      [](const Array<const double>& grid, const Array<std::uint8_t>& entity, const Array<const double>& intrinsics,
         const Array<const double>& T_world_camera, const Array<const float>& depth,
         const Array<const std::uint8_t>& chosen, float min_range, float max_range, std::uint8_t set,
         std::uint8_t clear, int num_threads) {
        const VoxelGrid g = grid_from(grid, entity.size());
        const DepthImage image = image_from(intrinsics, T_world_camera, depth, min_range, max_range);
        if (chosen.size() != depth.size()) throw std::invalid_argument("chosen: expected (H, W), as depth");
        if (set & clear) throw std::invalid_argument("set, clear: expected no bit of both");
        const nb::gil_scoped_release release;
        label_hits(g, entity.data(), image, chosen.data(), set, clear, num_threads);
      },
      nb::arg("grid").noconvert(), nb::arg("entity").noconvert(), nb::arg("intrinsics").noconvert(),
      nb::arg("T_world_camera").noconvert(), nb::arg("depth").noconvert(), nb::arg("chosen").noconvert(),
      nb::arg("min_range"), nb::arg("max_range"), nb::arg("set"), nb::arg("clear"), nb::arg("num_threads"));
  m.def(
      "mark_spheres",
      [](const Array<const double>& grid, const Array<std::uint8_t>& entity, const Array<const double>& centers,
         const Array<const double>& radii, std::uint8_t bits, int num_threads) {
        const VoxelGrid g = grid_from(grid, entity.size());
        if (centers.size() != 3 * radii.size()) throw std::invalid_argument("centers: expected (S, 3)");
        const nb::gil_scoped_release release;
        mark_spheres(g, entity.data(), centers.data(), radii.data(), static_cast<int>(radii.size()), bits,
                     num_threads);
      },
      nb::arg("grid").noconvert(), nb::arg("entity").noconvert(), nb::arg("centers").noconvert(),
      nb::arg("radii").noconvert(), nb::arg("bits"), nb::arg("num_threads"));
}

}  // namespace splatctrl
