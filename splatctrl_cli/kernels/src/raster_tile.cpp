#include "raster_tile.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "simd.h"

namespace splatctrl {
namespace {

constexpr int kGroups = kTileWidth / 8, kBands = kTileHeight / 8;
constexpr int kStrips = kGroups * kTileHeight;
constexpr int kCheckEvery = 8;  // entries between two looks at which strips are still alive
const Float8 kLanes = {0, 1, 2, 3, 4, 5, 6, 7};
static_assert(kStrips <= 32, "a StripMask has one bit for each strip");
constexpr StripMask kColumn = kTileHeight == 32 ? ~0u : (1u << kTileHeight) - 1u;  // the strips of one column

Float8 columns_from(const TileSplat& s, int x) { return kLanes + (static_cast<float>(x) - s.u); }

// The rows of a tile as a footprint sees them.
struct Rows {
  alignas(32) float dy[kTileHeight];
  alignas(32) float yy[kTileHeight];  // the exponent's part in dy^2

  Rows(const TileSplat& s, int y0) {
    for (int band = 0; band < kBands; ++band) {
      const Float8 y = kLanes + (static_cast<float>(y0 + 8 * band) - s.v);
      store8(dy + 8 * band, y);
      store8(yy + 8 * band, y * y * s.yy);
    }
  }
};

// The strips that hold a pixel with d^T conic d <= level: in each row, an interval of columns.
StripMask reach(const TileSplat& s, const Rows& rows, int x0) {
  StripMask mask = 0;
  for (int band = 0; band < kBands; ++band) {
    const Float8 dy = load8(rows.dy + 8 * band);
    const Float8 half2 = dy * dy * s.half2_slope + s.half2_level;
    const Float8 half = sqrt8(max8(half2, Float8{})) + kReachMargin;
    const Float8 low = dy * s.slope - half, high = dy * s.slope + half;
    for (int group = 0; group < kGroups; ++group) {
      const float first = static_cast<float>(x0 + 8 * group) - s.u;
      const Int8 meets = (half2 >= 0.0f) & (low <= first + 7.0f) & (high >= first);
      mask |= signs8(meets) << (group * kTileHeight + 8 * band);
    }
  }
  return mask;
}

// What is left of the light behind each pixel; negative where nothing more is blended.
struct Transmittance {
  Float8 strip[kStrips];

  explicit Transmittance(const TileImage& image) {
    for (int i = 0; i < kStrips; ++i) {
      const int x = image.x0 + 8 * (i / kTileHeight), y = image.y0 + i % kTileHeight;
      const float in_row = y < image.height ? 1.0f : -1.0f;
      strip[i] = kLanes + static_cast<float>(x) < static_cast<float>(image.width) ? splat8(in_row) : splat8(-1.0f);
    }
  }

  StripMask alive() const {
    StripMask mask = 0;
    for (int i = 0; i < kStrips; ++i) mask |= static_cast<StripMask>(signs8((Int8)strip[i]) != 0xffu) << i;
    return mask;
  }
};

// One splat on the strips it reaches, in order. Its alphas are made before anything is blended: in one loop with the
// blending, a strip would have to wait for all that its own exponential waits for.
struct Stroke {
  int count = 0;
  std::uint8_t strip[kStrips];
  Float8 power[kStrips];  // log2(alpha G), before the clamp
  Float8 alpha[kStrips];  // 0 where there is nothing to blend

  Stroke(const TileSplat& s, const Rows& rows, int x0, StripMask mask) {
    Float8 power_1[kGroups], power_y[kGroups];
    for (int group = 0; group < kGroups; ++group) {
      const Float8 dx = columns_from(s, x0 + 8 * group);
      power_1[group] = dx * dx * s.xx + s.log2_opacity;
      power_y[group] = dx * s.xy;
    }
    for (; mask != 0; mask &= mask - 1) strip[count++] = static_cast<std::uint8_t>(__builtin_ctz(mask));
    for (int j = 0; j < count; ++j) {
      const int group = strip[j] / kTileHeight, row = strip[j] % kTileHeight;
      power[j] = power_y[group] * rows.dy[row] + (power_1[group] + rows.yy[row]);
      alpha[j] = keep8(power[j] >= kLog2MinAlpha, exp2_8(min8(power[j], splat8(kLog2MaxAlpha))));
    }
  }

