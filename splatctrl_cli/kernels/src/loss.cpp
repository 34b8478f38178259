#include "loss.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "parallel.h"
#include "simd.h"

namespace splatctrl {
namespace {

constexpr int kHalf = kHalfWindow;
constexpr int kBand = 40;   // rows of a chunk of work: its buffers, 10 rows more, stay in a core's cache
constexpr int kMaps = kBand + 2 * kHalf, kInputs = kBand + 4 * kHalf;  // rows that a band needs of SSIM, of the images
constexpr int kMargin = 8;  // columns of zeros on each side of a row
const Int8 kLane = {0, 1, 2, 3, 4, 5, 6, 7};

constexpr Window kWindow;

// The window's sum along a row (step 1) or a column (step = stride of the rows), eight pixels at a time.
inline Float8 window_sum(const float* p, std::ptrdiff_t step) {
  Float8 sum = load8(p) * kWindow.weight[0];
  for (int k = 1; k <= kHalf; ++k) sum += (load8(p - k * step) + load8(p + k * step)) * kWindow.weight[k];
  return sum;
}

Float8 sign8(Float8 x) { return keep8(x > 0.0f, splat8(1.0f)) - keep8(x < 0.0f, splat8(1.0f)); }

// Eight pixels of an image row from x on: whole, or shortened to the width.
Float8 load_pixels(const float* row, int x, int width) {
  if (x + 8 <= width) return load8(row + x);
  alignas(32) float part[8] = {};
  if (x < width) std::copy(row + x, row + width, part);
  return load8(part);
}

void store_pixels(float* row, int x, int width, Float8 value) {
  if (x + 8 <= width) return store8(row + x, value);
  alignas(32) float part[8];
  store8(part, value);
  if (x < width) std::copy(part, part + (width - x), row + x);
}

Int8 load_bytes(const std::uint8_t* row, int x, int width) {
  typedef std::uint8_t Byte8 __attribute__((vector_size(8)));
  Byte8 bytes{};
  std::memcpy(&bytes, row + x, std::min(8, width - x));
  return __builtin_convertvector(bytes, Int8);
}

// What is compared, one image against another.
struct Images {
  const float* planes;
  const std::uint8_t* color;
  const float* depth;
  const std::uint8_t* counted;
  int width, height;
  std::size_t size() const { return static_cast<std::size_t>(width) * height; }
  std::size_t row(int y) const { return static_cast<std::size_t>(y) * width; }
};

// One channel of eight pixels: sum and difference of the rendered colour, on its background, and the target's.
struct Pair {
  Float8 sum, difference;
};

inline Pair load_pair(const Images& images, int channel, float background, int y, int x) {
  const std::size_t row = images.row(y);
  const Int8 counts = load_bytes(images.counted + row, x, images.width) != 0;
  const Int8 levels = load_bytes(images.color + channel * images.size() + row, x, images.width);
  const Float8 target = __builtin_convertvector(levels, Float8) / 255.0f;
  const Float8 opacity = load_pixels(images.planes + 4 * images.size() + row, x, images.width);
  const Float8 rendered = load_pixels(images.planes + channel * images.size() + row, x, images.width);
  const Float8 difference = keep8(counts, rendered + (1.0f - opacity) * background - target);
  return {target + target + difference, difference};
}

}  // namespace

// Buffers of one thread: rows with zeros on both sides, whole vectors and aligned.
struct LossScratch {
  int stride = 0;
  Float8* memory = nullptr;

  LossScratch() = default;
  LossScratch(const LossScratch&) = delete;
  LossScratch& operator=(const LossScratch&) = delete;
  ~LossScratch() { delete[] memory; }

  // Sum and difference of the images, kInputs rows each.
  float* pair(int which, int row) { return at(which * kInputs + row); }
  // Derivatives of SSIM, summed along the rows, kMaps rows each.
  float* map(int which, int row) { return at(2 * kInputs + which * kMaps + row); }
  // One row: four moments summed along the columns, three derivatives.
  float* moment(int which) { return at(2 * kInputs + 3 * kMaps + which); }
  float* derivative(int which) { return at(2 * kInputs + 3 * kMaps + 4 + which); }

