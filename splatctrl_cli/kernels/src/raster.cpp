#include "raster.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr int kProjectChunk = 512;
constexpr int kListChunks = 16;  // of the depth order
constexpr int kTileChunk = 8;    // tiles side by side: each fetches the next one's pixels

// Stable, by the upper half of the keys.
void radix_sort(std::vector<std::uint64_t>& keys, std::vector<std::uint64_t>& scratch) {
  constexpr int kBits = 11, kPasses = 3, kBuckets = 1 << kBits;
  const auto digit = [](std::uint64_t key, int pass) { return key >> (32 + kBits * pass) & (kBuckets - 1); };
  std::array<std::array<int, kBuckets>, kPasses> place{};
  for (const std::uint64_t key : keys) {
    for (int pass = 0; pass < kPasses; ++pass) ++place[pass][digit(key, pass)];
  }
  scratch.resize(keys.size());
  for (int pass = 0; pass < kPasses; ++pass) {
    int start = 0;
    for (int& count : place[pass]) start += std::exchange(count, start);
    for (const std::uint64_t key : keys) scratch[place[pass][digit(key, pass)]++] = key;
    keys.swap(scratch);
  }
}

}  // namespace

void Rasteriser::prepare(const Camera& camera, int num_splats, const float* centers, const float* radii,
                         const float* opacities, const float* colors, int num_threads) {
  const Projection project = [&](int first, int last, Footprint* footprints, std::uint8_t* visible) {
    for (int i = first; i < last; ++i) {
      visible[i] = project_isotropic(camera, centers + 3 * i, radii[i], opacities[i], &footprints[i]);
    }
  };
  prepare(camera, num_splats, project, colors, num_threads);
}

void Rasteriser::prepare(const Camera& camera, int num_splats, const Projection& project, const float* colors,
                         int num_threads) {
  camera_ = camera;
  num_splats_ = num_splats;
  has_blended_ = false;
  tiles_x_ = (camera.width + kTileWidth - 1) / kTileWidth;
  tiles_y_ = (camera.height + kTileHeight - 1) / kTileHeight;
  footprints_.resize(num_splats);
  visible_.assign(num_splats, 0);
  parallel_for((num_splats + kProjectChunk - 1) / kProjectChunk, num_threads, [&](int chunk) {
    const int first = chunk * kProjectChunk, last = std::min(num_splats, first + kProjectChunk);
    project(first, last, footprints_.data(), visible_.data());
  });
  sort_by_depth();
  list_tiles(colors, num_threads);
  fill_tiles(num_threads);
}

void Rasteriser::sort_by_depth() {
  order_.clear();
  for (int i = 0; i < num_splats_; ++i) {
    if (!visible_[i]) continue;
    std::uint32_t bits;  // positive floats order as their bits do
    std::memcpy(&bits, &footprints_[i].depth, sizeof bits);
    order_.push_back(static_cast<std::uint64_t>(bits) << 32 | static_cast<std::uint32_t>(i));
  }
  radix_sort(order_, order_scratch_);
}

void Rasteriser::list_tiles(const float* colors, int num_threads) {
  const int num_tiles = tiles_x_ * tiles_y_, num_seen = static_cast<int>(order_.size());
  splats_.resize(num_seen);
  part_end_.resize(num_seen);
  chunk_tiles_.resize(kListChunks);
  chunk_counts_.assign(static_cast<std::size_t>(kListChunks) * num_tiles, 0);
  parallel_for(kListChunks, num_threads, [&](int chunk) {
    std::vector<int>& tiles = chunk_tiles_[chunk];
    int* counts = chunk_counts_.data() + static_cast<std::size_t>(chunk) * num_tiles;
    tiles.clear();
    for (int rank = chunk_first(chunk); rank < chunk_first(chunk + 1); ++rank) {
      const auto index = static_cast<int>(order_[rank] & 0xffffffffu);
      const Footprint& f = footprints_[index];
      const TileSplat& s = splats_[rank] = TileSplat(f, colors + 3 * static_cast<std::size_t>(index), index);
      const std::size_t before = tiles.size();
      const int last_row = tile_row(f.v + f.half_height, tiles_y_);
      for (int ty = tile_row(f.v - f.half_height, tiles_y_); ty <= last_row; ++ty) {
        const Columns<int> columns = tile_columns(f, s, ty, tiles_x_);
        for (int tx = columns.first; tx <= columns.last; ++tx) {
          tiles.push_back(ty * tiles_x_ + tx);
          ++counts[tiles.back()];
        }
      }
      visible_[index] = tiles.size() > before;
      part_end_[rank] = static_cast<int>(tiles.size());
    }
  });
}

