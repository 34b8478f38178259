// The image part of the paper's loss (eq. 4): L1 + D-SSIM on colour, L1 on depth; value and gradient together.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "loss_weights.h"

namespace splatctrl {

struct LossTerms {
  double l1 = 0.0;     // mean |C - C_gt| over pixels and channels
  double dssim = 0.0;  // mean 1 - SSIM
  double depth = 0.0;  // mean |D - D_gt| over pixels with depth [m]
  double transmittance = 0.0;  // mean 1 - accumulated opacity over pixels with depth
  double squared = 0.0;  // mean squared colour error, for PSNR
};

struct LossScratch;

// SSIM with an 11 x 11 Gaussian window of sigma 1.5, zero beyond the border, C1 = 0.01^2, C2 = 0.03^2.
class ImageLoss {
 public:
  ImageLoss();
  ImageLoss(const ImageLoss&) = delete;
  ImageLoss& operator=(const ImageLoss&) = delete;
  ~ImageLoss();

  // planes (5, H, W) as the rasteriser writes them; color (3, H, W) 0 to 255; depth (H, W) [m], 0 = none; counted
  // (H, W), 0 = this pixel is none of the map's business: it is given its target's colour, and no colour gradient.
  // Writes plane_gradients (5, H, W). Means are over counted pixels.
  LossTerms evaluate(const float* planes, const std::uint8_t* color, const float* depth,
                     const std::uint8_t* counted, int width, int height, const LossWeights& weights, float* plane_gradients, int num_threads);

 private:
  std::vector<std::unique_ptr<LossScratch>> scratch_;  // one per thread
  std::vector<LossTerms> bands_;                       // partial sums
};

}  // namespace splatctrl
