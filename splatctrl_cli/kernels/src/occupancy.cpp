#include "occupancy.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>

#include "parallel.h"

namespace splatctrl {
namespace {

// Marks are only ever set to one, so that threads may set the same one: no order, no lost update.
void mark(std::uint8_t* voxel) {
  if (!__atomic_load_n(voxel, __ATOMIC_RELAXED)) __atomic_store_n(voxel, std::uint8_t{1}, __ATOMIC_RELAXED);
}

void set_bits(std::uint8_t* voxel, std::uint8_t bits) {
  if ((__atomic_load_n(voxel, __ATOMIC_RELAXED) & bits) != bits) __atomic_fetch_or(voxel, bits, __ATOMIC_RELAXED);
}

std::size_t index_of(const VoxelGrid& grid, const int* cell) {
  return (static_cast<std::size_t>(cell[0]) * grid.size[1] + cell[1]) * grid.size[2] + cell[2];
}

// A segment in grid coordinates (voxel units, voxel i spans [i, i + 1)), cut to the grid.
struct Segment {
  double from[3], direction[3];
  double enter = 0.0, leave = 1.0;
  bool clip(const VoxelGrid& grid) {
    for (int axis = 0; axis < 3; ++axis) {
      const double size = grid.size[axis];
      if (direction[axis] == 0.0) {
        if (from[axis] < 0.0 || from[axis] >= size) return false;
        continue;
      }
      const double a = -from[axis] / direction[axis], b = (size - from[axis]) / direction[axis];
      enter = std::max(enter, std::min(a, b));
      leave = std::min(leave, std::max(a, b));
    }
    return enter < leave;
  }
};

// Amanatides and Woo's walk: marks every voxel the segment passes, up to but not including the end voxel.
void walk(const VoxelGrid& grid, const Segment& s, const int* end, std::uint8_t* misses) {
  int cell[3], step[3], border[3];
  std::ptrdiff_t stride[3] = {static_cast<std::ptrdiff_t>(grid.size[1]) * grid.size[2], grid.size[2], 1};
  double next[3], delta[3];
  for (int axis = 0; axis < 3; ++axis) {
    const double start = s.from[axis] + s.enter * s.direction[axis];
    cell[axis] = std::clamp(static_cast<int>(std::floor(start)), 0, grid.size[axis] - 1);
    step[axis] = s.direction[axis] > 0.0 ? 1 : -1;
    border[axis] = step[axis] > 0 ? grid.size[axis] : -1;
    stride[axis] *= step[axis];
    if (s.direction[axis] == 0.0) {
      next[axis] = delta[axis] = std::numeric_limits<double>::infinity();
    } else {
      next[axis] = (cell[axis] + (step[axis] > 0 ? 1.0 : 0.0) - s.from[axis]) / s.direction[axis];
      delta[axis] = std::abs(1.0 / s.direction[axis]);
    }
  }
  std::uint8_t* voxel = misses + index_of(grid, cell);
  const bool ends_inside = end[0] >= 0 && end[0] < grid.size[0] && end[1] >= 0 && end[1] < grid.size[1] &&
                           end[2] >= 0 && end[2] < grid.size[2];
  const std::uint8_t* last = ends_inside ? misses + index_of(grid, end) : nullptr;
  while (voxel != last) {
    mark(voxel);
    const int axis = next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
    if (next[axis] > s.leave) return;
    cell[axis] += step[axis];
    if (cell[axis] == border[axis]) return;
    voxel += stride[axis];
    next[axis] += delta[axis];
  }
}

}  // namespace

void integrate_depth(const VoxelGrid& grid, float* log_odds, std::uint16_t* num_updates, std::uint8_t* marks,
                     const Camera& camera, const double* T, const float* depth, const OccupancySettings& settings,
                     int num_threads) {
  const double scale = 1.0 / grid.voxel;
  double eye[3];
  for (int axis = 0; axis < 3; ++axis) eye[axis] = (T[4 * axis + 3] - grid.origin[axis]) * scale + 0.5;
  const std::size_t slab = static_cast<std::size_t>(grid.size[1]) * grid.size[2];
  std::uint8_t *hits = marks, *misses = marks + slab * grid.size[0];
  constexpr int kRows = 8;
  parallel_for((camera.height + kRows - 1) / kRows, num_threads, [&](int chunk) {
    for (int v = chunk * kRows; v < std::min(camera.height, (chunk + 1) * kRows); ++v) {
      for (int u = 0; u < camera.width; ++u) {
        const double z = depth[static_cast<std::size_t>(v) * camera.width + u];
        if (!(z > 0.0) || !(z <= settings.max_range)) continue;
        const double p[3] = {(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z};
        Segment s;
        int end[3];
        bool ends_inside = true;
        for (int axis = 0; axis < 3; ++axis) {
          s.from[axis] = eye[axis];
          s.direction[axis] = (T[4 * axis] * p[0] + T[4 * axis + 1] * p[1] + T[4 * axis + 2] * p[2]) * scale;
          end[axis] = static_cast<int>(std::floor(s.from[axis] + s.direction[axis]));
          ends_inside = ends_inside && end[axis] >= 0 && end[axis] < grid.size[axis];
        }
        if (ends_inside) mark(hits + index_of(grid, end));
        if (u % settings.stride == 0 && v % settings.stride == 0 && s.clip(grid)) walk(grid, s, end, misses);
      }
    }
  });
  parallel_for(grid.size[0], num_threads, [&](int i) {
    for (std::size_t k = i * slab; k < (i + 1) * slab; ++k) {
      if (!hits[k] && !misses[k]) continue;
      const float change = hits[k] ? settings.hit : settings.miss;
      log_odds[k] = std::clamp(log_odds[k] + change, -settings.limit, settings.limit);
      if (num_updates[k] < 65535) ++num_updates[k];
      hits[k] = misses[k] = 0;
    }
  });
}

void mark_spheres(const VoxelGrid& grid, std::uint8_t* entity, const double* centers, const double* radii,
                  int num_spheres, std::uint8_t bits, int num_threads) {
  const double half_diagonal = 0.5 * std::sqrt(3.0) * grid.voxel;
  parallel_for(num_spheres, num_threads, [&](int sphere) {
    const double* center = centers + 3 * sphere;
    const double reach = radii[sphere] + half_diagonal;
    int low[3], high[3], cell[3];
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = std::max(0, static_cast<int>(std::ceil((center[axis] - reach - grid.origin[axis]) / grid.voxel)));
      high[axis] = std::min(grid.size[axis] - 1,
                            static_cast<int>(std::floor((center[axis] + reach - grid.origin[axis]) / grid.voxel)));
    }
    for (cell[0] = low[0]; cell[0] <= high[0]; ++cell[0]) {
      for (cell[1] = low[1]; cell[1] <= high[1]; ++cell[1]) {
        for (cell[2] = low[2]; cell[2] <= high[2]; ++cell[2]) {
          double squared = 0.0;
          for (int axis = 0; axis < 3; ++axis) {
            const double d = grid.origin[axis] + grid.voxel * cell[axis] - center[axis];
            squared += d * d;
          }
          if (squared <= reach * reach) set_bits(entity + index_of(grid, cell), bits);
        }
      }
    }
  });
}

}  // namespace splatctrl