void Rasteriser::fill_tiles(int num_threads) {
  const int num_tiles = tiles_x_ * tiles_y_;
  tile_start_.resize(num_tiles + 1);
  int start = 0;
  for (int tile = 0; tile < num_tiles; ++tile) {
    tile_start_[tile] = start;
    for (int chunk = 0; chunk < kListChunks; ++chunk) {
      start += std::exchange(chunk_counts_[static_cast<std::size_t>(chunk) * num_tiles + tile], start);
    }
  }
  tile_start_[num_tiles] = start;
  entries_.assign(start + kPrefetch, TileEntry{});
  parts_.resize(start);
  chunk_start_.assign(kListChunks + 1, 0);
  for (int chunk = 0; chunk < kListChunks; ++chunk) {
    chunk_start_[chunk + 1] = chunk_start_[chunk] + static_cast<int>(chunk_tiles_[chunk].size());
  }
  parallel_for(kListChunks, num_threads, [&](int chunk) {
    int* next = chunk_counts_.data() + static_cast<std::size_t>(chunk) * num_tiles;
    int k = 0;
    for (int rank = chunk_first(chunk); rank < chunk_first(chunk + 1); ++rank) {
      for (; k < part_end_[rank]; ++k) entries_[next[chunk_tiles_[chunk][k]]++] = {rank, chunk_start_[chunk] + k, 0};
    }
  });
}

int Rasteriser::chunk_first(int chunk) const {
  return static_cast<int>(order_.size() * static_cast<std::size_t>(chunk) / kListChunks);
}

TileImage Rasteriser::image_of(int tile) const {
  return {tile % tiles_x_ * kTileWidth, tile / tiles_x_ * kTileHeight, camera_.width, camera_.height};
}

void Rasteriser::each_tile(int num_threads, const std::function<void(int)>& visit) const {
  const int num_tiles = tiles_x_ * tiles_y_;
  parallel_for((num_tiles + kTileChunk - 1) / kTileChunk, num_threads, [&](int chunk) {
    for (int tile = chunk * kTileChunk; tile < std::min(num_tiles, (chunk + 1) * kTileChunk); ++tile) visit(tile);
  });
}

void Rasteriser::forward(float* planes, int num_threads) {
  each_tile(num_threads, [&](int tile) {
    TileEntry* entries = entries_.data();
    tile_forward(image_of(tile), splats_.data(), entries + tile_start_[tile], entries + tile_start_[tile + 1], planes);
  });
  has_blended_ = true;
}

void Rasteriser::backward(const float* planes, const float* plane_gradients, SplatGradient* gradients,
                          int num_threads) {
  if (!has_blended_) throw std::logic_error("backward: expected forward to have been called first");
  each_tile(num_threads, [&](int tile) {
    const TileEntry* entries = entries_.data();
    tile_backward(image_of(tile), splats_.data(), entries + tile_start_[tile], entries + tile_start_[tile + 1], planes,
                  plane_gradients, parts_.data());
  });
  std::memset(static_cast<void*>(gradients), 0, sizeof(SplatGradient) * num_splats_);
  parallel_for(kListChunks, num_threads, [&](int chunk) {
    int k = chunk_start_[chunk];
    for (int rank = chunk_first(chunk); rank < chunk_first(chunk + 1); ++rank) {
      constexpr int kFloats = sizeof(SplatGradient) / sizeof(float);
      float sum[kFloats] = {}, part[kFloats];
      for (; k < chunk_start_[chunk] + part_end_[rank]; ++k) {  // tile by tile
        std::memcpy(part, &parts_[k], sizeof part);
        for (int j = 0; j < kFloats; ++j) sum[j] += part[j];
      }
      std::memcpy(static_cast<void*>(&gradients[splats_[rank].index]), sum, sizeof sum);
    }
  });
}

}  // namespace splatctrl
