#include "raster_tile.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "simd16.h"

namespace splatctrl {
namespace {

constexpr int kSide = 4;  // [px] of a block: a pixel for each lane
constexpr int kAcross = kTileWidth / kSide, kDown = kTileHeight / kSide, kBlocks = kAcross * kDown;
constexpr int kGroup = kPrefetch;  // entries between two looks at which blocks are still alive
constexpr float kFirst = -0.5f * (kSide - 1);  // [px] of a block's first pixel from its centre
constexpr float kReachSlack = 0.01f;           // of log2(alpha G): more than rounding can take away
static_assert(kSide * kSide == 16 && kBlocks == 16, "a lane for each pixel of a block, and for each block of a tile");

// The lanes as a square of 4 x 4, `step` apart from `first` on: the column and the row of each.
Float16 columns16(float first, float step) {
  const Float8 two = Float8{0, 1, 2, 3, 0, 1, 2, 3} * step + first;
  return join16(two, two);
}
Float16 rows16(float first, float step) {
  const Float8 upper = {0, 0, 0, 0, 1, 1, 1, 1};
  return join16(upper * step + first, upper * step + (first + 2.0f * step));
}

// log2(alpha G) of a splat on a tile: a quadratic about each block's centre, (dx, dy) from the splat's mean.
struct Exponent {
  Float16 dx, dy, value, by_x, by_y;  // a lane for each block
  Float16 quadratic;                  // a lane for each pixel of a block

  Exponent(const TileSplat& s, const TileImage& image) {
    dx = columns16(-kFirst, kSide) + (static_cast<float>(image.x0) - s.u);
    dy = rows16(-kFirst, kSide) + (static_cast<float>(image.y0) - s.v);
    by_x = fma16(dy, s.xy, dx * (2.0f * s.xx));
    by_y = fma16(dx, s.xy, dy * (2.0f * s.yy));
    value = fma16(fma16(by_x, dx, by_y * dy), 0.5f, s.log2_opacity);
    const Float16 x = columns16(kFirst, 1.0f), y = rows16(kFirst, 1.0f);
    quadratic = fma16(x * x, s.xx, fma16(x * y, s.xy, y * y * s.yy));
  }

  // The blocks that hold a pixel with a contribution of kMinAlpha, and few more: being concave, it is nowhere above the
  // plane that touches it at a block's centre.
  BlockMask reach() const {
    const Float16 most = fma16(abs16(by_x) + abs16(by_y), -kFirst, value);
    return static_cast<BlockMask>(bits16(at_least16(most, splat16(kLog2MinAlpha - kReachSlack))));
  }
};

// For eight bits, as bytes: the numbers of those that are set, in order, then zeros.
struct SetBits {
  std::uint64_t bytes[256] = {};
  constexpr SetBits() {
    for (unsigned mask = 0; mask < 256; ++mask) {
      for (unsigned bit = 0, count = 0; bit < 8; ++bit) {
        if (mask >> bit & 1u) bytes[mask] |= static_cast<std::uint64_t>(bit) << (8 * count++);
      }
    }
  }
};
constexpr SetBits kSetBits;

// Entries of a tile's list that are worked on together, first all exponents, then all alphas, then the blending: in one
// loop, each visit would wait for all that the one before waits for. A visit is an entry on a block: 16 entry + block.
struct Group {
  alignas(64) float value[kGroup * kBlocks], by_x[kGroup * kBlocks], by_y[kGroup * kBlocks];
  alignas(64) float dx[kGroup * kBlocks], dy[kGroup * kBlocks];
  Float16 quadratic[kGroup];
  float features[kGroup][4];
  std::uint8_t visits[(kGroup + 1) * kBlocks];
  int num_visits = 0;
  Float16 alpha[kGroup * kBlocks];  // of each visit; 0 where there is nothing to blend

  void put(int entry, const TileSplat& s, const Exponent& e, unsigned reach) {
    store16(value + kBlocks * entry, e.value);
    store16(by_x + kBlocks * entry, e.by_x);
    store16(by_y + kBlocks * entry, e.by_y);
    store16(dx + kBlocks * entry, e.dx);
    store16(dy + kBlocks * entry, e.dy);
    quadratic[entry] = e.quadratic;
    std::copy(s.features, s.features + 4, features[entry]);
    for (int half = 0; half < 2; ++half) {
      const unsigned mask = reach >> (8 * half) & 0xffu;
      const std::uint64_t bytes = kSetBits.bytes[mask] + 0x0101010101010101u * (kBlocks * entry + 8 * half);
      std::memcpy(visits + num_visits, &bytes, sizeof bytes);
      num_visits += __builtin_popcount(mask);
    }
  }

