// An anisotropic Gaussian seen by a pinhole camera, with view-dependent colour, and every derivative (3D Gaussian
// splatting, Kerbl et al. 2023). Clamps, dilation and cut-offs are those of projection.h. Plain floats, for host and
// device.
#pragma once

#include <cmath>

#include "fast_exp.h"
#include "projection.h"

namespace splatctrl {

constexpr int kMaxHarmonics = 16;  // real spherical harmonics up to degree 3

// One row of a parameter array. Harmonics are channel-major: all of red, then green, then blue.
struct GaussianParameters {
  float center[3];      // [m], world
  float log_scale[3];   // of the sigmas [m] along the Gaussian's own axes
  float quat_wxyz[4];   // from those axes to world; of any length but zero
  float logit_opacity;
  float harmonics[3][kMaxHarmonics];
};
constexpr int kGaussianFloats = 11 + 3 * kMaxHarmonics;
static_assert(sizeof(GaussianParameters) == kGaussianFloats * sizeof(float), "rows cross as plain floats");

SPLATCTRL_HOST_DEVICE inline float gaussian_opacity(float logit) { return 1.0f / (1.0f + fast_exp(-logit)); }

// Rotation matrix (row-major) of a unit quaternion.
SPLATCTRL_HOST_DEVICE inline void rotation_of(const float* q, float* R) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  R[0] = 1.0f - 2.0f * (y * y + z * z);
  R[1] = 2.0f * (x * y - w * z);
  R[2] = 2.0f * (x * z + w * y);
  R[3] = 2.0f * (x * y + w * z);
  R[4] = 1.0f - 2.0f * (x * x + z * z);
  R[5] = 2.0f * (y * z - w * x);
  R[6] = 2.0f * (x * z - w * y);
  R[7] = 2.0f * (y * z + w * x);
  R[8] = 1.0f - 2.0f * (x * x + y * y);
}

// dL/dq of a unit quaternion from dL/dR, as if its four numbers were free.
SPLATCTRL_HOST_DEVICE inline void rotation_backward(const float* q, const float* g, float* g_q) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  g_q[0] = 2.0f * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]));
  g_q[1] = 2.0f * (y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5])) - 4.0f * x * (g[4] + g[8]);
  g_q[2] = 2.0f * (x * (g[1] + g[3]) + z * (g[5] + g[7]) + w * (g[2] - g[6])) - 4.0f * y * (g[0] + g[8]);
  g_q[3] = 2.0f * (x * (g[2] + g[6]) + y * (g[5] + g[7]) + w * (g[3] - g[1])) - 4.0f * z * (g[0] + g[4]);
}

// A Gaussian on the screen before its footprint: Sigma' = U U^T plus the dilation, U = J W R S (2 x 3).
struct CameraGaussian {
  CameraSplat at;
  float quat[4], inv_length;  // the unit quaternion, and one over the length it had
  float rotation[9];
  float scale[3];
  float n[2][3];              // rows of J W times z / f
  float U[2][3];
  float A, B, C;              // [px^2], dilation included
};

SPLATCTRL_HOST_DEVICE inline CameraGaussian see_gaussian(const Camera& camera, const GaussianParameters& p) {
  CameraGaussian s;
  s.at = to_camera(camera, p.center);
  const float* q = p.quat_wxyz;
  s.inv_length = 1.0f / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; ++k) s.quat[k] = q[k] * s.inv_length;
  rotation_of(s.quat, s.rotation);
  for (int k = 0; k < 3; ++k) s.scale[k] = fast_exp(p.log_scale[k]);
  const float* W = camera.rotation;
  const float inv_z = 1.0f / s.at.z;
  for (int k = 0; k < 3; ++k) {
    s.n[0][k] = W[k] - s.at.tx * W[6 + k];
    s.n[1][k] = W[3 + k] - s.at.ty * W[6 + k];
  }
  const float* R = s.rotation;
  for (int k = 0; k < 3; ++k) {
    s.U[0][k] = camera.fx * inv_z * s.scale[k] * (s.n[0][0] * R[k] + s.n[0][1] * R[3 + k] + s.n[0][2] * R[6 + k]);
    s.U[1][k] = camera.fy * inv_z * s.scale[k] * (s.n[1][0] * R[k] + s.n[1][1] * R[3 + k] + s.n[1][2] * R[6 + k]);
  }
  s.A = s.U[0][0] * s.U[0][0] + s.U[0][1] * s.U[0][1] + s.U[0][2] * s.U[0][2] + kDilation;
  s.B = s.U[0][0] * s.U[1][0] + s.U[0][1] * s.U[1][1] + s.U[0][2] * s.U[1][2];
  s.C = s.U[1][0] * s.U[1][0] + s.U[1][1] * s.U[1][1] + s.U[1][2] * s.U[1][2] + kDilation;
  return s;
}

