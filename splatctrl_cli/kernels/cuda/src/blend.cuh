// Eq. 2 and 3: sorts the list of a tile and blends it, front to back.
#pragma once

#include "fit.h"

namespace splatctrl {

constexpr int kBlendBands = 2;  // blocks of a warp, one below the other: pixels of a thread
constexpr int kBlendThreads = kTileWidth * kTileHeight / kBlendBands;
constexpr int kSharedList = 512;   // entries of a list that are sorted in shared memory, by counting
constexpr int kStage = 64;         // entries that are blended from shared memory at a time
constexpr int kBlocksAtOnce = 9;   // of threads on a multiprocessor: more would take registers from each

// A list that is sorted: a splat's index and its part here.
struct Listed {
  std::uint32_t splat, part;
};

// Sorts up to kSharedList entries into `sorted`: an entry's place is the number of keys below its own.
__device__ inline void sort_by_counting(const std::uint64_t* in, const std::uint32_t* parts, int count,
                                        std::uint64_t* keys, Listed* sorted) {
  for (int k = threadIdx.x; k < count; k += kBlendThreads) keys[k] = in[k];
  __syncthreads();
  for (int k = threadIdx.x; k < count; k += kBlendThreads) {
    const std::uint64_t key = keys[k];
    int place = 0;
#pragma unroll 4
    for (int other = 0; other < count; ++other) place += keys[other] < key;
    sorted[place] = {static_cast<std::uint32_t>(key), parts[k]};
  }
  __syncthreads();
}

// Sorts by key where the entries are: a bitonic network whose comparisons all point one way, so that what lies beyond
// the end counts as larger than anything.
__device__ inline void sort_in_place(std::uint64_t* keys, std::uint32_t* parts, int count) {
  for (int size = 2; size / 2 < count; size <<= 1) {
    for (int span = size; span > 1; span >>= 1) {
      const int half = span / 2;  // a power of two
      __syncthreads();
      for (int t = threadIdx.x; 2 * (t - (t & (half - 1))) < count; t += kBlendThreads) {
        const int within = t & (half - 1), begin = 2 * (t - within);
        const int low = begin + within, high = span == size ? begin + span - 1 - within : low + half;
        if (high >= count) continue;
        const std::uint64_t key = keys[low], other = keys[high];
        if (key <= other) continue;
        const std::uint32_t part = parts[low];
        keys[low] = other;
        parts[low] = parts[high];
        keys[high] = key;
        parts[high] = part;
      }
    }
  }
  __syncthreads();
}

// One bit for each block of a band of a tile, from column x0 and row y0 on, in which a footprint may reach a pixel.
__device__ inline std::uint32_t reached_blocks(const TileSplat& s, int x0, int y0) {
  // dy of the rightmost point: where slope dy + sqrt(half2_level + half2_slope dy^2) is largest.
  const float rightmost = s.slope * sqrtf(s.half2_level / (s.half2_slope * (s.half2_slope - s.slope * s.slope)));
  const float low = static_cast<float>(y0) - s.v, high = low + (kBlockHeight - 1);
  const float nearest = std::clamp(0.0f, low, high);
  if (!(s.half2_level + s.half2_slope * nearest * nearest >= -kReachMargin)) return 0;
  const Columns<float> reached = columns_between(s, rightmost, low, high);
  std::uint32_t blocks = 0;
  for (int group = 0; group < kTileWidth / kBlockWidth; ++group) {
    const auto first = static_cast<float>(x0 + group * kBlockWidth);
    if (reached.first <= first + (kBlockWidth - 1) && reached.last >= first) blocks |= 1u << (group * kNumBands);
  }
  return blocks;
}

// Writes planes (5, H, W): red, green, blue, depth, opacity; and each tile's sorted entries (K, list_capacity) with
// their number (K). Empties the lists that project() filled. One block of threads a tile.
extern "C" __global__ void __launch_bounds__(kBlendThreads, kBlocksAtOnce)
    blend(Counters* counters, const TileSplat* splats, int* list_lengths, std::uint64_t* list_keys,
          std::uint32_t* list_parts, int list_capacity, int part_capacity, Entry* entries, int* num_entries, int width,
          int height, float* planes) {
  __shared__ std::uint64_t keys[kSharedList];
  __shared__ Listed sorted[kSharedList];
  __shared__ TileSplat stage[kStage];
  __shared__ std::uint32_t stage_blocks[kStage];
  const int tile = blockIdx.x, thread = threadIdx.x, warp = thread / 32, lane = thread % 32;
  const int tiles_x = (width + kTileWidth - 1) / kTileWidth;
  const int x0 = tile % tiles_x * kTileWidth, y0 = tile / tiles_x * kTileHeight;
  const int length = list_lengths[tile], count = std::min(length, list_capacity);
  const std::size_t list = static_cast<std::size_t>(tile) * list_capacity;
  const bool is_shared = count <= kSharedList;
  __syncthreads();
  if (thread == 0) {
    list_lengths[tile] = 0;
    num_entries[tile] = count;
    if (length > list_capacity) atomicMax(&counters->longest_list, length);
    if (tile == 0) {
      counters->now = counters->next;
      if (counters->num_parts > part_capacity) atomicMax(&counters->most_parts, counters->num_parts);
      counters->num_parts = 0;
    }
  }
  if (is_shared) {
    sort_by_counting(list_keys + list, list_parts + list, count, keys, sorted);
  } else {
    sort_in_place(list_keys + list, list_parts + list, count);
  }
  const int first_block = warp * kBlendBands;
  const int x = x0 + first_block / kNumBands * kBlockWidth + lane % kBlockWidth;
  const int y = y0 + first_block % kNumBands * kBlockHeight + lane / kBlockWidth;
  float transmittance[kBlendBands], sums[kBlendBands][4] = {};
#pragma unroll
  for (int band = 0; band < kBlendBands; ++band) {
    transmittance[band] = pixel_of(x, y + band * kBlockHeight, width, height).is_inside ? 1.0f : -1.0f;
  }
  const auto is_lit = [&transmittance] {
    bool is = false;
    for (int band = 0; band < kBlendBands; ++band) is |= transmittance[band] > 0.0f;
    return is;
  };
  for (int first = 0; first < count; first += kStage) {
    const int num_staged = std::min(kStage, count - first);
    const bool is_over = !__syncthreads_or(is_lit());
    const auto listed = [&](int k) {
      return is_shared ? sorted[k] : Listed{static_cast<std::uint32_t>(list_keys[list + k]), list_parts[list + k]};
    };
    for (int k = thread; k < num_staged * kPieces && !is_over; k += kBlendThreads) {
      pieces(stage)[k] = pieces(splats + listed(first + k / kPieces).splat)[k % kPieces];
    }
    __syncthreads();
#pragma unroll
    for (int task = 0; task < kStage * kNumBands; task += kBlendThreads) {  // a band of an entry
      const int k = (task + thread) / kNumBands, band = thread % kNumBands;
      std::uint32_t blocks = 0;
      if (k < num_staged && !is_over) blocks = reached_blocks(stage[k], x0, y0 + band * kBlockHeight) << band;
      for (int step = 1; step < kNumBands; step <<= 1) blocks |= __shfl_xor_sync(kAllLanes, blocks, step);
      if (k >= num_staged || band != 0) continue;
      const Listed one = listed(first + k);
      stage_blocks[k] = blocks;
      entries[list + first + k] = {one.splat | blocks << kSplatBits, one.part};
    }
    __syncthreads();
    if (is_over) continue;  // entries that nothing is blended of are listed all the same
    for (int base = 0; base < num_staged; base += 32) {
      if (!__any_sync(kAllLanes, is_lit())) break;
      const std::uint32_t blocks = base + lane < num_staged ? stage_blocks[base + lane] >> first_block : 0;
      unsigned left = __ballot_sync(kAllLanes, (blocks & ((1u << kBlendBands) - 1u)) != 0);
      for (; left != 0; left &= left - 1) {
        const TileSplat& s = stage[base + __ffs(static_cast<int>(left)) - 1];
        const float dx = static_cast<float>(x) - s.u;
#pragma unroll
        for (int band = 0; band < kBlendBands; ++band) {
          float alpha = alpha_of(log2_alpha(s, dx, static_cast<float>(y + band * kBlockHeight) - s.v));
          const float weight = blend(&alpha, &transmittance[band]);
          for (int c = 0; c < 4; ++c) sums[band][c] = fma(weight, s.features[c], sums[band][c]);
        }
      }
    }
  }
  const std::size_t plane = static_cast<std::size_t>(width) * height;
#pragma unroll
  for (int band = 0; band < kBlendBands; ++band) {
    const Pixel pixel = pixel_of(x, y + band * kBlockHeight, width, height);
    if (!pixel.is_inside) continue;
    for (int c = 0; c < 4; ++c) planes[c * plane + pixel.at] = sums[band][c];
    planes[4 * plane + pixel.at] = 1.0f - fabsf(transmittance[band]);
  }
}

}  // namespace splatctrl
