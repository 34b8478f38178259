// The entity bits of III-C's voxels, by atomic OR.
#pragma once

#include <cstdint>

#include "voxel_grid.h"

namespace splatctrl {

// ORs bits of entity, and clears others, in every voxel that holds the point of a pixel with chosen (H, W) not zero.
// No bit may be in `set` and `clear`.
void label_hits(const VoxelGrid& grid, std::uint8_t* entity, const DepthImage& image, const std::uint8_t* chosen,
                std::uint8_t set, std::uint8_t clear, int num_threads);

// ORs `bits` into every voxel whose centre lies within radius + half a voxel diagonal of a sphere.
void mark_spheres(const VoxelGrid& grid, std::uint8_t* entity, const double* centers, const double* radii,
                  int num_spheres, std::uint8_t bits, int num_threads);

}  // namespace splatctrl
