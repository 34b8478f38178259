// Shadows of a stereo depth camera: pixels that one of its two imagers cannot see.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatctrl {

// depth (H, W) [m], 0 = none.
struct ShadowImage {
  const float* depth;
  int height, width;
};

// Height, focal (1 / nearer - 1 / depth) [px/m], of each step, and lost pixels between its ends; at most H W.
struct ShadowSteps {
  float* height;
  std::int32_t* lost;
  std::size_t num;
};

// Finds steps from a pixel's depth to a nearer one, the next in its row with depth, where depth * nearer * step <=
// focal [px] * (depth - nearer). The nearer one is at the right in `right`, row after row, and at the left in `left`,
// whose columns count from the right.
void shadow_steps(const ShadowImage& image, float focal, float step, ShadowSteps& right, ShadowSteps& left);

// Sets is_shadow (H, W) at pixels without depth that are at most focal_baseline (1 / z - 1 / behind) + fattened [px]
// from the next in their row, of depth z: at their right, or with is_turned left. behind (H, W) [m].
void mark_shadows(const ShadowImage& image, bool is_turned, const float* behind, float focal_baseline, float fattened,
                  std::uint8_t* is_shadow);

}  // namespace splatctrl