  void fit(int width) {
    const int needed = (width + 7) / 8 * 8 + 2 * kMargin;
    if (stride == needed) return;
    stride = needed;
    delete[] memory;
    memory = new Float8[(2 * kInputs + 3 * kMaps + 7) * static_cast<std::size_t>(stride) / 8]();
  }

 private:
  float* at(int row) { return reinterpret_cast<float*>(memory) + static_cast<std::size_t>(row) * stride + kMargin; }
};

namespace {

// One chunk of rows of the image, with what the band above and below contribute to its SSIM.
struct Band {
  const Images& images;
  LossScratch& scratch;
  int first, last;          // rows
  int map_first, map_last;  // rows whose SSIM depends on the band's

  Band(const Images& of, LossScratch& in, int index)
      : images(of), scratch(in), first(index * kBand), last(std::min(of.height, first + kBand)),
        map_first(std::max(first - kHalf, 0)), map_last(std::min(last + kHalf, of.height)) {}

  int map_row(int y) const { return y - (first - kHalf); }
  int pair_row(int y) const { return y - (first - 2 * kHalf); }

  // s and d: the sum of the two images and their difference; zero beyond the image.
  void load_pairs(int channel, float background) const {
    for (int y = first - 2 * kHalf; y < last + 2 * kHalf; ++y) {
      float* sum = scratch.pair(0, pair_row(y));
      float* difference = scratch.pair(1, pair_row(y));
      if (y < 0 || y >= images.height) {
        std::fill_n(sum, images.width, 0.0f);
        std::fill_n(difference, images.width, 0.0f);
        continue;
      }
      for (int x = 0; x < images.width; x += 8) {
        const Pair pair = load_pair(images, channel, background, y, x);
        store8(sum + x, pair.sum);
        store8(difference + x, pair.difference);
      }
    }
  }

  // One row of s, d, s^2, d^2, summed along the columns.
  void sum_columns(int y) const {
    const float* sum = scratch.pair(0, pair_row(y));
    const float* difference = scratch.pair(1, pair_row(y));
    const std::ptrdiff_t step = scratch.stride;
    for (int x = 0; x < images.width; x += 8) {
      const Float8 s = load8(sum + x), d = load8(difference + x);
      Float8 moment[4] = {s * kWindow.weight[0], d * kWindow.weight[0], s * s * kWindow.weight[0],
                          d * d * kWindow.weight[0]};
      for (int k = 1; k <= kHalf; ++k) {
        const Float8 s0 = load8(sum + x - k * step), s1 = load8(sum + x + k * step);
        const Float8 d0 = load8(difference + x - k * step), d1 = load8(difference + x + k * step);
        moment[0] += (s0 + s1) * kWindow.weight[k];
        moment[1] += (d0 + d1) * kWindow.weight[k];
        moment[2] += (s0 * s0 + s1 * s1) * kWindow.weight[k];
        moment[3] += (d0 * d0 + d1 * d1) * kWindow.weight[k];
      }
      for (int k = 0; k < 4; ++k) store8(scratch.moment(k) + x, moment[k]);
    }
  }

