// Tiled rasteriser of depth-sorted 2-D Gaussians: colour, depth and accumulated opacity in one pass (eq. 2 and 3,
// with alpha_i * G_i(pixel) as the blended opacity), and the derivative of a loss on those images.
//
// It takes footprints with general 2-D covariances; what projects to them is the caller's affair.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "projection.h"

namespace splatctrl {

constexpr int kTile = 16;          // [px]
constexpr int kNumPlanes = 5;      // red, green, blue, depth, accumulated opacity

// The derivative of a loss with respect to one splat on one image.
struct SplatGradient {
  FootprintGradient footprint;
  float color[3];
};

// Fills footprints[i], and visible[i] with 1 where it can be seen, for first <= i < last. Called for chunks of splats,
// on several threads.
using Projection = std::function<void(int first, int last, Footprint* footprints, std::uint8_t* visible)>;

// Buffers that live as long as the rasteriser: nothing is allocated once they have grown.
class Rasteriser {
 public:
  // Footprints of isotropic splats, depth order and tile lists. opacities and colors are kept by pointer until the
  // next call: forward() and backward() read them.
  void prepare(const Camera& camera, int num_splats, const float* centers, const float* radii,
               const float* opacities, const float* colors, int num_threads);

  // The same for footprints that come from elsewhere; `project` may fill colors as well.
  void prepare(const Camera& camera, int num_splats, const Projection& project, const float* colors,
               int num_threads);

  // planes (5, H, W): red, green, blue, depth, opacity.
  void forward(float* planes, int num_threads);

  // planes as forward() wrote them, their derivatives, and gradients (N): zero for splats that touch no tile.
  void backward(const float* planes, const float* plane_gradients, SplatGradient* gradients, int num_threads);

  // 1 for a splat that is on some tile's list.
  const std::vector<std::uint8_t>& visible() const { return visible_; }
  const std::vector<int>& tile_start() const { return tile_start_; }
  const Camera& camera() const { return camera_; }
  int num_splats() const { return num_splats_; }

 private:
  void sort_by_depth();
  void fill_tiles();
  void forward_tile(int tile, float* planes) const;
  void backward_tile(int tile, const float* planes, const float* plane_gradients);

  Camera camera_{};
  int num_splats_ = 0, tiles_x_ = 0, tiles_y_ = 0;
  const float* colors_ = nullptr;
  std::vector<Footprint> footprints_;
  std::vector<std::uint8_t> visible_;
  std::vector<std::uint64_t> order_;      // depth bits, then index: ascending
  std::vector<int> tile_start_;           // (tiles + 1) offsets into tile_splats_
  std::vector<int> tile_cursor_;
  std::vector<int> tile_splats_;          // splat indices, front to back within a tile
  std::vector<SplatGradient> instances_;  // one per entry of tile_splats_
};

}  // namespace splatctrl
