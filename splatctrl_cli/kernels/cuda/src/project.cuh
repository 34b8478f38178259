// Eq. 1: splats to footprints, and each footprint onto the lists of the tiles in which it reaches a pixel.
#pragma once

#include "fit.h"

namespace splatctrl {

constexpr int kProjectThreads = 128;
constexpr int kProjectLanes = 4;  // threads of a splat; each lists the tiles of every fourth row
static_assert(kProjectLanes == kPieces, "each writes a piece");
constexpr int kSlotsAtOnce = 4;   // places on lists that a thread asks for before it waits for them

// Where this thread's parts begin, `count` of them: room for a warp is taken at once, in the order of its lanes.
__device__ inline int take_parts(int count, int lane, int* num_parts, int capacity) {
  int before = count;  // sum over the lanes up to this one
  for (int step = 1; step < 32; step <<= 1) {
    const int other = __shfl_up_sync(kAllLanes, before, step);
    if (lane >= step) before += other;
  }
  const int total = __shfl_sync(kAllLanes, before, 31, 32);
  int first = 0;
  if (lane == 0 && total > 0) first = atomicAdd(num_parts, total);
  first = __shfl_sync(kAllLanes, first, 0, 32);
  return first + total > capacity ? -1 : first + before - count;
}

// Writes splats (N), first_parts (N) and num_parts (N), 0 = not seen; and per tile the depth and index of its
// splats (K, list_capacity) with the parts (K, list_capacity) that they are given, in any order.
extern "C" __global__ void __launch_bounds__(kProjectThreads)
    project(Counters* counters, const int* schedule, const View* views, const float* parameters, int num_splats,
            TileSplat* splats, int* first_parts, int* num_parts, int* list_lengths, std::uint64_t* list_keys,
            std::uint32_t* list_parts, int list_capacity, int part_capacity) {
  const int thread = blockIdx.x * kProjectThreads + threadIdx.x, i = thread / kProjectLanes;
  const int lane = threadIdx.x % 32, share = threadIdx.x % kProjectLanes;
  const Camera& camera = views[schedule[counters->next]].camera;
  const float* p = parameters + static_cast<std::size_t>(kNumParameters) * (i < num_splats ? i : 0);
  Footprint f{};
  const bool is_seen = i < num_splats && project_isotropic(camera, p, std::exp(p[3]), sigmoid(p[7]), &f);
  const TileSplat s(f, p + 4, i);
  const int tiles_x = (camera.width + kTileWidth - 1) / kTileWidth;
  const int tiles_y = (camera.height + kTileHeight - 1) / kTileHeight;
  const int first_row = is_seen ? tile_row(f.v - f.half_height, tiles_y) + share : 0;
  const int last_row = is_seen ? tile_row(f.v + f.half_height, tiles_y) : -1;
  const std::uint64_t key = static_cast<std::uint64_t>(__float_as_uint(f.depth)) << 32 | static_cast<unsigned>(i);
  int first = 0, count = 0;
#pragma unroll 1  // the same instructions count and list, so that they agree
  for (int pass = 0; pass < 2; ++pass) {
    int part = first;
    for (int row = first_row; row <= last_row; row += kProjectLanes) {
      const Columns<int> columns = tile_columns(f, s, row, tiles_x);
      const int num_columns = std::max(columns.last - columns.first + 1, 0);
      for (int j = 0; pass == 1 && j < num_columns; j += kSlotsAtOnce) {
        int slot[kSlotsAtOnce];
        const int tile = row * tiles_x + columns.first + j;
#pragma unroll
        for (int k = 0; k < kSlotsAtOnce; ++k) {
          slot[k] = j + k < num_columns ? atomicAdd(&list_lengths[tile + k], 1) : list_capacity;
        }
#pragma unroll
        for (int k = 0; k < kSlotsAtOnce; ++k) {
          if (slot[k] >= list_capacity) continue;
          const std::size_t at = static_cast<std::size_t>(tile + k) * list_capacity + slot[k];
          list_keys[at] = key;
          list_parts[at] = part + j + k;
        }
      }
      part += num_columns;
    }
    if (pass == 1) break;
    count = part;
    first = take_parts(count, lane, &counters->num_parts, part_capacity);
    if (first < 0) break;
  }
  int total = first < 0 ? 0 : count;
  for (int step = 1; step < kProjectLanes; step <<= 1) total += __shfl_xor_sync(kAllLanes, total, step);
  if (i >= num_splats) return;
  if (total > 0) pieces(splats + i)[share] = piece(s, share);
  if (share != 0) return;
  num_parts[i] = total;
  first_parts[i] = first;
}

}  // namespace splatctrl
