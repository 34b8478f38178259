// A footprint as the tiles of an image read it, and the tiles that it reaches. For host and device.
#pragma once

#include <algorithm>
#include <cmath>

#include "projection.h"

namespace splatctrl {

constexpr int kTileWidth = 16, kTileHeight = 16;  // [px], whole vectors of eight
constexpr float kLog2E = 1.44269504f;
constexpr float kLog2MinAlpha = -7.99435344f;    // log2(1 / 255)
constexpr float kLog2MaxAlpha = -0.0144995697f;  // log2(0.99)
constexpr float kReachMargin = 0.01f;            // [px] more than rounding can take away from a footprint's extent

// One cache line. alpha G is 2 to the power of log2_opacity + xx dx^2 + xy dx dy + yy dy^2.
struct alignas(64) TileSplat {
  float u, v;
  float xx, xy, yy, log2_opacity;
  float features[4];                      // red, green, blue, depth
  float slope, half2_level, half2_slope;  // in a row, it reaches columns slope dy +- sqrt(half2_level + half2_slope dy^2)
  float opacity;
  int index;                              // of the splat

  TileSplat() = default;
  SPLATCTRL_HOST_DEVICE TileSplat(const Footprint& f, const float* color, int splat_index)
      : u(f.u), v(f.v), xx(-0.5f * kLog2E * f.a), xy(-kLog2E * f.b), yy(-0.5f * kLog2E * f.c),
        log2_opacity(std::log2(f.opacity)), features{color[0], color[1], color[2], f.depth}, slope(-f.b / f.a),
        half2_level(f.level / f.a), half2_slope(f.b * f.b / (f.a * f.a) - f.c / f.a), opacity(f.opacity),
        index(splat_index) {}
};

// Columns of pixels, or of tiles.
template <class Number>
struct Columns {
  Number first, last;
};

SPLATCTRL_HOST_DEVICE inline float half_width_at(const TileSplat& s, float dy) {
  return std::sqrt(std::max(s.half2_level + s.half2_slope * dy * dy, 0.0f));
}

// The columns [px] that a footprint reaches in the rows dy in [low, high], measured from its mean; exact but for the
// margin. An ellipse reaches furthest right at its rightmost point, `rightmost` rows below its mean, or as near to it
// as the rows go.
SPLATCTRL_HOST_DEVICE inline Columns<float> columns_between(const TileSplat& s, float rightmost, float low,
                                                            float high) {
  const float at_right = std::clamp(rightmost, low, high), at_left = std::clamp(-rightmost, low, high);
  return {s.u + s.slope * at_left - half_width_at(s, at_left) - kReachMargin,
          s.u + s.slope * at_right + half_width_at(s, at_right) + kReachMargin};
}

SPLATCTRL_HOST_DEVICE inline float rightmost_row(const Footprint& f) { return -f.b / f.c * f.half_width; }

// The row of tiles that holds a row of pixels, or the nearest one.
SPLATCTRL_HOST_DEVICE inline int tile_row(float y, int tiles_y) {
  return static_cast<int>(std::floor(std::clamp(y / kTileHeight, 0.0f, static_cast<float>(tiles_y - 1))));
}

// The columns of tiles of one row of tiles in which a footprint reaches a pixel; first > last where there is none.
SPLATCTRL_HOST_DEVICE inline Columns<int> tile_columns(const Footprint& f, const TileSplat& s, int row, int tiles_x) {
  const float low = std::max(static_cast<float>(row * kTileHeight) - f.v, -f.half_height);
  const float high = std::min(static_cast<float>(row * kTileHeight + kTileHeight - 1) - f.v, f.half_height);
  if (low > high) return {0, -1};
  const Columns<float> reached = columns_between(s, rightmost_row(f), low, high);
  const auto tile = [tiles_x](float x) {
    return static_cast<int>(std::floor(std::clamp(x / kTileWidth, -1.0f, static_cast<float>(tiles_x))));
  };
  return {std::max(tile(reached.first + (-kTileWidth + 1)) + 1, 0), std::min(tile(reached.last), tiles_x - 1)};
}

}  // namespace splatctrl
