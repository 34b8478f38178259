#include "loss.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>

#include "parallel.h"
#include "simd16.h"

namespace splatctrl {
namespace {

constexpr int kHalf = kHalfWindow;
constexpr int kBand = 60;    // rows of a chunk of work, beside which 5 on each side are differentiated again
constexpr int kRing = 16;    // rows that are kept: more than the 11 of a window
constexpr int kMargin = 16;  // columns of zeros on each side of a row

constexpr Window kWindow;

// The window's sum along a row, of sixteen pixels.
inline Float16 sum_along(const float* p) {
  Float16 sum = shifted16<0>(p) * kWindow.weight[0];
  sum = fma16(shifted16<-1>(p) + shifted16<1>(p), kWindow.weight[1], sum);
  sum = fma16(shifted16<-2>(p) + shifted16<2>(p), kWindow.weight[2], sum);
  sum = fma16(shifted16<-3>(p) + shifted16<3>(p), kWindow.weight[3], sum);
  sum = fma16(shifted16<-4>(p) + shifted16<4>(p), kWindow.weight[4], sum);
  return fma16(shifted16<-5>(p) + shifted16<5>(p), kWindow.weight[5], sum);
}

inline Float16 sign16(Float16 x) {
  const Float16 zero = splat16(0.0f), one = splat16(1.0f);
  return keep16(less16(zero, x), one) - keep16(less16(x, zero), one);
}

// Sixteen pixels of an image row from x on: whole, or shortened to the width.
inline Float16 load_pixels(const float* row, int x, int width) {
  if (x + 16 <= width) return load16(row + x);
  alignas(64) float part[16] = {};
  if (x < width) std::copy(row + x, row + width, part);
  return load16(part);
}

inline void store_pixels(float* row, int x, int width, Float16 value) {
  if (x + 16 <= width) return store16(row + x, value);
  alignas(64) float part[16];
  store16(part, value);
  if (x < width) std::copy(part, part + (width - x), row + x);
}

inline Float16 load_bytes(const std::uint8_t* row, int x, int width) {
  if (x + 16 <= width) return join16(load_bytes8(row + x), load_bytes8(row + x + 8));
  std::uint8_t part[16] = {};
  if (x < width) std::copy(row + x, row + width, part);
  return join16(load_bytes8(part), load_bytes8(part + 8));
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
  Mask16 counts(int y, int x) const { return less16(splat16(0.0f), load_bytes(counted + row(y), x, width)); }
};

// One channel of sixteen pixels: sum and difference of the rendered colour, on its background, and the target's.
struct Pair {
  Float16 sum, difference;
};

inline Pair load_pair(const Images& images, int channel, float background, int y, int x) {
  const std::size_t row = images.row(y);
  const Float16 target = load_bytes(images.color + channel * images.size() + row, x, images.width) / splat16(255.0f);
  const Float16 opacity = load_pixels(images.planes + 4 * images.size() + row, x, images.width);
  const Float16 rendered = load_pixels(images.planes + channel * images.size() + row, x, images.width);
  const Float16 shown = rendered + (1.0f - opacity) * background - target;
  const Float16 difference = keep16(images.counts(y, x), shown);
  return {target + target + difference, difference};
}

}  // namespace

// Buffers of one thread: rows with zeros on both sides, whole vectors and aligned. The last rows of the images that are
// compared, as sum and difference; of the derivatives of SSIM; and one row each of what lies between.
struct LossScratch {
  int stride = 0;
  float* memory = nullptr;

  LossScratch() = default;
  LossScratch(const LossScratch&) = delete;
  LossScratch& operator=(const LossScratch&) = delete;
  ~LossScratch() { std::free(memory); }

  float* pair(int which, int y) { return at(which * kRing + y % kRing); }
  float* map(int which, int y) { return at((2 + which) * kRing + y % kRing); }
  float* moment(int which) { return at(5 * kRing + which); }
  float* derivative(int which) { return at(5 * kRing + 4 + which); }
  float* zeros() { return at(5 * kRing + 7); }

  void fit(int width) {
    const int needed = (width + 15) / 16 * 16 + 2 * kMargin;
    if (stride == needed) return;
    std::free(memory);
    stride = needed;
    const std::size_t size = (5 * kRing + 8) * static_cast<std::size_t>(stride) * sizeof(float);
    memory = static_cast<float*>(std::aligned_alloc(64, size));
    if (memory == nullptr) throw std::bad_alloc();
    std::memset(memory, 0, size);
  }

 private:
  float* at(int row) { return memory + static_cast<std::size_t>(row) * stride + kMargin; }
};

namespace {

// One chunk of rows of the image. A row of SSIM needs five rows of the images on each side, a row of the gradient five
// rows of SSIM's derivatives.
struct Band {
  const Images& images;
  LossScratch& scratch;
  int first, last;  // rows