// False where nothing can be seen, NaN among the parameters included.
SPLATCTRL_HOST_DEVICE inline bool project_gaussian(const Camera& camera, const GaussianParameters& p,
                                                   Footprint* out) {
  constexpr float kLeastLogit = -5.6f;  // its opacity is just below kMinAlpha
  if (!(p.logit_opacity > kLeastLogit)) return false;
  const float* R = camera.rotation;
  const float* c = p.center;
  if (!(R[6] * c[0] + R[7] * c[1] + R[8] * c[2] + camera.translation[2] > kNear)) return false;
  const CameraGaussian s = see_gaussian(camera, p);
  const float u = camera.fx * s.at.x / s.at.z + camera.cx;
  const float v = camera.fy * s.at.y / s.at.z + camera.cy;
  return footprint_of_covariance(s.A, s.B, s.C, u, v, s.at.z, gaussian_opacity(p.logit_opacity), camera, out);
}

// Three sigmas along the longer axis of the footprint [px].
SPLATCTRL_HOST_DEVICE inline float screen_radius(const CameraGaussian& s) {
  const float mean = 0.5f * (s.A + s.C), half = 0.5f * (s.A - s.C);
  return 3.0f * std::sqrt(mean + std::sqrt(half * half + s.B * s.B));
}

// From the footprint's derivatives to those of centre, log scales and quaternion.
SPLATCTRL_HOST_DEVICE inline void project_gaussian_backward(const Camera& camera, const CameraGaussian& s,
                                                            const FootprintGradient& g, GaussianParameters* out) {
  const CovarianceGradient cov = covariance_backward(s.A, s.B, s.C, g);
  const float inv_z = 1.0f / s.at.z;
  const float focal[2] = {camera.fx * inv_z, camera.fy * inv_z};
  float g_U[2][3], g_R[9] = {}, g_t[2];
  for (int k = 0; k < 3; ++k) {
    g_U[0][k] = 2.0f * cov.A * s.U[0][k] + cov.B * s.U[1][k];
    g_U[1][k] = 2.0f * cov.C * s.U[1][k] + cov.B * s.U[0][k];
    out->log_scale[k] = s.U[0][k] * g_U[0][k] + s.U[1][k] * g_U[1][k];
  }
  const float g_log_focal = out->log_scale[0] + out->log_scale[1] + out->log_scale[2];
  const float* W = camera.rotation;
  for (int row = 0; row < 2; ++row) {
    float g_h[3];
    for (int k = 0; k < 3; ++k) g_h[k] = focal[row] * s.scale[k] * g_U[row][k];
    g_t[row] = 0.0f;
    for (int i = 0; i < 3; ++i) {
      for (int k = 0; k < 3; ++k) g_R[3 * i + k] += s.n[row][i] * g_h[k];
      const float* R = s.rotation + 3 * i;
      g_t[row] -= W[6 + i] * (R[0] * g_h[0] + R[1] * g_h[1] + R[2] * g_h[2]);
    }
  }
  float g_unit[4];
  rotation_backward(s.quat, g_R, g_unit);
  const float along = s.quat[0] * g_unit[0] + s.quat[1] * g_unit[1] + s.quat[2] * g_unit[2] + s.quat[3] * g_unit[3];
  for (int k = 0; k < 4; ++k) out->quat_wxyz[k] = s.inv_length * (g_unit[k] - along * s.quat[k]);
  const float g_tx = s.at.clamped_x ? 0.0f : g_t[0], g_ty = s.at.clamped_y ? 0.0f : g_t[1];
  const float g_x = inv_z * g_tx + focal[0] * g.u;
  const float g_y = inv_z * g_ty + focal[1] * g.v;
  const float g_z = -inv_z * (g_log_focal + s.at.tx * g_tx + s.at.ty * g_ty + focal[0] * s.at.x * g.u +
                              focal[1] * s.at.y * g.v) +
                    g.depth;
  for (int k = 0; k < 3; ++k) out->center[k] = W[k] * g_x + W[3 + k] * g_y + W[6 + k] * g_z;
}