  void make_alphas() {
    const Float16 x = columns16(kFirst, 1.0f), y = rows16(kFirst, 1.0f);
    for (int k = 0; k < num_visits; ++k) {
      const int visit = visits[k];
      const Float16 square = quadratic[visit / kBlocks] + value[visit];
      const Float16 power = fma16(x, by_x[visit], fma16(y, by_y[visit], square));
      alpha[k] = keep16(at_least16(power, splat16(kLog2MinAlpha)), exp2_16(min16(power, splat16(kLog2MaxAlpha))));
    }
  }
};

// Sixteen rows of sixteen pixels as blocks, and back; fetches what lies beside them, the next tile.
void load_rows(const float* rows, std::size_t stride, Float16* blocks) {
  for (int k = 0; k < kDown; ++k, rows += kSide * stride) {
    for (int row = 0; row < kSide; ++row) __builtin_prefetch(rows + row * stride + kTileWidth);
    for (int half = 0; half < 2; ++half) {
      const float* from = rows + 8 * half;
      const Float8 a = load8(from), b = load8(from + stride);
      const Float8 c = load8(from + 2 * stride), d = load8(from + 3 * stride);
      Float16* to = blocks + kAcross * k + 2 * half;
      to[0] = join16(__builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11),
                     __builtin_shufflevector(c, d, 0, 1, 2, 3, 8, 9, 10, 11));
      to[1] = join16(__builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15),
                     __builtin_shufflevector(c, d, 4, 5, 6, 7, 12, 13, 14, 15));
    }
  }
}

void store_rows(const Float16* blocks, std::size_t stride, float* rows) {
  for (int k = 0; k < kDown; ++k, rows += kSide * stride) {
    for (int row = 0; row < kSide; ++row) __builtin_prefetch(rows + row * stride + kTileWidth, 1);
    for (int half = 0; half < 2; ++half) {
      const Float16 left = blocks[kAcross * k + 2 * half], right = blocks[kAcross * k + 2 * half + 1];
      float* to = rows + 8 * half;
      const Float8 l = low8(left), r = low8(right), m = high8(left), n = high8(right);
      store8(to, __builtin_shufflevector(l, r, 0, 1, 2, 3, 8, 9, 10, 11));
      store8(to + stride, __builtin_shufflevector(l, r, 4, 5, 6, 7, 12, 13, 14, 15));
      store8(to + 2 * stride, __builtin_shufflevector(m, n, 0, 1, 2, 3, 8, 9, 10, 11));
      store8(to + 3 * stride, __builtin_shufflevector(m, n, 4, 5, 6, 7, 12, 13, 14, 15));
    }
  }
}

// The part of a tile that lies in the image; `at` is the offset of its corner in a plane.
struct Inside {
  int width, height;
  std::size_t at;
  explicit Inside(const TileImage& image)
      : width(std::min(kTileWidth, image.width - image.x0)), height(std::min(kTileHeight, image.height - image.y0)),
        at(static_cast<std::size_t>(image.y0) * image.width + image.x0) {}
  bool is_whole() const { return width == kTileWidth && height == kTileHeight; }
};

// A tile of a plane, block by block; 0 beyond the image.
void load_blocks(const TileImage& image, const float* plane, Float16* blocks) {
  const Inside inside(image);
  plane += inside.at;
  if (inside.is_whole()) return load_rows(plane, image.width, blocks);
  alignas(64) float tile[kTileHeight * kTileWidth] = {};
  for (int y = 0; y < inside.height; ++y, plane += image.width) {
    std::copy(plane, plane + inside.width, tile + kTileWidth * y);
  }
  load_rows(tile, kTileWidth, blocks);
}

void store_blocks(const TileImage& image, const Float16* blocks, float* plane) {
  const Inside inside(image);
  plane += inside.at;
  if (inside.is_whole()) return store_rows(blocks, image.width, plane);
  alignas(64) float tile[kTileHeight * kTileWidth];
  store_rows(blocks, kTileWidth, tile);
  for (int y = 0; y < inside.height; ++y, plane += image.width) {
    std::copy(tile + kTileWidth * y, tile + kTileWidth * y + inside.width, plane);
  }
}

// What is left of the light behind each pixel; negative where nothing more is blended.
struct Transmittance {
  Float16 block[kBlocks];

