// The log-odds voxel grid of III-C: one depth image at a time, and entity bits by atomic OR.
#pragma once

#include <cstdint>

#include "projection.h"

namespace splatctrl {

struct VoxelGrid {
  double origin[3];  // centre of voxel (0, 0, 0) [m], world
  double voxel;      // [m]
  int size[3];       // X, Y, Z; index (i Y + j) Z + k
};

struct OccupancySettings {
  float hit, miss, limit;  // log odds
  float max_range;         // [m] along the optical axis
  int stride;              // every stride-th pixel and row carves free space; every pixel marks its hit
};

// Walks a ray from the camera to each pixel's depth: voxels passed are misses, the last one a hit; a hit outweighs
// every miss of the same image. marks (2 X Y Z) uint8 is scratch and must be zero; it is zero again afterwards.
void integrate_depth(const VoxelGrid& grid, float* log_odds, std::uint16_t* num_updates, std::uint8_t* marks,
                     const Camera& camera, const double* T_world_camera, const float* depth,
                     const OccupancySettings& settings, int num_threads);

// ORs `bits` into every voxel whose centre lies within radius + half a voxel diagonal of a sphere.
void mark_spheres(const VoxelGrid& grid, std::uint8_t* entity, const double* centers, const double* radii,
                  int num_spheres, std::uint8_t bits, int num_threads);

}  // namespace splatctrl