  Band(const Images& of, LossScratch& in, int index)
      : images(of), scratch(in), first(index * kBand), last(std::min(of.height, first + kBand)) {}

  bool is_inside(int y) const { return y >= 0 && y < images.height; }

  // One channel: its gradient, and the sums of 1 - SSIM, |d| and d^2 over the band.
  void differentiate(int channel, float background, float weight_l1, float weight_ssim, float* plane_gradients,
                     LossTerms* terms) const {
    for (int y = std::max(first - 2 * kHalf, 0); y < last + 2 * kHalf; ++y) {
      if (is_inside(y)) load_row(channel, background, y);
      const int middle = y - kHalf;
      if (middle >= first - kHalf && is_inside(middle)) {
        sum_columns(middle);
        const double ssim = derivatives(middle);
        if (middle >= first && middle < last) terms->dssim += ssim;
      }
      if (middle - kHalf < first) continue;
      color_gradient(channel, middle - kHalf, weight_l1, weight_ssim, plane_gradients, terms);
    }
  }

  // s and d: the sum of the two images and their difference.
  void load_row(int channel, float background, int y) const {
    float* sum = scratch.pair(0, y);
    float* difference = scratch.pair(1, y);
    for (int x = 0; x < images.width; x += 16) {
      const Pair pair = load_pair(images, channel, background, y, x);
      store16(sum + x, pair.sum);
      store16(difference + x, pair.difference);
    }
  }

  // The rows of a window around row y; zero beyond the image.
  struct Rows {
    const float* at[2 * kHalf + 1];
  };
  template <class Row>
  Rows rows_around(int y, const Row& row) const {
    Rows rows;
    for (int k = -kHalf; k <= kHalf; ++k) rows.at[kHalf + k] = is_inside(y + k) ? row(y + k) : scratch.zeros();
    return rows;
  }
  static Float16 sum_down(const Rows& rows, int x) {
    Float16 sum = load16(rows.at[kHalf] + x) * kWindow.weight[0];
    for (int k = 1; k <= kHalf; ++k) {
      sum = fma16(load16(rows.at[kHalf - k] + x) + load16(rows.at[kHalf + k] + x), kWindow.weight[k], sum);
    }
    return sum;
  }

  // One row of s, d, s^2, d^2, summed along the columns.
  void sum_columns(int y) const {
    for (int which = 0; which < 2; ++which) {
      const Rows rows = rows_around(y, [&](int row) { return scratch.pair(which, row); });
      float* first_moment = scratch.moment(which);
      float* second_moment = scratch.moment(2 + which);
      for (int x = 0; x < images.width; x += 16) {
        const Float16 here = load16(rows.at[kHalf] + x);
        Float16 sum = here * kWindow.weight[0], squares = here * here * kWindow.weight[0];
        for (int k = 1; k <= kHalf; ++k) {
          const Float16 above = load16(rows.at[kHalf - k] + x), below = load16(rows.at[kHalf + k] + x);
          sum = fma16(above + below, kWindow.weight[k], sum);
          squares = fma16(fma16(above, above, below * below), kWindow.weight[k], squares);
        }
        store16(first_moment + x, sum);
        store16(second_moment + x, squares);
      }
    }
  }

  // SSIM of one row, and its derivatives by the mean (of s and d together) and the second moments of s and d, summed
  // along the row. Returns the sum of SSIM.
  //
  // With S = mean(s)^2, D = mean(d)^2 and the variances V, W of s and d:
  // SSIM = ((S - D) / 2 + C1) ((V - W) / 2 + C2) / (((S + D) / 2 + C1) ((V + W) / 2 + C2)).
  double derivatives(int y) const {
    float* d_mean = scratch.derivative(0);
    float* d_sum = scratch.derivative(1);
    float* d_difference = scratch.derivative(2);
    const Float16 half = splat16(0.5f), c1 = splat16(kC1), c2 = splat16(kC2);
    const Float8 lane = {0, 1, 2, 3, 4, 5, 6, 7};
    const Float16 lanes = join16(lane, lane + 8.0f);
    Float16 total = splat16(0.0f);
    for (int x = 0; x < images.width; x += 16) {
      const Float16 mean_s = sum_along(scratch.moment(0) + x), mean_d = sum_along(scratch.moment(1) + x);
      const Float16 S = mean_s * mean_s, D = mean_d * mean_d;
      const Float16 V = sum_along(scratch.moment(2) + x) - S, W = sum_along(scratch.moment(3) + x) - D;
      const Float16 n1 = fma16(S - D, half, c1), n2 = fma16(V - W, half, c2);
      const Float16 m1 = fma16(S + D, half, c1), m2 = fma16(V + W, half, c2);
      const Float16 inverse = 1.0f / (m1 * m2);
      const Float16 ssim = n1 * n2 * inverse, half_inverse = half * inverse;
      const Float16 half1 = m2 * half_inverse, half2 = m1 * half_inverse;  // 1 / (2 m1), 1 / (2 m2)
      const Float16 by_n1 = n2 * half_inverse, by_n2 = n1 * half_inverse;
      const Mask16 inside = less16(lanes, splat16(static_cast<float>(images.width - x)));
      const Float16 by_V = keep16(inside, fnma16(ssim, half2, by_n2));
      const Float16 by_W = keep16(inside, fnma16(ssim, half2, splat16(0.0f) - by_n2));
      const Float16 by_S = fnma16(ssim, half1, by_n1) - by_V;
      const Float16 by_D = fnma16(ssim, half1, splat16(0.0f) - by_n1) - by_W;
      store16(d_mean + x, keep16(inside, fma16(mean_s, by_S, mean_d * by_D) * 2.0f));
      store16(d_sum + x, by_V);
      store16(d_difference + x, by_W);
      total += keep16(inside, ssim);
    }
    for (int map = 0; map < 3; ++map) {
      const float* in = scratch.derivative(map);
      float* out = scratch.map(map, y);
      for (int x = 0; x < images.width; x += 16) store16(out + x, sum_along(in + x));
    }
    return sum16(total);
  }

