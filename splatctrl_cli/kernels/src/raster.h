// Tiled rasteriser of depth-sorted 2-D Gaussians: colour, depth and accumulated opacity in one pass (eq. 2 and 3,
// with alpha_i * G_i(pixel) as the blended opacity), and the derivative of a loss on those images.
//
// It takes footprints with general 2-D covariances; what projects to them is the caller's affair.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "projection.h"
#include "raster_tile.h"

namespace splatctrl {

// Fills footprints[i], and visible[i] with 1 where it can be seen, for first <= i < last. Called for chunks of splats,
// on several threads.
using Projection = std::function<void(int first, int last, Footprint* footprints, std::uint8_t* visible)>;

// Buffers that live as long as the rasteriser: nothing is allocated once they have grown.
class Rasteriser {
 public:
  // Footprints of isotropic splats, depth order and tile lists.
  void prepare(const Camera& camera, int num_splats, const float* centers, const float* radii,
               const float* opacities, const float* colors, int num_threads);

  // The same for footprints that come from elsewhere; `project` may fill colors as well, for they are read after it.
  void prepare(const Camera& camera, int num_splats, const Projection& project, const float* colors,
               int num_threads);

  // planes (5, H, W): red, green, blue, depth, opacity.
  void forward(float* planes, int num_threads);

  // planes as forward() wrote them, their derivatives, and gradients (N): zero for splats that touch no tile. Throws
  // std::logic_error before forward().
  void backward(const float* planes, const float* plane_gradients, SplatGradient* gradients, int num_threads);

  // 1 for a splat that is on some tile's list.
  const std::vector<std::uint8_t>& visible() const { return visible_; }
  const std::vector<int>& tile_start() const { return tile_start_; }
  const Camera& camera() const { return camera_; }
  int num_splats() const { return num_splats_; }

 private:
  void sort_by_depth();
  void list_tiles(const float* colors, int num_threads);
  void fill_tiles(int num_threads);
  int chunk_first(int chunk) const;  // rank at which a chunk of the depth order begins
  TileImage image_of(int tile) const;
  void each_tile(int num_threads, const std::function<void(int)>& visit) const;

  Camera camera_{};
  int num_splats_ = 0, tiles_x_ = 0, tiles_y_ = 0;
  bool has_blended_ = false;  // forward() has been called for what is prepared
  std::vector<Footprint> footprints_;
  std::vector<std::uint8_t> visible_;
  std::vector<std::uint64_t> order_, order_scratch_;  // depth bits, then index: ascending
  std::vector<TileSplat> splats_;                     // in depth order
  std::vector<std::vector<int>> chunk_tiles_;         // by chunk of the depth order: the tiles of its splats
  std::vector<int> chunk_counts_;                     // (chunks, tiles) entries, then where they go
  std::vector<int> chunk_start_;                      // (chunks + 1) offsets into parts_
  std::vector<int> part_end_;                         // by depth rank, offset within the chunk
  std::vector<int> tile_start_;                       // (tiles + 1) offsets into entries_
  std::vector<TileEntry> entries_;                    // front to back within a tile
  std::vector<SplatGradient> parts_;                  // one per entry, splat by splat
};

}  // namespace splatctrl