  explicit Transmittance(const TileImage& image) {
    for (int i = 0; i < kBlocks; ++i) {
      const Float16 x = columns16(static_cast<float>(image.x0 + kSide * (i % kAcross)), 1.0f);
      const Float16 y = rows16(static_cast<float>(image.y0 + kSide * (i / kAcross)), 1.0f);
      const Mask16 is_inside = less16(x, splat16(static_cast<float>(image.width))) &
                               less16(y, splat16(static_cast<float>(image.height)));
      block[i] = select16(is_inside, splat16(1.0f), splat16(-1.0f));
    }
  }

  // The weight alpha T on block i; alpha becomes 0 where the light is used up, T what is left behind it.
  Float16 blend(int i, Float16* alpha) {
    const Float16 before = block[i], next = fnma16(before, *alpha, before);
    const Mask16 ends = less16(next, splat16(kMinTransmittance));
    *alpha = keep16(not16(ends), *alpha);
    block[i] = select16(ends, negate_abs16(before), next);
    return *alpha * before;
  }

  BlockMask alive() const {
    unsigned mask = 0;
    for (int i = 0; i < kBlocks; ++i) mask |= static_cast<unsigned>(bits16(negative16(block[i])) != 0xffffu) << i;
    return static_cast<BlockMask>(mask);
  }
};

// The loss's derivatives by the planes, and what is left of the sum over the splats of
// w_i f_i, f_i = c_i . gC + d_i gD + gA: at first the finished pixel, then without what has been blended so far.
struct Upstream {
  Float16 gradient[kNumPlanes][kBlocks];
  Float16 rest[kBlocks];

  Upstream(const TileImage& image, const float* planes, const float* plane_gradients) {
    for (int i = 0; i < kBlocks; ++i) rest[i] = splat16(0.0f);
    for (int k = 0; k < kNumPlanes; ++k) {
      Float16 plane[kBlocks];
      load_blocks(image, planes + k * image.plane(), plane);
      load_blocks(image, plane_gradients + k * image.plane(), gradient[k]);
      for (int i = 0; i < kBlocks; ++i) rest[i] = fma16(gradient[k][i], plane[i], rest[i]);
    }
  }
};

}  // namespace

void tile_forward(const TileImage& image, const TileSplat* splats, TileEntry* first, TileEntry* last,
                  float* planes) {
  Float16 sums[4][kBlocks];
  for (auto& plane : sums) std::fill_n(plane, kBlocks, splat16(0.0f));
  Transmittance transmittance(image);
  for (; first < last; first += kGroup) {
    const int count = static_cast<int>(std::min<std::ptrdiff_t>(kGroup, last - first));
    const BlockMask alive = transmittance.alive();
    if (alive == 0) break;
    Group group;
    for (int k = 0; k < count; ++k) {
      __builtin_prefetch(&splats[first[k + kPrefetch].rank]);
      const TileSplat& s = splats[first[k].rank];
      const Exponent exponent(s, image);
      first[k].reach = exponent.reach() & alive;
      group.put(k, s, exponent, first[k].reach);
    }
    group.make_alphas();
    for (int k = 0; k < group.num_visits; ++k) {
      const int visit = group.visits[k], i = visit % kBlocks;
      Float16 alpha = group.alpha[k];
      const Float16 weight = transmittance.blend(i, &alpha);
      const float* features = group.features[visit / kBlocks];
      for (int c = 0; c < 4; ++c) sums[c][i] = fma16(weight, features[c], sums[c][i]);
    }
  }
  for (int k = 0; k < 4; ++k) store_blocks(image, sums[k], planes + k * image.plane());
  for (Float16& left : transmittance.block) left = 1.0f - abs16(left);
  store_blocks(image, transmittance.block, planes + 4 * image.plane());
}

namespace {

// dL/d(ln alpha G) of a group's visits, and their weights.
//
// dL/dalpha_i = T_i f_i - (rest without w_i f_i) / (1 - alpha_i): front to back again, and no division by a vanishing
// transmittance.
struct VisitGradients {
  Float16 power[kGroup * kBlocks], weight[kGroup * kBlocks];

