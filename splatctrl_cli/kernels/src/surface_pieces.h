// Pieces of surface in a depth image.
#pragma once

#include <cstdint>

namespace splatctrl {

// Pixels (H, W) of a depth image [m]: `is_object` (1, else 0) are those that show objects, `asked` (1, else 0) of these
// those whose piece is wanted. steps (H, W) [m]: neighbours on one surface differ by less than the steps of both. area (H, W) [m^2]: what a
// pixel counts for.
struct PieceImage {
  const float *depth, *steps;
  const double* area;
  const std::uint8_t *is_object, *asked;
  int height, width;
};

// total (H, W): the area of the asked pixels of each asked pixel's piece, summed row after row; infinite where the
// piece goes on to an object pixel that is not asked, and away from the asked pixels.
void piece_areas(const PieceImage& image, double* total);

}  // namespace splatctrl