  // The weight alpha T of its j-th strip; alpha becomes 0 where the light is used up, T what is left behind it.
  Float8 blend(int j, Transmittance* transmittance) {
    const Float8 before = transmittance->strip[strip[j]];
    const Float8 next = before - before * alpha[j];
    const Int8 ends = next < kMinTransmittance;
    alpha[j] = keep8(~ends, alpha[j]);
    transmittance->strip[strip[j]] = ends ? (Float8)((Int8)before | INT32_MIN) : next;
    return alpha[j] * before;
  }
};

Float8 load_pixels(const float* row, int num_left) {
  if (num_left >= 8) return load8(row);
  alignas(32) float values[8] = {};
  std::copy(row, row + std::max(num_left, 0), values);
  return load8(values);
}

void store_pixels(float* row, int num_left, Float8 in) {
  if (num_left >= 8) return store8(row, in);
  alignas(32) float values[8];
  store8(values, in);
  std::copy(values, values + std::max(num_left, 0), row);
}

// Calls visit(strip, its offset in a plane, its number of pixels in the image, 8 or more if whole).
template <class Visit>
void each_strip(const TileImage& image, Visit&& visit) {
  for (int i = 0; i < kStrips; ++i) {
    const int x = image.x0 + 8 * (i / kTileHeight), y = image.y0 + i % kTileHeight;
    if (y < image.height) visit(i, static_cast<std::size_t>(y) * image.width + x, image.width - x);
  }
}

// The loss's derivatives by the planes, and what is left of the sum over the splats of
// w_i f_i, f_i = c_i . gC + d_i gD + gA: at first the finished pixel, then without what has been blended so far.
struct Upstream {
  Float8 gradient[kStrips][kNumPlanes];
  Float8 rest[kStrips];

  Upstream(const TileImage& image, const float* planes, const float* plane_gradients) : gradient{}, rest{} {
    each_strip(image, [&](int i, std::size_t at, int num_left) {
      for (int plane = 0; plane < kNumPlanes; ++plane, at += image.plane()) {
        gradient[i][plane] = load_pixels(plane_gradients + at, num_left);
        rest[i] += gradient[i][plane] * load_pixels(planes + at, num_left);
      }
    });
  }
};

// dL/d(ln alpha G) of a splat on its strips, and its weights.
struct StrokeGradient {
  Float8 power[kStrips], weight[kStrips];

