// One tile of an image: how its splats blend, and what a loss on it says to them.
#pragma once

#include <cstddef>
#include <cstdint>

#include "projection.h"

namespace splatctrl {

constexpr int kTileWidth = 16, kTileHeight = 16;  // [px], whole vectors of eight
constexpr int kNumPlanes = 5;                     // red, green, blue, depth, accumulated opacity

// The derivative of a loss with respect to one splat on one image.
struct SplatGradient {
  FootprintGradient footprint;
  float color[3];
};

// A footprint as the tiles read it: one cache line. alpha G is 2 to the power of
// log2_opacity + xx dx^2 + xy dx dy + yy dy^2.
struct alignas(64) TileSplat {
  float u, v;
  float xx, xy, yy, log2_opacity;
  float features[4];                      // red, green, blue, depth
  float slope, half2_level, half2_slope;  // in a row, it reaches columns slope dy +- sqrt(half2_level + half2_slope dy^2)
  float opacity;
  int index;                              // of the splat

  TileSplat() = default;
  TileSplat(const Footprint& footprint, const float* color, int splat_index);
};

// A tile is made of strips, eight pixels of a row each, numbered column by column: columns / 8 * kTileHeight + row.
using StripMask = std::uint32_t;

// A splat on a tile's list.
struct TileEntry {
  int rank;         // in depth
  int part;         // where its gradient goes
  StripMask reach;  // the strips that tile_forward() blended it on
};
constexpr int kPrefetch = 2;  // entries beyond the last of a list that are read too, to fetch what they name

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
