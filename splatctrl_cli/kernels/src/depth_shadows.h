// Shadows of a stereo depth camera: pixels that one of its two imagers cannot see.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatctrl {

// depth (H, W) [m], 0 = none. The nearer object is right of its shadow, or with is_turned left: columns then count
// from the right.
struct ShadowImage {
  const float* depth;
  int height, width;
  bool is_turned;
};

// Steps from a pixel's depth to a nearer one, the next in its row, where depth * nearer * step <= focal [px] *
// (depth - nearer). height: focal (1 / nearer - 1 / depth) [px/m]; lost: pixels between both. Returns their number, at
// most H W, in the order of rows and then columns.
std::size_t shadow_steps(const ShadowImage& image, float focal, float step, float* height, std::int32_t* lost);

// Sets is_shadow (H, W) at pixels without depth that are at most focal_baseline (1 / z - 1 / behind) + fattened [px]
// from the next in their row, of depth z. behind (H, W) [m].
void mark_shadows(const ShadowImage& image, const float* behind, float focal_baseline, float fattened,
                  std::uint8_t* is_shadow);

}  // namespace splatctrl
