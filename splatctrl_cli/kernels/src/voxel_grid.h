// Voxels, a depth image before them, and how threads share voxel arrays.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace splatctrl {

struct VoxelGrid {
  double origin[3];  // centre of voxel (0, 0, 0) [m], world
  double voxel;      // [m]
  int size[3];       // X, Y, Z; index (i Y + j) Z + k
};

// depth (H, W) [m] along the optical axis; T_world_camera (4, 4). A depth nearer than min_range [m], or none at all,
// says nothing; one beyond max_range is no hit.
struct DepthImage {
  double fx, fy, cx, cy;
  int width, height;
  const double* T_world_camera;
  const float* depth;
  float min_range, max_range;

  bool has_depth(float z) const { return z > 0.0f && z >= min_range && z <= 3.4e38f; }
};

inline std::size_t index_of(const VoxelGrid& grid, const int* cell) {
  return (static_cast<std::size_t>(cell[0]) * grid.size[1] + cell[1]) * grid.size[2] + cell[2];
}

// Parts of size `edge` that cover `size`.
inline int parts(int size, int edge) { return (size + edge - 1) / edge; }

// A bit is only ever set within one call, or only ever cleared, so that threads may meet in a voxel: no order, no
// lost update. Returns whether the voxel changed.
inline bool set_bits(std::uint8_t* voxel, std::uint8_t bits) {
  if ((__atomic_load_n(voxel, __ATOMIC_RELAXED) & bits) == bits) return false;
  __atomic_fetch_or(voxel, bits, __ATOMIC_RELAXED);
  return true;
}

inline void clear_bits(std::uint8_t* voxel, std::uint8_t bits) {
  if (!(__atomic_load_n(voxel, __ATOMIC_RELAXED) & bits)) return;
  __atomic_fetch_and(voxel, static_cast<std::uint8_t>(~bits), __ATOMIC_RELAXED);
}

// The voxels that hold the points of an image's row: their indices, -1 where there is none.
class HitRow {
 public:
  HitRow(const VoxelGrid& grid, const DepthImage& image) : grid_(grid), image_(image), cells_(image.width) {}

  const std::vector<std::int32_t>& find(int v) {
    const float* depth = image_.depth + static_cast<std::size_t>(v) * image_.width;
    double from[3], ray[3], step[3];  // in voxels; voxel i spans [i, i + 1). The point of u is from + z (ray + u step)
    for (int axis = 0; axis < 3; ++axis) {
      const double* R = image_.T_world_camera + 4 * axis;
      from[axis] = (R[3] - grid_.origin[axis]) / grid_.voxel + 0.5;
      step[axis] = R[0] / image_.fx / grid_.voxel;
      ray[axis] = (R[1] * (v - image_.cy) / image_.fy + R[2]) / grid_.voxel - step[axis] * image_.cx;
    }
    for (int u = 0; u < image_.width; ++u) {
      const double z = depth[u];
      const double x = from[0] + z * (ray[0] + u * step[0]);
      const double y = from[1] + z * (ray[1] + u * step[1]);
      const double w = from[2] + z * (ray[2] + u * step[2]);
      const bool is_hit = image_.has_depth(depth[u]) && depth[u] <= image_.max_range && x >= 0.0 &&
                          x < grid_.size[0] && y >= 0.0 && y < grid_.size[1] && w >= 0.0 && w < grid_.size[2];
      const int cell[3] = {is_hit ? static_cast<int>(x) : 0, is_hit ? static_cast<int>(y) : 0,
                           is_hit ? static_cast<int>(w) : 0};
      cells_[u] = is_hit ? (cell[0] * grid_.size[1] + cell[1]) * grid_.size[2] + cell[2] : -1;
    }
    return cells_;
  }

 private:
  const VoxelGrid& grid_;
  const DepthImage& image_;
  std::vector<std::int32_t> cells_;
};

}  // namespace splatctrl