  // dL/dalpha_i = T_i f_i - (rest without w_i f_i) / (1 - alpha_i): front to back again, and no division by a
  // vanishing transmittance.
  StrokeGradient(const TileSplat& s, Stroke* stroke, Upstream* upstream, Transmittance* transmittance) {
    for (int j = 0; j < stroke->count; ++j) {
      const int i = stroke->strip[j];
      weight[j] = stroke->blend(j, transmittance);
      Float8 value = upstream->gradient[i][4];
      for (int k = 0; k < 4; ++k) value += upstream->gradient[i][k] * s.features[k];
      const Float8 behind = upstream->rest[i] - weight[j] * value;
      upstream->rest[i] = behind;
      const Float8 g = weight[j] * value - behind * (stroke->alpha[j] / (1.0f - stroke->alpha[j]));
      power[j] = keep8(stroke->power[j] < kLog2MaxAlpha, g);
    }
  }
};

}  // namespace

void tile_forward(const TileImage& image, const TileSplat* splats, TileEntry* first, TileEntry* last,
                  float* planes) {
  Float8 sums[kStrips][4] = {};
  Transmittance transmittance(image);
  StripMask alive = transmittance.alive();
  for (TileEntry* entry = first; entry != last; ++entry) {
    if ((entry - first) % kCheckEvery == kCheckEvery - 1) alive = transmittance.alive();
    entry->reach = 0;
    if (alive == 0) continue;
    __builtin_prefetch(&splats[entry[kPrefetch].rank]);
    const TileSplat& s = splats[entry->rank];
    const Rows rows(s, image.y0);
    entry->reach = reach(s, rows, image.x0) & alive;
    Stroke stroke(s, rows, image.x0, entry->reach);
    for (int j = 0; j < stroke.count; ++j) {
      const Float8 weight = stroke.blend(j, &transmittance);
      for (int k = 0; k < 4; ++k) sums[stroke.strip[j]][k] += weight * s.features[k];
    }
  }
  each_strip(image, [&](int i, std::size_t at, int num_left) {
    for (int k = 0; k < 4; ++k, at += image.plane()) store_pixels(planes + at, num_left, sums[i][k]);
    store_pixels(planes + at, num_left, 1.0f - (Float8)((Int8)transmittance.strip[i] & INT32_MAX));
  });
}

namespace {

// Sums over the pixels: of the weights times the planes' gradients, and the moments of the power's derivative.
void sum_up(const TileSplat& s, const Rows& rows, int x0, const Stroke& stroke, const StrokeGradient& gradient,
            const Upstream& upstream, StripMask mask, SplatGradient* out) {
  Float8 by_feature[4] = {}, m_1{}, m_x{}, m_y{}, m_xx{}, m_xy{}, m_yy{};
  for (int j = 0, group = 0; group < kGroups; ++group) {
    const Float8 dx = columns_from(s, x0 + 8 * group);
    Float8 t_1{}, t_y{}, t_yy{};  // dx is the same in all strips of a column
    for (const int last = j + __builtin_popcount(mask >> (group * kTileHeight) & kColumn); j < last; ++j) {
      const int i = stroke.strip[j];
      const float dy = rows.dy[i % kTileHeight];
      t_1 += gradient.power[j];
      t_y += gradient.power[j] * dy;
      t_yy += gradient.power[j] * (dy * dy);
      for (int k = 0; k < 4; ++k) by_feature[k] += gradient.weight[j] * upstream.gradient[i][k];
    }
    m_1 += t_1;
    m_x += t_1 * dx;
    m_xx += t_1 * dx * dx;
    m_y += t_y;
    m_xy += t_y * dx;
    m_yy += t_yy;
  }
  const Float8 eight[8] = {by_feature[0], by_feature[1], by_feature[2], by_feature[3], m_x, m_y, m_xx, m_yy};
  const Float8 sum = sums8(eight);
  const float a = s.xx * (-2.0f / kLog2E), b = s.xy * (-1.0f / kLog2E), c = s.yy * (-2.0f / kLog2E);
  out->footprint = {a * sum[4] + b * sum[5], b * sum[4] + c * sum[5], -0.5f * sum[6],       -sum8(m_xy),
                    -0.5f * sum[7],          sum[3],                  sum8(m_1) / s.opacity};
  for (int k = 0; k < 3; ++k) out->color[k] = sum[k];
}

}  // namespace

void tile_backward(const TileImage& image, const TileSplat* splats, const TileEntry* first, const TileEntry* last,
                   const float* planes, const float* plane_gradients, SplatGradient* parts) {
  Upstream upstream(image, planes, plane_gradients);
  Transmittance transmittance(image);
  for (const TileEntry* entry = first; entry != last; ++entry) {
    SplatGradient* out = &parts[entry->part];
    __builtin_prefetch(&splats[entry[kPrefetch].rank]);
    __builtin_prefetch(&parts[entry[kPrefetch].part], 1);
    if (entry->reach == 0) {
      std::memset(static_cast<void*>(out), 0, sizeof *out);
      continue;
    }
    const TileSplat& s = splats[entry->rank];
    const Rows rows(s, image.y0);
    Stroke stroke(s, rows, image.x0, entry->reach);
    const StrokeGradient gradient(s, &stroke, &upstream, &transmittance);
    sum_up(s, rows, image.x0, stroke, gradient, upstream, entry->reach, out);
  }
}

}  // namespace splatctrl