  // One row of the derivative of the colour loss by one channel, and the sums of |d| and d^2.
  void color_gradient(int channel, int y, float weight_l1, float weight_ssim, float* plane_gradients,
                      LossTerms* terms) const {
    float* gradient = plane_gradients + channel * images.size() + images.row(y);
    Rows maps[3];
    for (int map = 0; map < 3; ++map) {
      maps[map] = rows_around(y, [&](int row) { return scratch.map(map, row); });
    }
    Float16 sum_l1 = splat16(0.0f), sum_squared = splat16(0.0f);
    for (int x = 0; x < images.width; x += 16) {
      const Float16 sum = load16(scratch.pair(0, y) + x), difference = load16(scratch.pair(1, y) + x);
      const Float16 by_moments = fma16(sum, sum_down(maps[1], x), difference * sum_down(maps[2], x));
      const Float16 ssim = fma16(by_moments, 2.0f, sum_down(maps[0], x)), sign = sign16(difference);
      const Float16 value = fnma16(ssim, splat16(weight_ssim), sign * weight_l1);
      store_pixels(gradient, x, images.width, keep16(images.counts(y, x), value));
      sum_l1 = fma16(difference, sign, sum_l1);
      sum_squared = fma16(difference, difference, sum_squared);
    }
    terms->l1 += sum16(sum_l1);
    terms->squared += sum16(sum_squared);
  }

  // The depth loss, and the derivatives by depth and opacity; the colours' must be there for the background's share.
  void depth_gradient(const LossWeights& weights, float weight, float weight_opacity, float* plane_gradients,
                      LossTerms* terms) const {
    const int width = images.width;
    const std::size_t size = images.size();
    const Float16 zero = splat16(0.0f), one = splat16(1.0f);
    for (int y = first; y < last; ++y) {
      const std::size_t row = images.row(y);
      Float16 sum_error = zero, sum_transmittance = zero;
      for (int x = 0; x < width; x += 16) {
        const Float16 target = load_pixels(images.depth + row, x, width);
        const Float16 rendered = load_pixels(images.planes + 3 * size + row, x, width);
        const Float16 opacity = load_pixels(images.planes + 4 * size + row, x, width);
        const Mask16 is_valid = less16(zero, target) & images.counts(y, x);
        const Mask16 divides = less16(splat16(weights.normalised ? kOpaqueEnough : INFINITY), opacity);
        const Float16 inverse = select16(divides, 1.0f / opacity, one);
        const Float16 error = fma16(rendered, inverse, zero - target);
        const Float16 sign = sign16(error), by_depth = keep16(is_valid, sign * weight) * inverse;
        Float16 by_opacity = keep16(is_valid, splat16(-weight_opacity));
        by_opacity -= keep16(divides, by_depth * (rendered * inverse));
        for (int c = 0; c < 3; ++c) {
          const Float16 by_color = load_pixels(plane_gradients + c * size + row, x, width);
          by_opacity = fnma16(by_color, splat16(weights.background[c]), by_opacity);
        }
        store_pixels(plane_gradients + 3 * size + row, x, width, by_depth);
        store_pixels(plane_gradients + 4 * size + row, x, width, by_opacity);
        sum_error += keep16(is_valid, error * sign);
        sum_transmittance += keep16(is_valid, one - opacity);
      }
      terms->depth += sum16(sum_error);
      terms->transmittance += sum16(sum_transmittance);
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
        band.differentiate(c, weights.background[c], weight_l1, weight_ssim, plane_gradients, &terms);
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