  VisitGradients(const Group& group, Upstream* upstream, Transmittance* transmittance) {
    const Float16 most = exp2_16(splat16(kLog2MaxAlpha));
    for (int k = 0; k < group.num_visits; ++k) {
      const int visit = group.visits[k], i = visit % kBlocks;
      const float* features = group.features[visit / kBlocks];
      const Mask16 is_free = less16(group.alpha[k], most);
      Float16 alpha = group.alpha[k];
      weight[k] = transmittance->blend(i, &alpha);
      Float16 value = upstream->gradient[4][i];
      for (int c = 0; c < 4; ++c) value = fma16(upstream->gradient[c][i], features[c], value);
      const Float16 own = weight[k] * value, behind = upstream->rest[i] - own;
      upstream->rest[i] = behind;
      power[k] = keep16(is_free, fnma16(behind, alpha / (1.0f - alpha), own));
    }
  }
};

// Adds the visits of one entry up over the pixels: the weights times the planes' gradients, and the moments of the
// derivative by the power.
void sum_up(const TileSplat& s, const Group& group, const VisitGradients& gradients, const Upstream& upstream,
            int first, int last, SplatGradient* out) {
  const Float16 zero = splat16(0.0f);
  Float16 by_feature[4] = {zero, zero, zero, zero}, m_1 = zero, m_x = zero, m_y = zero, m_xx = zero, m_xy = zero,
          m_yy = zero;
  for (int k = first; k < last; ++k) {
    const int visit = group.visits[k], i = visit % kBlocks;
    for (int c = 0; c < 4; ++c) by_feature[c] = fma16(gradients.weight[k], upstream.gradient[c][i], by_feature[c]);
  }
  for (int k = first; k < last; ++k) {
    const float dx = group.dx[group.visits[k]], dy = group.dy[group.visits[k]];
    const Float16 g = gradients.power[k], g_x = g * dx, g_y = g * dy;
    m_1 += g;
    m_x += g_x;
    m_y += g_y;
    m_xx = fma16(g_x, dx, m_xx);
    m_xy = fma16(g_x, dy, m_xy);
    m_yy = fma16(g_y, dy, m_yy);
  }
  // From the blocks' centres to their pixels.
  const Float16 x = columns16(kFirst, 1.0f), y = rows16(kFirst, 1.0f), one_x = m_1 * x, one_y = m_1 * y;
  m_xx = fma16(fma16(m_x, 2.0f, one_x), x, m_xx);
  m_xy = fma16(m_y, x, fma16(m_x + one_x, y, m_xy));
  m_yy = fma16(fma16(m_y, 2.0f, one_y), y, m_yy);
  m_x += one_x;
  m_y += one_y;
  const Float8 eight[8] = {fold16(by_feature[0]), fold16(by_feature[1]), fold16(by_feature[2]), fold16(by_feature[3]),
                           fold16(m_x), fold16(m_y), fold16(m_xx), fold16(m_yy)};
  const Float8 sum = sums8(eight);
  const float a = s.xx * (-2.0f / kLog2E), b = s.xy * (-1.0f / kLog2E), c = s.yy * (-2.0f / kLog2E);
  out->footprint = {a * sum[4] + b * sum[5], b * sum[4] + c * sum[5], -0.5f * sum[6],
                    -sum8(fold16(m_xy)),     -0.5f * sum[7],          sum[3],
                    sum8(fold16(m_1)) / s.opacity};
  for (int k = 0; k < 3; ++k) out->color[k] = sum[k];
}

}  // namespace

void tile_backward(const TileImage& image, const TileSplat* splats, const TileEntry* first, const TileEntry* last,
                   const float* planes, const float* plane_gradients, SplatGradient* parts) {
  Upstream upstream(image, planes, plane_gradients);
  Transmittance transmittance(image);
  for (; first < last; first += kGroup) {
    const int count = static_cast<int>(std::min<std::ptrdiff_t>(kGroup, last - first));
    Group group;
    for (int k = 0; k < count; ++k) {
      __builtin_prefetch(&splats[first[k + kPrefetch].rank]);
      __builtin_prefetch(&parts[first[k + kPrefetch].part], 1);
      const TileSplat& s = splats[first[k].rank];
      if (first[k].reach != 0) group.put(k, s, Exponent(s, image), first[k].reach);
    }
    group.make_alphas();
    const VisitGradients visits(group, &upstream, &transmittance);
    for (int k = 0, visit = 0; k < count; ++k) {
      const int next = visit + __builtin_popcount(first[k].reach);
      SplatGradient* out = &parts[first[k].part];
      if (next == visit) std::memset(static_cast<void*>(out), 0, sizeof *out);
      else sum_up(splats[first[k].rank], group, visits, upstream, visit, next, out);
      visit = next;
    }
  }
}

}  // namespace splatctrl
