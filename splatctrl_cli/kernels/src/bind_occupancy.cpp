// Occupancy grid: see kernels/occupancy.py for shapes.
#include <stdexcept>

#include "bind.h"
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

}  // namespace

void bind_occupancy(nb::module_& m) {
  m.def(
      "integrate_depth",
      [](const Array<const double>& grid, const Array<float>& log_odds, const Array<std::uint16_t>& num_updates,
         const Array<std::uint8_t>& marks, const Array<const double>& intrinsics,
         const Array<const double>& T_world_camera, const Array<const float>& depth, float hit, float miss,
         float limit, float max_range, int stride, int num_threads) {
        const VoxelGrid g = grid_from(grid, log_odds.size());
        Camera camera{};
        const double* k = intrinsics.data();
        camera.fx = static_cast<float>(k[0]);
        camera.fy = static_cast<float>(k[1]);
        camera.cx = static_cast<float>(k[2]);
        camera.cy = static_cast<float>(k[3]);
        camera.width = static_cast<int>(k[4]);
        camera.height = static_cast<int>(k[5]);
        if (num_updates.size() != log_odds.size() || marks.size() != 2 * log_odds.size() || intrinsics.size() != 6 ||
            T_world_camera.size() != 16 ||
            depth.size() != static_cast<std::size_t>(camera.width) * camera.height || stride < 1) {
          throw std::invalid_argument("expected voxel arrays of one shape, intrinsics (6,), T (4, 4), depth (H, W)");
        }
        const nb::gil_scoped_release release;
        integrate_depth(g, log_odds.data(), num_updates.data(), marks.data(), camera, T_world_camera.data(),
                        depth.data(), {hit, miss, limit, max_range, stride}, num_threads);
      },
      nb::arg("grid").noconvert(), nb::arg("log_odds").noconvert(), nb::arg("num_updates").noconvert(),
      nb::arg("marks").noconvert(), nb::arg("intrinsics").noconvert(), nb::arg("T_world_camera").noconvert(),
      nb::arg("depth").noconvert(), nb::arg("hit"), nb::arg("miss"), nb::arg("limit"), nb::arg("max_range"),
      nb::arg("stride"), nb::arg("num_threads"));
  m.def(
      "mark_spheres",
      [](const Array<const double>& grid, const Array<std::uint8_t>& entity, const Array<const double>& centers,
         const Array<const double>& radii, std::uint8_t bit, int num_threads) {
        const VoxelGrid g = grid_from(grid, entity.size());
        if (centers.size() != 3 * radii.size()) throw std::invalid_argument("centers: expected (S, 3)");
        const nb::gil_scoped_release release;
        mark_spheres(g, entity.data(), centers.data(), radii.data(), static_cast<int>(radii.size()), bit,
                     num_threads);
      },
      nb::arg("grid").noconvert(), nb::arg("entity").noconvert(), nb::arg("centers").noconvert(),
      nb::arg("radii").noconvert(), nb::arg("bit"), nb::arg("num_threads"));
}

}  // namespace splatctrl
