// Regular grids in blocks of 8^3 cells, and sub-blocks of 4^3: what every bake walks.
#pragma once

#include "field_clusters.h"
#include "parallel.h"

namespace splatctrl {

// Calls fn(lowest cell, work) for each block that is to be baked; the blocks of one column share a Work.
template <typename Work, typename Fn>
void for_each_block(const GridSpan& grid, const Fn& fn) {
  const int columns_y = grid.blocks(1), first = grid.first / kBlock, last = (grid.last + kBlock - 1) / kBlock;
  parallel_for((last - first) * columns_y, grid.num_threads, [&](int column) {
    Work work;
    const int i = first + column / columns_y, j = column % columns_y;
    for (int k = 0; k < grid.blocks(2); ++k) {
      if (grid.mask != nullptr && !grid.mask[(static_cast<long>(i) * columns_y + j) * grid.blocks(2) + k]) continue;
      const int lowest[3] = {kBlock * i, kBlock * j, kBlock * k};
      fn(lowest, work);
    }
  });
}

// Calls fn(lowest cell) for the sub-blocks of a block that have a cell in the grid.
template <typename Fn>
void for_each_sub_block(const GridSpan& grid, const int* block, const Fn& fn) {
  for (int i = block[0]; i < block[0] + kBlock && i < grid.last; i += kSubBlock)
    for (int j = block[1]; j < block[1] + kBlock && j < grid.size[1]; j += kSubBlock)
      for (int k = block[2]; k < block[2] + kBlock && k < grid.size[2]; k += kSubBlock) {
        const int lowest[3] = {i, j, k};
        fn(lowest);
      }
}

// 16 cells of a sub-block at one x: four along y by four along z, relative to the middle of the sub-block.
struct Slab {
  float x;
  Float8 y[2], z[2];
};

inline Slab slab_of(const GridSpan& grid, int plane) {
  const auto voxel = static_cast<float>(grid.voxel);
  Slab slab;
  slab.x = voxel * (static_cast<float>(plane) - 0.5f * (kSubBlock - 1));
  for (int k = 0; k < kLanes; ++k) {
    slab.y[k / 8][k % 8] = voxel * (static_cast<float>(k / kSubBlock) - 0.5f * (kSubBlock - 1));
    slab.z[k / 8][k % 8] = voxel * (static_cast<float>(k % kSubBlock) - 0.5f * (kSubBlock - 1));
  }
  return slab;
}

// Writes values of the lanes (16) at one x-plane of a sub-block, `stride` floats from cell to cell, where the grid has
// those cells.
inline void write_slab(const GridSpan& grid, const int* lowest, int plane, const float* values, float* out, int stride) {
  for (int lane = 0; lane < kLanes; ++lane) {
    const int j = lowest[1] + lane / kSubBlock, k = lowest[2] + lane % kSubBlock;
    if (j < grid.size[1] && k < grid.size[2]) out[stride * grid.cell(lowest[0] + plane, j, k)] = values[lane];
  }
}

}  // namespace splatctrl
