#include "loss.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "parallel.h"
#include "simd.h"

namespace splatctrl {
namespace {

constexpr int kHalf = 5;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
constexpr float kOpaqueEnough = 0.1f;  // below this a normalised depth means nothing

struct Window {
  float weight[kHalf + 1];  // by distance from the centre
  Window() {
    double sum = 0.0, value[kHalf + 1];
    for (int k = 0; k <= kHalf; ++k) {
      value[k] = std::exp(-k * k / (2.0 * 1.5 * 1.5));
      sum += k == 0 ? value[k] : 2.0 * value[k];
    }
    for (int k = 0; k <= kHalf; ++k) weight[k] = static_cast<float>(value[k] / sum);
  }
};
const Window kWindow;
const Int8 kLane = {0, 1, 2, 3, 4, 5, 6, 7};

// A row with room for the window on both sides and for whole vectors; the margins stay zero.
struct PaddedRow {
  std::vector<float> values;
  explicit PaddedRow(int width) : values(2 * 8 + (width + 7) / 8 * 8, 0.0f) {}
  float* at(int x) { return values.data() + 8 + x; }
};

Float8 horizontal(PaddedRow& row, int x) {
  const float* p = row.at(x);
  Float8 sum = load8(p) * kWindow.weight[0];
  for (int k = 1; k <= kHalf; ++k) sum += (load8(p - k) + load8(p + k)) * kWindow.weight[k];
  return sum;
}

// Loads and stores eight pixels of an image row, the last group shortened to the width.
Float8 load_pixels(const float* row, int x, int width) {
  if (x + 8 <= width) return load8(row + x);
  alignas(32) float part[8] = {};
  std::copy(row + x, row + width, part);
  return load8(part);
}

void store_pixels(float* row, int x, int width, Float8 value) {
  if (x + 8 <= width) return store8(row + x, value);
  alignas(32) float part[8];
  store8(part, value);
  std::copy(part, part + (width - x), row + x);
}

Float8 sign8(Float8 x) {
  return x > 0.0f ? splat8(1.0f) : (x < 0.0f ? splat8(-1.0f) : Float8{});
}

struct Image {
  int width, height;
  const float* row(const float* plane, int y) const { return plane + static_cast<std::size_t>(y) * width; }
  float* row(float* plane, int y) const { return plane + static_cast<std::size_t>(y) * width; }
};

// One row of the colours that are compared: the background added, the target's own where a pixel does not count.
void seen_row(const Image& image, const float* planes, const float* color, const std::uint8_t* counted, int row,
              const float* background, float* seen) {
  const std::size_t size = static_cast<std::size_t>(image.width) * image.height;
  const float* opacity = image.row(planes + 4 * size, row);
  for (int c = 0; c < 3; ++c) {
    const float* x = image.row(planes + c * size, row);
    const float* y = image.row(color + c * size, row);
    float* out = image.row(seen + c * size, row);
    for (int u = 0; u < image.width; ++u) out[u] = counted[u] ? x[u] + (1.0f - opacity[u]) * background[c] : y[u];
  }
}

// One row of SSIM and of its derivatives with respect to the three moments that hold x.
double ssim_row(const Image& image, const float* x_plane, const float* y_plane, int row, std::vector<PaddedRow>& sums,
                float* d_mean, float* d_second, float* d_cross) {
  const int width = image.width;
  for (int x = 0; x < width; x += 8) {
    Float8 sum[5] = {};  // x, y, x x, y y, x y
    for (int k = -kHalf; k <= kHalf; ++k) {
      if (row + k < 0 || row + k >= image.height) continue;
      const Float8 a = load_pixels(image.row(x_plane, row + k), x, width);
      const Float8 b = load_pixels(image.row(y_plane, row + k), x, width);
      const float weight = kWindow.weight[k < 0 ? -k : k];
      const Float8 wa = a * weight, wb = b * weight;
      sum[0] += wa;
      sum[1] += wb;
      sum[2] += wa * a;
      sum[3] += wb * b;
      sum[4] += wa * b;
    }
    for (int map = 0; map < 5; ++map) store8(sums[map].at(x), sum[map]);
  }
  Float8 total{};
  for (int x = 0; x < width; x += 8) {
    const Float8 mean_x = horizontal(sums[0], x), mean_y = horizontal(sums[1], x);
    const Float8 var_x = horizontal(sums[2], x) - mean_x * mean_x;
    const Float8 var_y = horizontal(sums[3], x) - mean_y * mean_y;
    const Float8 cov = horizontal(sums[4], x) - mean_x * mean_y;
    const Float8 n1 = 2.0f * mean_x * mean_y + kC1, n2 = 2.0f * cov + kC2;
    const Float8 i1 = 1.0f / (mean_x * mean_x + mean_y * mean_y + kC1), i2 = 1.0f / (var_x + var_y + kC2);
    const Float8 ssim = n1 * n2 * i1 * i2;
    const Int8 inside = kLane + x < width;
    total += inside ? ssim : Float8{};
    store_pixels(d_mean, x, width, 2.0f * mean_y * (n2 - n1) * i1 * i2 - 2.0f * mean_x * ssim * (i1 - i2));
    store_pixels(d_second, x, width, -ssim * i2);
    store_pixels(d_cross, x, width, 2.0f * n1 * i1 * i2);
  }
  return sum8(total);
}

// The derivative of the colour loss for one row of one channel; returns the sums of |x - y| and (x - y)^2.
void color_row(const Image& image, const float* x_plane, const float* y_plane, const std::uint8_t* counted,
               const float* maps[3], int row, float weight_l1, float weight_ssim, std::vector<PaddedRow>& sums, float* gradient, double* l1,
               double* squared) {
  const int width = image.width;
  for (int x = 0; x < width; x += 8) {
    Float8 sum[3] = {};
    for (int k = -kHalf; k <= kHalf; ++k) {
      if (row + k < 0 || row + k >= image.height) continue;
      const float weight = kWindow.weight[k < 0 ? -k : k];
      for (int map = 0; map < 3; ++map) sum[map] += load_pixels(image.row(maps[map], row + k), x, width) * weight;
    }
    for (int map = 0; map < 3; ++map) store8(sums[map].at(x), sum[map]);
  }
  Float8 sum_l1{}, sum_squared{};
  const float* x_row = image.row(x_plane, row);
  const float* y_row = image.row(y_plane, row);
  for (int x = 0; x < width; x += 8) {
    const Float8 a = load_pixels(x_row, x, width), b = load_pixels(y_row, x, width);
    const Float8 ssim = horizontal(sums[0], x) + 2.0f * a * horizontal(sums[1], x) + b * horizontal(sums[2], x);
    const Float8 error = a - b;
    sum_l1 += error * sign8(error);
    sum_squared += error * error;
    store_pixels(gradient, x, width, weight_l1 * sign8(error) - weight_ssim * ssim);
  }
  for (int x = 0; x < width; ++x) gradient[x] = counted[x] ? gradient[x] : 0.0f;
  *l1 += sum8(sum_l1);
  *squared += sum8(sum_squared);
}

void depth_row(const Image& image, const float* planes, const float* depth, int row, float weight, float weight_opacity,
               bool normalised, float* plane_gradients, double* error_sum, double* transmittance_sum) {
  const std::size_t size = static_cast<std::size_t>(image.width) * image.height;
  const float* rendered = image.row(planes + 3 * size, row);
  const float* opacity = image.row(planes + 4 * size, row);
  const float* target = image.row(depth, row);
  float* g_depth = image.row(plane_gradients + 3 * size, row);
  float* g_opacity = image.row(plane_gradients + 4 * size, row);
  for (int x = 0; x < image.width; ++x) {
    g_depth[x] = g_opacity[x] = 0.0f;
    if (!(target[x] > 0.0f)) continue;
    const float inverse = normalised && opacity[x] > kOpaqueEnough ? 1.0f / opacity[x] : 1.0f;
    const float error = rendered[x] * inverse - target[x];
    const float sign = error > 0.0f ? weight : (error < 0.0f ? -weight : 0.0f);
    *error_sum += std::abs(error);
    *transmittance_sum += 1.0f - opacity[x];
    g_depth[x] = sign * inverse;
    g_opacity[x] = -weight_opacity;
    if (inverse != 1.0f) g_opacity[x] -= sign * rendered[x] * inverse * inverse;
  }
}

// The background's share in the opacity's derivative, from the finished derivatives of one row's colours.
void background_row(const Image& image, int row, const float* background, float* plane_gradients) {
  const std::size_t size = static_cast<std::size_t>(image.width) * image.height;
  float* g_opacity = image.row(plane_gradients + 4 * size, row);
  for (int c = 0; c < 3; ++c) {
    const float* g_color = image.row(plane_gradients + c * size, row);
    for (int x = 0; x < image.width; ++x) g_opacity[x] -= background[c] * g_color[x];
  }
}

long count_valid(const float* depth, std::size_t size) {
  return std::count_if(depth, depth + size, [](float d) { return d > 0.0f; });
}

}  // namespace

LossTerms ImageLoss::evaluate(const float* planes, const float* color, const float* depth, const std::uint8_t* counted,
                              int width, int height, const LossWeights& weights, float* plane_gradients,
                              int num_threads) {
  const Image image{width, height};
  const std::size_t size = static_cast<std::size_t>(width) * height;
  seen_.resize(3 * size);
  maps_.resize(9 * size);
  rows_.assign(5 * static_cast<std::size_t>(height), 0.0);
  const long num_valid = count_valid(depth, size);
  const long num_counted = std::count_if(counted, counted + size, [](std::uint8_t c) { return c != 0; });
  const double num_values = 3.0 * static_cast<double>(std::max(num_counted, 1L));
  const auto per_value = static_cast<float>(1.0 / num_values);
  const float weight_l1 = weights.color * (1.0f - weights.dssim) * per_value;
  const float weight_ssim = weights.color * weights.dssim * per_value;
  const float weight_depth = num_valid > 0 ? weights.depth / static_cast<float>(num_valid) : 0.0f;
  const float weight_opacity = num_valid > 0 ? weights.opacity / static_cast<float>(num_valid) : 0.0f;
  constexpr int kRows = 8;
  const int num_chunks = (height + kRows - 1) / kRows;
  const auto each_row = [&](int chunk, auto&& visit) {
    for (int row = chunk * kRows; row < std::min(height, (chunk + 1) * kRows); ++row) visit(row);
  };
  parallel_for(num_chunks, num_threads, [&](int chunk) {
    each_row(chunk, [&](int row) {
      seen_row(image, planes, color, counted + static_cast<std::size_t>(row) * width, row, weights.background,
               seen_.data());
    });
  });
  parallel_for(num_chunks, num_threads, [&](int chunk) {
    std::vector<PaddedRow> sums(5, PaddedRow(width));
    each_row(chunk, [&](int row) {
      for (int c = 0; c < 3; ++c) {
        float* maps = maps_.data() + 3 * c * size;
        rows_[5 * row] += ssim_row(image, seen_.data() + c * size, color + c * size, row, sums, image.row(maps, row),
                                   image.row(maps + size, row), image.row(maps + 2 * size, row));
      }
    });
  });
  parallel_for(num_chunks, num_threads, [&](int chunk) {
    std::vector<PaddedRow> sums(3, PaddedRow(width));
    each_row(chunk, [&](int row) {
      for (int c = 0; c < 3; ++c) {
        const float* maps = maps_.data() + 3 * c * size;
        const float* three[3] = {maps, maps + size, maps + 2 * size};
        color_row(image, seen_.data() + c * size, color + c * size, counted + static_cast<std::size_t>(row) * width,
                  three, row, weight_l1, weight_ssim, sums, image.row(plane_gradients + c * size, row), &rows_[5 * row + 1], &rows_[5 * row + 2]);
      }
      depth_row(image, planes, depth, row, weight_depth, weight_opacity, weights.normalised, plane_gradients,
                &rows_[5 * row + 3], &rows_[5 * row + 4]);
      background_row(image, row, weights.background, plane_gradients);
    });
  });
  LossTerms terms;
  double ssim = 0.0;
  for (int row = 0; row < height; ++row) {
    ssim += rows_[5 * row];
    terms.l1 += rows_[5 * row + 1];
    terms.squared += rows_[5 * row + 2];
    terms.depth += rows_[5 * row + 3];
    terms.transmittance += rows_[5 * row + 4];
  }
  terms.dssim = (3.0 * static_cast<double>(size) - ssim) / num_values;
  terms.l1 /= num_values;
  terms.squared /= num_values;
  terms.depth /= static_cast<double>(std::max(num_valid, 1L));
  terms.transmittance /= static_cast<double>(std::max(num_valid, 1L));
  return terms;
}

}  // namespace splatctrl
