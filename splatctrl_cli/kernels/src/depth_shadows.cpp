#include "depth_shadows.h"

namespace splatctrl {
namespace {

// Rows of an image from the nearer object's side: pixel `column` has `at(column)` as its place in the row.
struct Row {
  std::size_t first;
  int width;
  bool is_turned;

  std::size_t at(int column) const { return first + (is_turned ? width - 1 - column : column); }
};

Row row_of(const ShadowImage& image, int v) {
  return {static_cast<std::size_t>(v) * image.width, image.width, image.is_turned};
}

}  // namespace

std::size_t shadow_steps(const ShadowImage& image, float focal, float step, float* height, std::int32_t* lost) {
  std::size_t num = 0;
  for (int v = 0; v < image.height; ++v) {
    const Row row = row_of(image, v);
    float before = 0.0f;
    int last = -1;  // column of `before`
    for (int column = 0; column < image.width; ++column) {
      const float z = image.depth[row.at(column)];
      if (!(z > 0.0f)) continue;
      if (last >= 0 && step * before * z <= focal * (before - z)) {
        height[num] = focal * (1.0f / z - 1.0f / before);
        lost[num++] = column - 1 - last;
      }
      before = z;
      last = column;
    }
  }
  return num;
}

void mark_shadows(const ShadowImage& image, const float* behind, float focal_baseline, float fattened,
                  std::uint8_t* is_shadow) {
  for (int v = 0; v < image.height; ++v) {
    const Row row = row_of(image, v);
    int nearer = -1;  // column of the next pixel with depth
    for (int column = image.width - 1; column >= 0; --column) {
      const std::size_t pixel = row.at(column);
      if (image.depth[pixel] > 0.0f) nearer = column;
      if (image.depth[pixel] > 0.0f || nearer < 0) continue;
      const float inverse = 1.0f / image.depth[row.at(nearer)] - 1.0f / behind[pixel];
      if (nearer - column <= focal_baseline * inverse + fattened) is_shadow[pixel] = 1;
    }
  }
}

}  // namespace splatctrl