  // SSIM of one row, and its derivatives by the mean (of s and d together) and the second moments of s and d, summed
  // along the row. Returns the sum of SSIM.
  //
  // With S = mean(s)^2, D = mean(d)^2 and the variances V, W of s and d:
  // SSIM = ((S - D) / 2 + C1) ((V - W) / 2 + C2) / (((S + D) / 2 + C1) ((V + W) / 2 + C2)).
  double differentiate(int y) const {
    const float* sums[4] = {scratch.moment(0), scratch.moment(1), scratch.moment(2), scratch.moment(3)};
    float* d_mean = scratch.derivative(0);
    float* d_sum = scratch.derivative(1);
    float* d_difference = scratch.derivative(2);
    Float8 total{};
    for (int x = 0; x < images.width; x += 8) {
      const Float8 mean_s = window_sum(sums[0] + x, 1), mean_d = window_sum(sums[1] + x, 1);
      const Float8 S = mean_s * mean_s, D = mean_d * mean_d;
      const Float8 V = window_sum(sums[2] + x, 1) - S, W = window_sum(sums[3] + x, 1) - D;
      const Float8 n1 = 0.5f * (S - D) + kC1, n2 = 0.5f * (V - W) + kC2;
      const Float8 m1 = 0.5f * (S + D) + kC1, m2 = 0.5f * (V + W) + kC2;
      const Float8 inverse = 1.0f / (m1 * m2);
      const Float8 ssim = n1 * n2 * inverse;
      const Float8 half1 = 0.5f * m2 * inverse, half2 = 0.5f * m1 * inverse;  // 1 / (2 m1), 1 / (2 m2)
      const Float8 by_n1 = 0.5f * n2 * inverse, by_n2 = 0.5f * n1 * inverse;
      const Int8 inside = kLane < images.width - x;
      const Float8 by_V = keep8(inside, by_n2 - ssim * half2), by_W = keep8(inside, -by_n2 - ssim * half2);
      const Float8 by_S = by_n1 - ssim * half1 - by_V, by_D = -by_n1 - ssim * half1 - by_W;
      store8(d_mean + x, keep8(inside, 2.0f * (mean_s * by_S + mean_d * by_D)));
      store8(d_sum + x, by_V);
      store8(d_difference + x, by_W);
      total += keep8(inside, ssim);
    }
    for (int map = 0; map < 3; ++map) {
      const float* in = scratch.derivative(map);
      float* out = scratch.map(map, map_row(y));
      for (int x = 0; x < images.width; x += 8) store8(out + x, window_sum(in + x, 1));
    }
    return sum8(total);
  }

  void clear_maps_beyond_the_image() const {
    for (int y = first - kHalf; y < last + kHalf; ++y) {
      if (y >= 0 && y < images.height) continue;
      for (int map = 0; map < 3; ++map) {
        std::fill_n(scratch.map(map, map_row(y)), images.width, 0.0f);
      }
    }
  }

  // The derivative of the colour loss by one channel, and the sums of |d| and d^2.
  void color_gradient(int channel, float weight_l1, float weight_ssim, float* plane_gradients,
                      LossTerms* terms) const {
    float* gradient = plane_gradients + channel * images.size();
    for (int y = first; y < last; ++y) {
      Float8 sum_l1{}, sum_squared{};
      const float* maps[3];
      for (int map = 0; map < 3; ++map) maps[map] = scratch.map(map, map_row(y));
      for (int x = 0; x < images.width; x += 8) {
        const Float8 sum = load8(scratch.pair(0, pair_row(y)) + x);
        const Float8 difference = load8(scratch.pair(1, pair_row(y)) + x);
        const Int8 counts = load_bytes(images.counted + images.row(y), x, images.width) != 0;
        const Float8 ssim = window_sum(maps[0] + x, scratch.stride) +
                            2.0f * (sum * window_sum(maps[1] + x, scratch.stride) +
                                    difference * window_sum(maps[2] + x, scratch.stride));
        const Float8 value = weight_l1 * sign8(difference) - weight_ssim * ssim;
        store_pixels(gradient + images.row(y), x, images.width, keep8(counts, value));
        sum_l1 += difference * sign8(difference);
        sum_squared += difference * difference;
      }
      terms->l1 += sum8(sum_l1);
      terms->squared += sum8(sum_squared);
    }
  }

