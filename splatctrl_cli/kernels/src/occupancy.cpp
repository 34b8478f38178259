// Every voxel looks back along its own ray, so that the work is one look per voxel before a surface, however many
// rays cross it. Blocks of voxels that no ray reaches, or that all rays pass, are told from squares of pixels.
#include "occupancy.h"

#include <algorithm>
#include <cstring>
#include <limits>
#include <vector>

#include "depth_reach.h"
#include "parallel.h"
#include "simd.h"

namespace splatctrl {
namespace {

constexpr int kLanes = 8;             // voxels in a row, along the last axis
constexpr int kBlock = 8, kSuper = 16;  // voxels along each edge of a block, and of a block of blocks
constexpr float kNear = 1e-3f;        // [m] before the camera's plane; nearer, nothing is projected
constexpr float kSlack = 1e-4f;       // [m] that single precision may be off by, and more
constexpr float kSpare = 1.5f;        // pixels: that, and rounding to a pixel

typedef std::uint16_t Count8 __attribute__((vector_size(16), aligned(16)));
typedef std::uint8_t Byte8 __attribute__((vector_size(8), aligned(8)));

// Where voxel centres fall on the image of DepthReach: (u z, v z, z) is linear in the voxel's indices.
struct Projection {
  double first[3];    // of voxel (0, 0, 0)
  double step[3][3];  // per voxel along each axis

  Projection(const VoxelGrid& grid, const DepthImage& image) {
    const double* T = image.T_world_camera;
    for (int axis = 0; axis < 3; ++axis) {
      const double x = T[4 * axis] * grid.voxel, y = T[4 * axis + 1] * grid.voxel, z = T[4 * axis + 2] * grid.voxel;
      step[axis][0] = image.fx * x + (image.cx + kTile) * z;
      step[axis][1] = image.fy * y + (image.cy + kTile) * z;
      step[axis][2] = z;
    }
    for (int i = 0; i < 3; ++i) {
      first[i] = 0.0;
      for (int axis = 0; axis < 3; ++axis) {
        first[i] += step[axis][i] * (grid.origin[axis] - T[4 * axis + 3]) / grid.voxel;
      }
    }
  }

  void at(const int* cell, double* out) const {
    for (int i = 0; i < 3; ++i) {
      out[i] = first[i] + cell[0] * step[0][i] + cell[1] * step[1][i] + cell[2] * step[2][i];
    }
  }
};

// Voxels from low up to, not including, high along each axis.
struct VoxelBox {
  int low[3], high[3];

