// The log-odds voxel grid of III-C, one depth image at a time.
#pragma once

#include <cstdint>

#include "voxel_grid.h"

namespace splatctrl {

struct LogOdds {
  float hit, miss, limit;
};

// Arrays of one shape. last_seen becomes `step` where a voxel changes. hits is scratch: it must be zero, and is zero
// again afterwards.
struct VoxelArrays {
  float* log_odds;
  std::uint16_t* num_updates;
  std::uint16_t* last_seen;
  std::uint8_t* hits;
};

// A voxel that holds the point of any pixel is a hit. Else it is a miss where its centre falls on a pixel that
// reaches beyond it (DepthReach): the ray has passed, and ends in another voxel. log odds change by `hit` or `miss`
// within +-limit.
void integrate_depth(const VoxelGrid& grid, const VoxelArrays& voxels, const DepthImage& image, const LogOdds& change,
                     std::uint16_t step, int num_threads);

}  // namespace splatctrl
