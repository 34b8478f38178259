// Regular grids in blocks of 8^3 cells, and sub-blocks of 4^3: what every bake walks.
#pragma once

#include "field_clusters.h"
#include "parallel.h"

namespace splatctrl {

constexpr int kBlock = 8, kSubBlock = 4;
constexpr float kSqrt3 = 1.7320508f;

// Cells (i, j, k) centred at origin + voxel (i, j, k), in the frame of the spheres. Only the x-planes [first, last) are
// baked, into arrays of their own; `first` is a multiple of 8. mask: one byte per block of the whole grid (8 cells
// each way), zero where the block keeps what it has; null where all are baked.
struct GridSpan {
  double origin[3];
  double voxel;
  int size[3];
  int first, last;
  const unsigned char* mask;
  int num_threads;

  int blocks(int axis) const { return (size[axis] + kBlock - 1) / kBlock; }
  // Where cell (i, j, k) stands in the arrays.
  long cell(int i, int j, int k) const { return (static_cast<long>(i - first) * size[1] + j) * size[2] + k; }
  // Half the diagonal of the centres of `cells`^3 cells.
  float radius(int cells) const { return 0.5f * static_cast<float>((cells - 1) * voxel) * kSqrt3 * 1.000001f; }
};

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

// The middle of the centres of `cells`^3 cells.
inline Point middle(const GridSpan& grid, const int* lowest, int cells) {
  const double half = 0.5 * (cells - 1);
  return {static_cast<float>(grid.origin[0] + grid.voxel * (lowest[0] + half)),
          static_cast<float>(grid.origin[1] + grid.voxel * (lowest[1] + half)),
          static_cast<float>(grid.origin[2] + grid.voxel * (lowest[2] + half))};
}

// The same relative to `base`: less is lost than in the difference of two rounded points.
inline Point middle_from(const GridSpan& grid, const int* lowest, int cells, Point base) {
  const double half = 0.5 * (cells - 1);
  return {static_cast<float>(grid.origin[0] + grid.voxel * (lowest[0] + half) - base.x),
          static_cast<float>(grid.origin[1] + grid.voxel * (lowest[1] + half) - base.y),
          static_cast<float>(grid.origin[2] + grid.voxel * (lowest[2] + half) - base.z)};
}

// How much the difference of the distances to a and b can change within `radius` of a point at distances d_a and d_b
// from them; apart = |a - b|. Unit vectors u = (x - a) / |x - a|, v alike differ by at most 2 |a - b| / (|x - a| + |x - b|)
// (Dunkl and Williams, 1964), and by no more than 2.
inline Float8 turn(Float8 apart, Float8 d_a, float d_b, float radius) {
  const Float8 reach = max8(d_a + (d_b - 2.0f * radius), splat8(1e-30f));
  return radius * min8(2.0f * apart / reach, splat8(2.0f));
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
