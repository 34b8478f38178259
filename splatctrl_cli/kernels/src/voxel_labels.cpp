#include "voxel_labels.h"

#include <algorithm>
#include <cmath>

#include "parallel.h"

namespace splatctrl {

void label_hits(const VoxelGrid& grid, std::uint8_t* entity, const DepthImage& image, const std::uint8_t* chosen,
                std::uint8_t set, std::uint8_t clear, int num_threads) {
  constexpr int kRows = 16;
  parallel_for(parts(image.height, kRows), num_threads, [&](int chunk) {
    HitRow hits(grid, image);
    for (int v = chunk * kRows; v < std::min(image.height, (chunk + 1) * kRows); ++v) {
      const std::uint8_t* is_chosen = chosen + static_cast<std::size_t>(v) * image.width;
      if (std::none_of(is_chosen, is_chosen + image.width, [](std::uint8_t one) { return one != 0; })) continue;
      for (const std::int32_t index : hits.find(v)) {
        if (!*is_chosen++ || index < 0) continue;
        set_bits(entity + index, set);
        clear_bits(entity + index, clear);
      }
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