constexpr float kSh0 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
constexpr float kSh2[3] = {1.0925484305920792f, 0.31539156525252005f, 0.5462742152960396f};
constexpr float kSh3[5] = {0.5900435899266435f, 2.890611442640554f, 0.4570457994644658f, 0.3731763325901154f,
                           1.445305721320277f};

// The real spherical harmonics of a unit direction, with the signs that 3D-GS files use; zero above `degree`.
SPLATCTRL_HOST_DEVICE inline void harmonic_basis(int degree, float x, float y, float z, float* basis) {
  for (int k = 0; k < kMaxHarmonics; ++k) basis[k] = 0.0f;
  basis[0] = kSh0;
  if (degree < 1) return;
  basis[1] = -kSh1 * y;
  basis[2] = kSh1 * z;
  basis[3] = -kSh1 * x;
  if (degree < 2) return;
  const float xx = x * x, yy = y * y, zz = z * z;
  basis[4] = kSh2[0] * x * y;
  basis[5] = -kSh2[0] * y * z;
  basis[6] = kSh2[1] * (2.0f * zz - xx - yy);
  basis[7] = -kSh2[0] * x * z;
  basis[8] = kSh2[2] * (xx - yy);
  if (degree < 3) return;
  basis[9] = -kSh3[0] * y * (3.0f * xx - yy);
  basis[10] = kSh3[1] * x * y * z;
  basis[11] = -kSh3[2] * y * (4.0f * zz - xx - yy);
  basis[12] = kSh3[3] * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  basis[13] = -kSh3[2] * x * (4.0f * zz - xx - yy);
  basis[14] = kSh3[4] * z * (xx - yy);
  basis[15] = -kSh3[0] * x * (xx - 3.0f * yy);
}

// dL/d(direction) from dL/d(basis), as if the three numbers were free.
SPLATCTRL_HOST_DEVICE inline void harmonic_basis_backward(int degree, float x, float y, float z, const float* g,
                                                          float* out) {
  out[0] = out[1] = out[2] = 0.0f;
  if (degree < 1) return;
  out[0] = -kSh1 * g[3];
  out[1] = -kSh1 * g[1];
  out[2] = kSh1 * g[2];
  if (degree < 2) return;
  out[0] += kSh2[0] * (y * g[4] - z * g[7]) - 2.0f * kSh2[1] * x * g[6] + 2.0f * kSh2[2] * x * g[8];
  out[1] += kSh2[0] * (x * g[4] - z * g[5]) - 2.0f * kSh2[1] * y * g[6] - 2.0f * kSh2[2] * y * g[8];
  out[2] += -kSh2[0] * (y * g[5] + x * g[7]) + 4.0f * kSh2[1] * z * g[6];
  if (degree < 3) return;
  const float xx = x * x, yy = y * y, zz = z * z;
  out[0] += -6.0f * kSh3[0] * x * y * g[9] + kSh3[1] * y * z * g[10] + 2.0f * kSh3[2] * x * y * g[11] -
            6.0f * kSh3[3] * x * z * g[12] - kSh3[2] * (4.0f * zz - 3.0f * xx - yy) * g[13] +
            2.0f * kSh3[4] * x * z * g[14] - 3.0f * kSh3[0] * (xx - yy) * g[15];
  out[1] += -3.0f * kSh3[0] * (xx - yy) * g[9] + kSh3[1] * x * z * g[10] -
            kSh3[2] * (4.0f * zz - xx - 3.0f * yy) * g[11] - 6.0f * kSh3[3] * y * z * g[12] +
            2.0f * kSh3[2] * x * y * g[13] - 2.0f * kSh3[4] * y * z * g[14] + 6.0f * kSh3[0] * x * y * g[15];
  out[2] += kSh3[1] * x * y * g[10] - 8.0f * kSh3[2] * y * z * g[11] +
            kSh3[3] * (6.0f * zz - 3.0f * xx - 3.0f * yy) * g[12] - 8.0f * kSh3[2] * x * z * g[13] +
            kSh3[4] * (xx - yy) * g[14];
}

