#include "depth_errors.h"

#include <cmath>
#include <limits>

namespace splatctrl {

std::size_t depth_errors(const RenderedDepth& image, float hole, float opaque, float* error, float* sizes) {
  constexpr float kFar = std::numeric_limits<float>::infinity();
  std::size_t num = 0;
  for (std::size_t i = 0; i < image.size; ++i) {
    const float opacity = image.opacity[i];
    const bool is_hole = opacity < hole;
    const float depth = opacity >= opaque ? image.depth[i] / opacity : 0.0f, off = depth - image.measured[i];
    error[i] = !image.counted[i] ? -kFar : is_hole ? kFar : off;
    sizes[num] = std::fabs(off);
    num += image.counted[i] && !is_hole;
  }
  return num;
}

}  // namespace splatctrl
