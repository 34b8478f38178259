// Planes beside pixels of a depth image.
#pragma once

#include <cstdint>

namespace splatctrl {

// Pixels (H, W) of a depth image [m]: `support` are those that planes are fitted to, `asked` those that are compared
// with them. tolerance (H, W) [m]: how far an asked pixel may lie from its plane.
struct PlaneImage {
  const float *depth, *tolerance;
  const std::uint8_t *support, *asked;
  int height, width;
};

// A plane counts where its variance at the pixel, relative to that of one pixel, and the mean square of its residuals
// in 1 / depth are no greater.
struct PlaneRule {
  double variance, residual;
};

// Fits 1 / depth to the support within `reach` columns and rows of every asked pixel, by least squares. Where the
// pixel lies off that plane, its step (H, W) [m] becomes half of the distance if that is less.
void surface_steps(const PlaneImage& image, int reach, const PlaneRule& rule, float* steps);

}  // namespace splatctrl
