// One tile of an image: how its splats blend, and what a loss on it says to them.
#pragma once

#include <cstddef>
#include <cstdint>

#include "tile_splat.h"

namespace splatctrl {

constexpr int kNumPlanes = 5;  // red, green, blue, depth, accumulated opacity

// The derivative of a loss with respect to one splat on one image.
struct SplatGradient {
  FootprintGradient footprint;
  float color[3];
};

// A tile is made of blocks, 4 x 4 pixels each, numbered column by column: x / 4 * 4 + y / 4.
using BlockMask = std::uint16_t;

// A splat on a tile's list.
struct TileEntry {
  int rank;         // in depth
  int part;         // where its gradient goes
  BlockMask reach;  // the blocks that tile_forward() blended it on, at first none
};
constexpr int kPrefetch = 8;  // entries beyond the last of a list that are read too, to fetch what they name

// Where a tile lies in the planes of an image.
struct TileImage {
  int x0, y0, width, height;  // the tile's corner, the image's size
  std::size_t plane() const { return static_cast<std::size_t>(width) * height; }
};

// Blends entries [first, last), front to back, and writes the tile's part of planes (5, H, W).
void tile_forward(const TileImage& image, const TileSplat* splats, TileEntry* first, TileEntry* last, float* planes);

// Gradients of the entries that tile_forward() has seen: parts[entry.part].
void tile_backward(const TileImage& image, const TileSplat* splats, const TileEntry* first, const TileEntry* last,
                   const float* planes, const float* plane_gradients, SplatGradient* parts);

}  // namespace splatctrl