  // The depth loss, and the derivatives by depth and opacity; the colours' must be there for the background's share.
  void depth_gradient(const LossWeights& weights, float weight, float weight_opacity, float* plane_gradients,
                      LossTerms* terms) const {
    const int width = images.width;
    const std::size_t size = images.size();
    for (int y = first; y < last; ++y) {
      const std::size_t row = images.row(y);
      Float8 sum_error{}, sum_transmittance{};
      for (int x = 0; x < width; x += 8) {
        const Float8 target = load_pixels(images.depth + row, x, width);
        const Float8 rendered = load_pixels(images.planes + 3 * size + row, x, width);
        const Float8 opacity = load_pixels(images.planes + 4 * size + row, x, width);
        const Int8 is_valid = (target > 0.0f) & (load_bytes(images.counted + row, x, width) != 0);
        const Int8 divides = weights.normalised ? opacity > kOpaqueEnough : Int8{};
        const Float8 inverse = divides ? 1.0f / opacity : splat8(1.0f);
        const Float8 error = rendered * inverse - target;
        const Float8 sign = keep8(is_valid, weight * sign8(error));
        Float8 g_opacity = keep8(is_valid, splat8(-weight_opacity)) - keep8(divides, sign * rendered * inverse * inverse);
        for (int c = 0; c < 3; ++c) {
          g_opacity -= weights.background[c] * load_pixels(plane_gradients + c * size + row, x, width);
        }
        store_pixels(plane_gradients + 3 * size + row, x, width, sign * inverse);
        store_pixels(plane_gradients + 4 * size + row, x, width, g_opacity);
        sum_error += keep8(is_valid, error * sign8(error));
        sum_transmittance += keep8(is_valid, 1.0f - opacity);
      }
      terms->depth += sum8(sum_error);
      terms->transmittance += sum8(sum_transmittance);
    }
  }
};

}  // namespace

ImageLoss::ImageLoss() = default;
ImageLoss::~ImageLoss() = default;

LossTerms ImageLoss::evaluate(const float* planes, const std::uint8_t* color, const float* depth,
                              const std::uint8_t* counted, int width, int height, const LossWeights& weights,
                              float* plane_gradients, int num_threads) {
  const Images images{planes, color, depth, counted, width, height};
  long num_valid = 0, num_counted = 0;
  for (std::size_t i = 0; i < images.size(); ++i) {
    num_counted += counted[i] != 0;
    num_valid += counted[i] != 0 && depth[i] > 0.0f;
  }
  const double num_values = 3.0 * static_cast<double>(std::max<long>(num_counted, 1));
  const auto per_value = static_cast<float>(1.0 / num_values);
  const float weight_l1 = weights.color * (1.0f - weights.dssim) * per_value;
  const float weight_ssim = weights.color * weights.dssim * per_value;
  const float weight_depth = num_valid > 0 ? weights.depth / static_cast<float>(num_valid) : 0.0f;
  const float weight_opacity = num_valid > 0 ? weights.opacity / static_cast<float>(num_valid) : 0.0f;
  const int num_bands = (height + kBand - 1) / kBand;
  bands_.assign(num_bands, {});
  while (static_cast<int>(scratch_.size()) < num_threads) scratch_.push_back(std::make_unique<LossScratch>());
  std::atomic<int> next{0};
  parallel_for(num_threads, num_threads, [&](int worker) {
    scratch_[worker]->fit(width);
    for (int index = next.fetch_add(1); index < num_bands; index = next.fetch_add(1)) {
      const Band band(images, *scratch_[worker], index);
      LossTerms& terms = bands_[index];
      for (int c = 0; c < 3; ++c) {
        band.load_pairs(c, weights.background[c]);
        for (int y = band.map_first; y < band.map_last; ++y) {
          band.sum_columns(y);
          const double ssim = band.differentiate(y);
          if (y >= band.first && y < band.last) terms.dssim += ssim;
        }
        band.clear_maps_beyond_the_image();
        band.color_gradient(c, weight_l1, weight_ssim, plane_gradients, &terms);
      }
      band.depth_gradient(weights, weight_depth, weight_opacity, plane_gradients, &terms);
    }
  });
  LossTerms sum;
  for (const LossTerms& band : bands_) {
    sum.l1 += band.l1;
    sum.dssim += band.dssim;
    sum.depth += band.depth;
    sum.transmittance += band.transmittance;
    sum.squared += band.squared;
  }
  const auto num_depths = static_cast<double>(std::max<long>(num_valid, 1));
  return {sum.l1 / num_values, (3.0 * static_cast<double>(images.size()) - sum.dssim) / num_values,
          sum.depth / num_depths, sum.transmittance / num_depths, sum.squared / num_values};
}

}  // namespace splatctrl