// The direction in which a camera at `eye` sees a centre, and one over the distance.
struct Sight {
  float direction[3], inv_distance;
};

SPLATCTRL_HOST_DEVICE inline Sight sight_of(const float* center, const float* eye) {
  Sight s;
  for (int k = 0; k < 3; ++k) s.direction[k] = center[k] - eye[k];
  const float* d = s.direction;
  s.inv_distance = 1.0f / std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  for (int k = 0; k < 3; ++k) s.direction[k] *= s.inv_distance;
  return s;
}

// Eight partial sums, so that a compiler may use vectors without changing the result.
SPLATCTRL_HOST_DEVICE inline float harmonic_sum(const float* basis, const float* coefficients) {
  float lane[8];
  for (int k = 0; k < 8; ++k) lane[k] = basis[k] * coefficients[k] + basis[k + 8] * coefficients[k + 8];
  return ((lane[0] + lane[4]) + (lane[2] + lane[6])) + ((lane[1] + lane[5]) + (lane[3] + lane[7]));
}

// 0.5 + sum of harmonics, no less than 0.
SPLATCTRL_HOST_DEVICE inline void gaussian_color(int degree, const float* eye, const GaussianParameters& p,
                                                 float* color) {
  const Sight s = sight_of(p.center, eye);
  float basis[kMaxHarmonics];
  harmonic_basis(degree, s.direction[0], s.direction[1], s.direction[2], basis);
  for (int c = 0; c < 3; ++c) {
    const float value = 0.5f + harmonic_sum(basis, p.harmonics[c]);
    color[c] = value > 0.0f ? value : 0.0f;
  }
}

// From the colour's derivatives to those of the harmonics (set) and the centre (added to).
SPLATCTRL_HOST_DEVICE inline void gaussian_color_backward(int degree, const float* eye, const GaussianParameters& p,
                                                          const float* g_color, GaussianParameters* out) {
  const Sight s = sight_of(p.center, eye);
  const float* d = s.direction;
  float basis[kMaxHarmonics], g_basis[kMaxHarmonics] = {}, g_d[3];
  harmonic_basis(degree, d[0], d[1], d[2], basis);
  for (int c = 0; c < 3; ++c) {
    const float g = 0.5f + harmonic_sum(basis, p.harmonics[c]) > 0.0f ? g_color[c] : 0.0f;
    for (int k = 0; k < kMaxHarmonics; ++k) {
      out->harmonics[c][k] = g * basis[k];
      g_basis[k] += g * p.harmonics[c][k];
    }
  }
  harmonic_basis_backward(degree, d[0], d[1], d[2], g_basis, g_d);
  const float along = d[0] * g_d[0] + d[1] * g_d[1] + d[2] * g_d[2];
  for (int k = 0; k < 3; ++k) out->center[k] += s.inv_distance * (g_d[k] - along * d[k]);
}

// All derivatives of one Gaussian on one image.
SPLATCTRL_HOST_DEVICE inline void gaussian_backward(const Camera& camera, int degree, const float* eye,
                                                    const GaussianParameters& p, const CameraGaussian& seen,
                                                    const FootprintGradient& g, const float* g_color,
                                                    GaussianParameters* out) {
  project_gaussian_backward(camera, seen, g, out);
  gaussian_color_backward(degree, eye, p, g_color, out);
  const float opacity = gaussian_opacity(p.logit_opacity);
  out->logit_opacity = g.opacity * opacity * (1.0f - opacity);
}

}  // namespace splatctrl
