// What eq. 4 of the paper weighs and compares. For host and device.
#pragma once

namespace splatctrl {

constexpr int kHalfWindow = 5;  // of SSIM, around its centre
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
constexpr float kOpaqueEnough = 0.1f;  // below this a normalised depth means nothing

// The Gaussian window, by distance from its centre: sigma 1.5, normalised.
struct Window {
  float weight[kHalfWindow + 1] = {0.266011715f, 0.213005543f, 0.109360687f, 0.0360007733f, 0.00759875821f, 0.00102838012f};
};

struct LossWeights {
  float dssim;       // lambda: share of D-SSIM in the colour loss
  float color;       // lambda_color
  float depth;       // lambda_depth
  float opacity;     // lambda_opacity: of the mean transmittance where there is depth (not in the paper)
  bool normalised;   // compare depth divided by accumulated opacity instead of eq. 3 as printed
  float background[3];  // seen through what the splats leave transparent: C + (1 - opacity) background is compared
};

}  // namespace splatctrl