  // The part of a grid (or box) of edge `edge` that starts at low.
  VoxelBox(int i, int j, int k, int edge, const int* end)
      : low{i, j, k}, high{std::min(i + edge, end[0]), std::min(j + edge, end[1]), std::min(k + edge, end[2])} {}
};

enum class Passed { kNone, kSome, kAll };  // of the voxels of a box: by the rays through their centres

float least_of(Float8 v) {
  return std::min(std::min(std::min(v[0], v[1]), std::min(v[2], v[3])),
                  std::min(std::min(v[4], v[5]), std::min(v[6], v[7])));
}

bool all8(Int8 mask) { return !any8(~mask); }

// kNone and kAll are certain; kSome may be any.
Passed passed_of(const VoxelBox& box, const Projection& projection, const DepthReach& seen) {
  double base[3];
  projection.at(box.low, base);
  Float8 corner[3];
  for (int i = 0; i < 3; ++i) {
    const float x = static_cast<float>((box.high[0] - 1 - box.low[0]) * projection.step[0][i]);
    const float y = static_cast<float>((box.high[1] - 1 - box.low[1]) * projection.step[1][i]);
    const float z = static_cast<float>((box.high[2] - 1 - box.low[2]) * projection.step[2][i]);
    corner[i] = static_cast<float>(base[i]) + Float8{0, x, 0, x, 0, x, 0, x} + Float8{0, 0, y, y, 0, 0, y, y} +
                Float8{0, 0, 0, 0, z, z, z, z};
  }
  const float width = static_cast<float>(seen.width), height = static_cast<float>(seen.height);
  const float nearest = least_of(corner[2]) - kSlack, farthest = -least_of(-corner[2]) + kSlack;
  // Behind the camera, or beside the image on one side of it: this holds for corners behind the camera too.
  if (farthest < kNear || all8(corner[0] < -kSpare * corner[2]) || all8(corner[1] < -kSpare * corner[2]) ||
      all8(corner[0] > (width + kSpare) * corner[2]) || all8(corner[1] > (height + kSpare) * corner[2])) {
    return Passed::kNone;
  }
  if (nearest < kNear) return Passed::kSome;
  const Float8 u = corner[0] / corner[2], v = corner[1] / corner[2];
  const float left = least_of(u) - kSpare, right = -least_of(-u) + kSpare;
  const float top = least_of(v) - kSpare, bottom = -least_of(-v) + kSpare;
  const int first_column = static_cast<int>(std::max(left, 0.0f)) / kTile;
  const int last_column = static_cast<int>(std::min(right, width - 1.0f)) / kTile;
  const int last_row = static_cast<int>(std::min(bottom, height - 1.0f)) / kTile;
  float least = std::numeric_limits<float>::max(), greatest = 0.0f;
  for (int row = static_cast<int>(std::max(top, 0.0f)) / kTile; row <= last_row; ++row) {
    const std::size_t line = static_cast<std::size_t>(row) * seen.columns;
    for (int column = first_column; column <= last_column; ++column) {
      least = std::min(least, seen.least[line + column]);
      greatest = std::max(greatest, seen.greatest[line + column]);
    }
  }
  if (nearest > greatest) return Passed::kNone;
  const bool is_inside = left >= 0.0f && top >= 0.0f && right < width && bottom < height;
  return is_inside && farthest < least ? Passed::kAll : Passed::kSome;
}

// Which of kLanes voxels from `cell` on: all bits set, else 0.
Int8 passed_lanes(const int* cell, const Projection& projection, const DepthReach& seen) {
  double start[3];
  projection.at(cell, start);
  const double* step = projection.step[2];
  const Float8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
  const Float8 z = static_cast<float>(start[2]) + lane * static_cast<float>(step[2]);
  const Float8 u = (static_cast<float>(start[0]) + lane * static_cast<float>(step[0])) / z + 0.5f;
  const Float8 v = (static_cast<float>(start[1]) + lane * static_cast<float>(step[1])) / z + 0.5f;
  const Int8 is_inside = (z > kNear) & (u >= 0.0f) & (v >= 0.0f) & (u < static_cast<float>(seen.width)) &
                         (v < static_cast<float>(seen.height));
  const Int8 pixel =
      is_inside & (__builtin_convertvector(v, Int8) * seen.width + __builtin_convertvector(u, Int8));
  Float8 reach;
  for (int i = 0; i < kLanes; ++i) reach[i] = seen.reach[pixel[i]];
  return is_inside & (reach > z);
}

// Changes kLanes voxels in a row; a hit outweighs that a ray has passed.
template <bool kHasHits>
inline void update(const VoxelArrays& at, Int8 is_passed, const LogOdds& change, std::uint16_t step) {
  Int8 is_hit = {};
  if (kHasHits) {
    Byte8 hits;
    std::memcpy(&hits, at.hits, sizeof hits);
    std::memset(at.hits, 0, sizeof hits);
    is_hit = -__builtin_convertvector(hits, Int8);
  }
  const Int8 is_touched = is_hit | is_passed;
  const Float8 before = load8(at.log_odds);
  const Float8 after = before + (is_hit ? splat8(change.hit) : splat8(change.miss));
  store8(at.log_odds, is_touched ? min8(max8(after, splat8(-change.limit)), splat8(change.limit)) : before);
  const Count8 touched = __builtin_convertvector(is_touched, Count8);
  Count8 count;
  std::memcpy(&count, at.num_updates, sizeof count);
  count -= touched & static_cast<Count8>(count != 65535);
  std::memcpy(at.num_updates, &count, sizeof count);
  Count8 seen;
  std::memcpy(&seen, at.last_seen, sizeof seen);
  seen = (seen & ~touched) | (touched & step);
  std::memcpy(at.last_seen, &seen, sizeof seen);
}

// The same for the first `num` of them.
void update_some(const VoxelArrays& at, int num, Int8 is_passed, const LogOdds& change, std::uint16_t step) {
  alignas(32) float log_odds[kLanes] = {};
  std::uint16_t num_updates[kLanes] = {}, last_seen[kLanes] = {};
  std::uint8_t hits[kLanes] = {};
  std::copy(at.log_odds, at.log_odds + num, log_odds);
  std::copy(at.num_updates, at.num_updates + num, num_updates);
  std::copy(at.last_seen, at.last_seen + num, last_seen);
  std::copy(at.hits, at.hits + num, hits);
  update<true>({log_odds, num_updates, last_seen, hits}, is_passed, change, step);
  std::copy(log_odds, log_odds + num, at.log_odds);
  std::copy(num_updates, num_updates + num, at.num_updates);
  std::copy(last_seen, last_seen + num, at.last_seen);
  std::copy(hits, hits + num, at.hits);
}

// One image's change of the grid.
class Sweep {
 public:
  Sweep(const VoxelGrid& grid, const VoxelArrays& voxels, const DepthImage& image, const LogOdds& change,
        std::uint16_t step)
      : grid_(grid),
        voxels_(voxels),
        image_(image),
        change_(change),
        step_(step),
        projection_(grid, image),
        seen_(image, grid.voxel),
        is_hit_(static_cast<std::size_t>(num_blocks(kBlock))),
        is_super_hit_(static_cast<std::size_t>(num_blocks(kSuper))) {}

