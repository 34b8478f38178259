#include "surface_pieces.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <vector>

namespace splatctrl {
namespace {

// Disjoint sets of pixels; the first of each names it.
class Pieces {
 public:
  explicit Pieces(int size) : parent_(size) {}

  void add(int one) { parent_[one] = one; }

  int first_of(int one) {
    while (parent_[one] != one) one = parent_[one] = parent_[parent_[one]];
    return one;
  }

  void join(int a, int b) {
    a = first_of(a);
    b = first_of(b);
    parent_[std::max(a, b)] = std::min(a, b);
  }

 private:
  std::vector<int> parent_;
};

}  // namespace

void piece_areas(const PieceImage& image, double* total) {
  constexpr int kBeyond = 0;  // the piece of all that is not asked, before the pixels'
  const int width = image.width, size = image.height * width;
  Pieces pieces(size + 1);
  pieces.add(kBeyond);
  const auto join = [&](int pixel, int other) {
    if (!image.is_object[other] || !(image.asked[pixel] || image.asked[other])) return;
    const float step = std::min(image.steps[pixel], image.steps[other]);
    if (!(std::fabs(image.depth[pixel] - image.depth[other]) < step)) return;
    pieces.join(image.asked[pixel] ? pixel + 1 : kBeyond, image.asked[other] ? other + 1 : kBeyond);
  };
  const auto has_asked = [&](int first, int num) { return std::memchr(image.asked + first, 1, num) != nullptr; };
  constexpr int kBlock = 16;  // pixels of a row; where none of them or beside them is asked, there is nothing to join
  for (int v = 0; v < image.height; ++v) {
    for (int left = 0; left < width; left += kBlock) {
      const int right = std::min(left + kBlock, width), row = v * width;
      const int first = std::max(left - 1, 0), num = std::min(right + 1, width) - first;
      if (!has_asked(row + first, num) && (v == 0 || !has_asked(row - width + first, num))) continue;
      for (int u = left; u < right; ++u) {
        const int pixel = row + u;
        if (!image.is_object[pixel]) continue;
        if (image.asked[pixel]) pieces.add(pixel + 1);
        if (u > 0) join(pixel, pixel - 1);
        if (v == 0) continue;
        if (u > 0) join(pixel, pixel - width - 1);
        join(pixel, pixel - width);
        if (u + 1 < width) join(pixel, pixel - width + 1);
      }
    }
  }
  std::vector<double> areas(size + 1, 0.0);
  areas[kBeyond] = std::numeric_limits<double>::infinity();
  for (int pixel = 0; pixel < size; ++pixel) {
    if (image.asked[pixel]) areas[pieces.first_of(pixel + 1)] += image.area[pixel];
  }
  for (int pixel = 0; pixel < size; ++pixel) {
    total[pixel] = areas[image.asked[pixel] ? pieces.first_of(pixel + 1) : kBeyond];
  }
}

}  // namespace splatctrl
