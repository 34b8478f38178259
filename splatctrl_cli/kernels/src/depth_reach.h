// How far the rays around each pixel of a depth image prove that space is free.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "voxel_grid.h"

namespace splatctrl {

constexpr int kTile = 16;  // pixels

// The image with a rim of kTile pixels around it, and the least and greatest reach in squares of kTile pixels.
//
// A pixel's reach is its depth, at most max_range. A pixel without depth (the rim is such) takes that of the nearest
// pixel with one, in steps along columns and rows, but no further than where the two rays are half a voxel apart (a
// centre may fall half a pixel beside its pixel's middle). Up to there, that pixel's ray meets every voxel whose
// centre falls on this pixel.
class DepthReach {
 public:
  DepthReach(const DepthImage& image, double voxel)
      : width(parts(image.width + 2 * kTile, kTile) * kTile),
        height(parts(image.height + 2 * kTile, kTile) * kTile),
        columns(width / kTile),
        reach(static_cast<std::size_t>(width) * height),
        least(static_cast<std::size_t>(columns) * (height / kTile)),
        greatest(least.size()),
        image_(image),
        half_voxel_(static_cast<float>(0.5 * voxel * std::min(image.fx, image.fy))),
        steps_(reach.size(), kFar) {}

  const int width, height, columns;
  std::vector<float> reach, least, greatest;

  // First every row of the image: depths, borrowed along the row.
  void fill_row(int v) {
    const std::size_t first = static_cast<std::size_t>(v + kTile) * width;
    const float* depth = image_.depth + static_cast<std::size_t>(v) * image_.width;
    float* to = reach.data() + first + kTile;
    std::uint16_t* steps = steps_.data() + first + kTile;
    for (int u = 0; u < image_.width; ++u) {
      const bool has_depth = image_.has_depth(depth[u]);
      to[u] = has_depth ? std::min(depth[u], image_.max_range) : 0.0f;
      steps[u] = has_depth ? std::uint16_t{0} : kFar;
    }
    spread(first, 1);
    spread(first + width - 1, -1);
  }

  // Then every column of squares: borrowed along the columns of pixels, and cut.
  void fill_squares(int column) {
    const std::size_t first = static_cast<std::size_t>(column) * kTile;
    const auto borrow_row = [&](int row, int other) {
      const std::size_t here = first + static_cast<std::size_t>(row) * width;
      const std::size_t there = first + static_cast<std::size_t>(other) * width;
      for (int i = 0; i < kTile; ++i) borrow(here + i, there + i);
    };
    for (int row = 1; row < height; ++row) borrow_row(row, row - 1);
    for (int row = height - 1; row > 0; --row) borrow_row(row - 1, row);
    for (int square = 0; square < height / kTile; ++square) cut(square, column);
  }

 private:
  static constexpr std::uint16_t kFar = 30000;
  static constexpr float kLargest = std::numeric_limits<float>::max();

  void spread(std::size_t first, std::ptrdiff_t direction) {
    float* to = reach.data() + first;
    std::uint16_t* at = steps_.data() + first;
    float last = 0.0f;
    int steps = kFar;
    for (int i = 0; i < width; ++i, to += direction, at += direction) {
      if (++steps < *at) {
        *to = last;
        *at = static_cast<std::uint16_t>(steps);
      } else {
        last = *to;
        steps = *at;
      }
    }
  }

  void borrow(std::size_t here, std::size_t there) {
    const std::uint16_t steps = static_cast<std::uint16_t>(steps_[there] + 1);
    const bool is_nearer = steps < steps_[here];
    reach[here] = is_nearer ? reach[there] : reach[here];
    steps_[here] = is_nearer ? steps : steps_[here];
  }

  void cut(int row, int column) {
    float low = kLargest, high = 0.0f;
    for (int v = row * kTile; v < (row + 1) * kTile; ++v) {
      const std::size_t first = static_cast<std::size_t>(v) * width + static_cast<std::size_t>(column) * kTile;
      for (std::size_t i = first; i < first + kTile; ++i) {
        const float most = steps_[i] ? half_voxel_ / (static_cast<float>(steps_[i]) + 0.5f) : kLargest;
        reach[i] = reach[i] < most ? reach[i] : most;
        low = reach[i] < low ? reach[i] : low;
        high = reach[i] > high ? reach[i] : high;
      }
    }
    least[static_cast<std::size_t>(row) * columns + column] = low;
    greatest[static_cast<std::size_t>(row) * columns + column] = high;
  }

  const DepthImage& image_;
  const float half_voxel_;  // pixels that half a voxel covers at 1 m
  std::vector<std::uint16_t> steps_;
};

}  // namespace splatctrl