  void run(int num_threads) {
    parallel_for(parts(image_.height, kTile), num_threads, [&](int chunk) { mark_hits(chunk); });
    parallel_for(seen_.columns, num_threads, [&](int column) { seen_.fill_squares(column); });
    parallel_for(num_blocks(kSuper), num_threads, [&](int block) { sweep(block); });
  }

 private:
  int num_blocks(int edge) const {
    return parts(grid_.size[0], edge) * parts(grid_.size[1], edge) * parts(grid_.size[2], edge);
  }

  std::size_t block_of(const int* cell, int edge) const {
    return (static_cast<std::size_t>(cell[0] / edge) * parts(grid_.size[1], edge) + cell[1] / edge) *
               parts(grid_.size[2], edge) +
           cell[2] / edge;
  }

  void mark_hits(int chunk) {
    HitRow hits(grid_, image_);
    std::int32_t last = -1;
    for (int v = chunk * kTile; v < std::min(image_.height, (chunk + 1) * kTile); ++v) {
      seen_.fill_row(v);
      for (const std::int32_t index : hits.find(v)) {
        if (index == last || index < 0) continue;
        last = index;
        if (!set_bits(voxels_.hits + index, 1)) continue;
        const int row = index / grid_.size[2];
        const int cell[3] = {row / grid_.size[1], row % grid_.size[1], index % grid_.size[2]};
        set_bits(&is_hit_[block_of(cell, kBlock)], 1);
        set_bits(&is_super_hit_[block_of(cell, kSuper)], 1);
      }
    }
  }

  void sweep(int block) const {
    const int columns = parts(grid_.size[2], kSuper), rows = parts(grid_.size[1], kSuper);
    const VoxelBox outer(block / columns / rows * kSuper, block / columns % rows * kSuper, block % columns * kSuper,
                         kSuper, grid_.size);
    const Passed passed = passed_of(outer, projection_, seen_);
    if (passed == Passed::kNone && !is_super_hit_[block]) return;
    for (int i = outer.low[0]; i < outer.high[0]; i += kBlock) {
      for (int j = outer.low[1]; j < outer.high[1]; j += kBlock) {
        for (int k = outer.low[2]; k < outer.high[2]; k += kBlock) {
          const VoxelBox box(i, j, k, kBlock, outer.high);
          const Passed here = passed == Passed::kSome ? passed_of(box, projection_, seen_) : passed;
          if (is_hit_[block_of(box.low, kBlock)]) {
            change<true>(box, here);
          } else if (here != Passed::kNone) {
            change<false>(box, here);
          }
        }
      }
    }
  }

  template <bool kHasHits>
  void change(const VoxelBox& box, Passed passed) const {
    const std::size_t slab = static_cast<std::size_t>(grid_.size[1]) * grid_.size[2];
    const int num = box.high[2] - box.low[2];
    int cell[3] = {0, 0, box.low[2]};
    for (cell[0] = box.low[0]; cell[0] < box.high[0]; ++cell[0]) {
      for (cell[1] = box.low[1]; cell[1] < box.high[1]; ++cell[1]) {
        const std::size_t first = index_of(grid_, cell);
        const VoxelArrays at{voxels_.log_odds + first, voxels_.num_updates + first, voxels_.last_seen + first,
                             voxels_.hits + first};
        if (cell[0] + 1 < box.high[0]) {  // rows lie too far apart for the processor to guess the next
          __builtin_prefetch(at.log_odds + slab, 1);
          __builtin_prefetch(at.log_odds + slab + num - 1, 1);
          __builtin_prefetch(at.num_updates + slab, 1);
          __builtin_prefetch(at.last_seen + slab, 1);
        }
        const Int8 is_passed = passed == Passed::kSome ? passed_lanes(cell, projection_, seen_)
                                                       : Int8{} - static_cast<int>(passed == Passed::kAll);
        if (num == kLanes) {
          update<kHasHits>(at, is_passed, change_, step_);
        } else {
          update_some(at, num, is_passed, change_, step_);
        }
      }
    }
  }

  const VoxelGrid& grid_;
  const VoxelArrays& voxels_;
  const DepthImage& image_;
  const LogOdds& change_;
  const std::uint16_t step_;
  const Projection projection_;
  DepthReach seen_;
  std::vector<std::uint8_t> is_hit_, is_super_hit_;  // blocks with a hit
};

}  // namespace

void integrate_depth(const VoxelGrid& grid, const VoxelArrays& voxels, const DepthImage& image, const LogOdds& change,
                     std::uint16_t step, int num_threads) {
  Sweep(grid, voxels, image, change, step).run(num_threads);
}

}  // namespace splatctrl
