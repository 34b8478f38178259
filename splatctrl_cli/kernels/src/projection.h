// A splat seen by a pinhole camera: eq. 1 of the paper, and its derivative. Plain floats, for host and device.
#pragma once

#include <cmath>

#include "host_device.h"

namespace splatctrl {

constexpr float kDilation = 0.3f;         // [px^2] added to the 2-D covariance
constexpr float kMinAlpha = 1.0f / 255.0f;  // a contribution below this is skipped
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;
constexpr float kNear = 0.05f;            // [m]
constexpr float kFrustumMargin = 1.3f;    // J is evaluated no further out than this times the half field of view

struct Camera {
  float fx, fy, cx, cy;
  int width, height;
  float rotation[9];     // world to camera, row-major
  float translation[3];  // [m]
};

// A 2-D Gaussian on the image: mean [px], conic = inverse covariance [1/px^2], centre depth [m], and the box in
// which its contribution reaches kMinAlpha. level = 2 ln(255 opacity): d^T conic d <= level there.
struct Footprint {
  float u, v, a, b, c, depth, opacity, level;
  float half_width, half_height;  // [px]
};

// An isotropic splat in camera coordinates, with what its derivative needs again.
struct CameraSplat {
  float x, y, z;
  float tx, ty;           // x / z and y / z, clamped to the frustum margin
  bool clamped_x, clamped_y;
};

SPLATCTRL_HOST_DEVICE inline CameraSplat to_camera(const Camera& camera, const float* center) {
  const float* R = camera.rotation;
  const float* t = camera.translation;
  CameraSplat s;
  s.x = R[0] * center[0] + R[1] * center[1] + R[2] * center[2] + t[0];
  s.y = R[3] * center[0] + R[4] * center[1] + R[5] * center[2] + t[1];
  s.z = R[6] * center[0] + R[7] * center[1] + R[8] * center[2] + t[2];
  const float low_x = -kFrustumMargin * (camera.cx + 0.5f) / camera.fx;
  const float high_x = kFrustumMargin * (camera.width - 0.5f - camera.cx) / camera.fx;
  const float low_y = -kFrustumMargin * (camera.cy + 0.5f) / camera.fy;
  const float high_y = kFrustumMargin * (camera.height - 0.5f - camera.cy) / camera.fy;
  const float tx = s.x / s.z, ty = s.y / s.z;
  s.clamped_x = !(tx >= low_x && tx <= high_x);
  s.clamped_y = !(ty >= low_y && ty <= high_y);
  s.tx = tx < low_x ? low_x : (tx > high_x ? high_x : tx);
  s.ty = ty < low_y ? low_y : (ty > high_y ? high_y : ty);
  return s;
}

// The footprint of a general 2-D covariance [[A, B], [B, C]] (dilation included). False where nothing can be seen.
SPLATCTRL_HOST_DEVICE inline bool footprint_of_covariance(float A, float B, float C, float u, float v, float depth,
                                                          float opacity, const Camera& camera, Footprint* out) {
  const float det = A * C - B * B;
  if (!(det > 0.0f) || !(opacity >= kMinAlpha)) return false;
  const float level = 2.0f * std::log(255.0f * opacity);
  out->a = C / det;
  out->b = -B / det;
  out->c = A / det;
  out->u = u;
  out->v = v;
  out->depth = depth;
  out->opacity = opacity;
  out->level = level;
  out->half_width = std::sqrt(level * A);
  out->half_height = std::sqrt(level * C);
  const bool is_finite = std::isfinite(u) && std::isfinite(v) && std::isfinite(out->a) && std::isfinite(out->b) &&
                         std::isfinite(out->c) && std::isfinite(out->half_width) && std::isfinite(out->half_height);
  return is_finite && u + out->half_width >= 0.0f && u - out->half_width <= camera.width - 1.0f &&
         v + out->half_height >= 0.0f && v - out->half_height <= camera.height - 1.0f;
}

// Eq. 1 with Sigma = r^2 I: Sigma' = r^2 J J^T, plus the dilation.
SPLATCTRL_HOST_DEVICE inline bool project_isotropic(const Camera& camera, const float* center, float radius,
                                                    float opacity, Footprint* out) {
  const CameraSplat s = to_camera(camera, center);
  if (!(s.z > kNear) || !(radius > 0.0f)) return false;
  const float q = radius * radius / (s.z * s.z);
  const float A = q * camera.fx * camera.fx * (1.0f + s.tx * s.tx) + kDilation;
  const float B = q * camera.fx * camera.fy * s.tx * s.ty;
  const float C = q * camera.fy * camera.fy * (1.0f + s.ty * s.ty) + kDilation;
  const float u = camera.fx * s.x / s.z + camera.cx;
  const float v = camera.fy * s.y / s.z + camera.cy;
  return footprint_of_covariance(A, B, C, u, v, s.z, opacity, camera, out);
}

// Derivatives of a loss with respect to a footprint.
struct FootprintGradient {
  float u, v, a, b, c, depth, opacity;
};

// Derivatives with respect to a 2-D covariance [[A, B], [B, C]], from those of its inverse.
struct CovarianceGradient {
  float A, B, C;
};

SPLATCTRL_HOST_DEVICE inline CovarianceGradient covariance_backward(float A, float B, float C,
                                                                    const FootprintGradient& g) {
  const float det = A * C - B * B;
  const float k = 1.0f / (det * det);
  return {k * (-C * C * g.a + B * C * g.b - B * B * g.c),
          k * (2.0f * B * C * g.a - (A * C + B * B) * g.b + 2.0f * A * B * g.c),
          k * (-B * B * g.a + A * B * g.b - A * A * g.c)};
}

// From the footprint's derivatives to those of the centre (world) and the radius.
SPLATCTRL_HOST_DEVICE inline void project_isotropic_backward(const Camera& camera, const float* center, float radius,
                                                             const FootprintGradient& g, float* g_center,
                                                             float* g_radius) {
  const CameraSplat s = to_camera(camera, center);
  const float fx = camera.fx, fy = camera.fy;
  const float q = radius * radius / (s.z * s.z);
  const float A = q * fx * fx * (1.0f + s.tx * s.tx) + kDilation;
  const float B = q * fx * fy * s.tx * s.ty;
  const float C = q * fy * fy * (1.0f + s.ty * s.ty) + kDilation;
  const auto [g_A, g_B, g_C] = covariance_backward(A, B, C, g);
  const float g_q = g_A * fx * fx * (1.0f + s.tx * s.tx) + g_B * fx * fy * s.tx * s.ty +
                    g_C * fy * fy * (1.0f + s.ty * s.ty);
  const float g_tx = s.clamped_x ? 0.0f : q * fx * (2.0f * fx * s.tx * g_A + fy * s.ty * g_B);
  const float g_ty = s.clamped_y ? 0.0f : q * fy * (2.0f * fy * s.ty * g_C + fx * s.tx * g_B);
  const float inv_z = 1.0f / s.z;
  const float g_x = inv_z * (g_tx + fx * g.u);
  const float g_y = inv_z * (g_ty + fy * g.v);
  const float g_z = -inv_z * (2.0f * q * g_q + s.tx * g_tx + s.ty * g_ty) -
                    inv_z * inv_z * (fx * s.x * g.u + fy * s.y * g.v) + g.depth;
  const float* R = camera.rotation;
  g_center[0] = R[0] * g_x + R[3] * g_y + R[6] * g_z;
  g_center[1] = R[1] * g_x + R[4] * g_y + R[7] * g_z;
  g_center[2] = R[2] * g_x + R[5] * g_y + R[8] * g_z;
  *g_radius = 2.0f * q / radius * g_q;
}

}  // namespace splatctrl
