#include "depth_shadows.h"

#include <algorithm>

namespace splatctrl {
namespace {

// True if the step is one; then it is added.
inline bool add_step(float depth, float nearer, int lost, float focal, float step, ShadowSteps& out) {
  if (!(step * depth * nearer <= focal * (depth - nearer))) return false;
  out.height[out.num] = focal * (1.0f / nearer - 1.0f / depth);
  out.lost[out.num++] = lost;
  return true;
}

}  // namespace

void shadow_steps(const ShadowImage& image, float focal, float step, ShadowSteps& right, ShadowSteps& left) {
  for (int v = 0; v < image.height; ++v) {
    const float* depth = image.depth + static_cast<std::size_t>(v) * image.width;
    const std::size_t first = left.num;
    int last = -1;  // column of the pixel with depth before
    for (int column = 0; column < image.width; ++column) {
      if (!(depth[column] > 0.0f)) continue;
      if (last >= 0 && !add_step(depth[last], depth[column], column - 1 - last, focal, step, right)) {
        add_step(depth[column], depth[last], column - 1 - last, focal, step, left);
      }
      last = column;
    }
    std::reverse(left.height + first, left.height + left.num);
    std::reverse(left.lost + first, left.lost + left.num);
  }
}

void mark_shadows(const ShadowImage& image, bool is_turned, const float* behind, float focal_baseline, float fattened,
                  std::uint8_t* is_shadow) {
  for (int v = 0; v < image.height; ++v) {
    const std::size_t row = static_cast<std::size_t>(v) * image.width;
    const auto at = [&](int column) { return row + (is_turned ? image.width - 1 - column : column); };
    int nearer = -1;  // column of the next pixel with depth
    for (int column = image.width - 1; column >= 0; --column) {
      const std::size_t pixel = at(column);
      if (image.depth[pixel] > 0.0f) nearer = column;
      if (image.depth[pixel] > 0.0f || nearer < 0) continue;
      const float inverse = 1.0f / image.depth[at(nearer)] - 1.0f / behind[pixel];
      if (nearer - column <= focal_baseline * inverse + fattened) is_shadow[pixel] = 1;
    }
  }
}

}  // namespace splatctrl
