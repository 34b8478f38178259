#include "raster.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "parallel.h"
#include "simd.h"

namespace splatctrl {
namespace {

// The smallest d^T conic d over a rectangle, with d measured from the footprint's mean. Exact: zero inside, else
// the least of the four edges.
float least_over_rectangle(const Footprint& f, float x0, float x1, float y0, float y1) {
  if (x0 <= 0.0f && x1 >= 0.0f && y0 <= 0.0f && y1 >= 0.0f) return 0.0f;
  const auto form = [&f](float x, float y) { return f.a * x * x + 2.0f * f.b * x * y + f.c * y * y; };
  float least = INFINITY;
  for (const float x : {x0, x1}) least = std::min(least, form(x, std::clamp(-f.b * x / f.c, y0, y1)));
  for (const float y : {y0, y1}) least = std::min(least, form(std::clamp(-f.b * y / f.a, x0, x1), y));
  return least;
}

struct TileRange {
  int x0, x1, y0, y1;  // inclusive
};

TileRange tiles_of(const Footprint& f, int tiles_x, int tiles_y) {
  const auto tile = [](float pixel, int count) {
    return std::clamp(static_cast<int>(std::floor(pixel / kTile)), 0, count - 1);
  };
  return {tile(f.u - f.half_width, tiles_x), tile(f.u + f.half_width, tiles_x),
          tile(f.v - f.half_height, tiles_y), tile(f.v + f.half_height, tiles_y)};
}

bool meets_tile(const Footprint& f, int tx, int ty) {
  const float x0 = tx * kTile - f.u, y0 = ty * kTile - f.v;
  return least_over_rectangle(f, x0, x0 + kTile - 1, y0, y0 + kTile - 1) <= f.level * 1.0001f;
}

// The pixels of one row of a tile that a footprint can reach: d^T conic d <= level, as an interval of columns.
struct RowReach {
  float low, high;
};

struct RowShape {
  float inv_a, slope, discriminant_level, discriminant_slope;
  explicit RowShape(const Footprint& f)
      : inv_a(1.0f / f.a), slope(-f.b / f.a), discriminant_level(f.level / f.a),
        discriminant_slope(f.b * f.b / (f.a * f.a) - f.c / f.a) {}
  bool reach(float dy, RowReach* out) const {
    const float discriminant = discriminant_level + discriminant_slope * dy * dy;
    if (discriminant < 0.0f) return false;
    const float half = std::sqrt(discriminant) + 0.01f;  // [px] more than rounding can take away
    out->low = slope * dy - half;
    out->high = slope * dy + half;
    return true;
  }
};

const Float8 kLanes = {0, 1, 2, 3, 4, 5, 6, 7};
constexpr int kGroups = kTile / 8;

// Which pixels of a tile lie in the image: all bits set, or none.
void clip_to_image(const Camera& camera, int x0, int y0, Int8 live[kTile][kGroups]) {
  for (int row = 0; row < kTile; ++row) {
    for (int group = 0; group < kGroups; ++group) {
      const Float8 x = kLanes + static_cast<float>(x0 + 8 * group);
      const Int8 inside = x < splat8(static_cast<float>(camera.width));
      live[row][group] = y0 + row < camera.height ? inside : Int8{};
    }
  }
}

bool any_live(const Int8 live[kTile][kGroups]) {
  Int8 any{};
  for (int row = 0; row < kTile; ++row) {
    for (int group = 0; group < kGroups; ++group) any |= live[row][group];
  }
  return any8(any);
}

// One footprint on eight pixels of a row: what forward and backward both compute.
struct Blend {
  Float8 gaussian_alpha;  // alpha * G, before the clamp
  Float8 alpha;           // clamped
  Float8 weight;          // alpha * transmittance, 0 where nothing is blended
  Float8 next;            // transmittance behind
  Int8 blended;
};

inline Blend blend(const Footprint& f, Float8 dx, float dy, Float8 transmittance, Int8* live) {
  Blend out;
  const Float8 power = dx * (dx * (-0.5f * f.a) - f.b * dy) - 0.5f * f.c * dy * dy;
  out.gaussian_alpha = exp8(power) * f.opacity;
  out.alpha = min8(out.gaussian_alpha, splat8(kMaxAlpha));
  const Float8 next = transmittance * (1.0f - out.alpha);
  const Int8 seen = (out.alpha >= splat8(kMinAlpha)) & *live;
  const Int8 is_last = seen & (next < splat8(kMinTransmittance));
  *live &= ~is_last;
  out.blended = seen & ~is_last;
  out.weight = out.blended ? out.alpha * transmittance : Float8{};
  out.next = out.blended ? next : transmittance;
  return out;
}

// Tile images are copied row by row, so that the last tile of a row need not be whole.
void load_row(const float* plane, const Camera& camera, int x0, int y, Float8 out[kGroups]) {
  alignas(32) float row[kTile] = {};
  if (y < camera.height) {
    const int count = std::min(kTile, camera.width - x0);
    std::memcpy(row, plane + static_cast<std::size_t>(y) * camera.width + x0, count * sizeof(float));
  }
  for (int group = 0; group < kGroups; ++group) out[group] = load8(row + 8 * group);
}

void store_row(float* plane, const Camera& camera, int x0, int y, const Float8 in[kGroups]) {
  if (y >= camera.height) return;
  alignas(32) float row[kTile];
  for (int group = 0; group < kGroups; ++group) store8(row + 8 * group, in[group]);
  const int count = std::min(kTile, camera.width - x0);
  std::memcpy(plane + static_cast<std::size_t>(y) * camera.width + x0, row, count * sizeof(float));
}

}  // namespace

void Rasteriser::prepare(const Camera& camera, int num_splats, const float* centers, const float* radii,
                         const float* opacities, const float* colors, int num_threads) {
  const Projection project = [&](int first, int last, Footprint* footprints, std::uint8_t* visible) {
    for (int i = first; i < last; ++i) {
      visible[i] = project_isotropic(camera, centers + 3 * i, radii[i], opacities[i], &footprints[i]);
    }
  };
  prepare(camera, num_splats, project, colors, num_threads);
}

void Rasteriser::prepare(const Camera& camera, int num_splats, const Projection& project, const float* colors,
                         int num_threads) {
  camera_ = camera;
  num_splats_ = num_splats;
  colors_ = colors;
  tiles_x_ = (camera.width + kTile - 1) / kTile;
  tiles_y_ = (camera.height + kTile - 1) / kTile;
  footprints_.resize(num_splats);
  visible_.assign(num_splats, 0);
  constexpr int kChunk = 1024;
  parallel_for((num_splats + kChunk - 1) / kChunk, num_threads, [&](int chunk) {
    project(chunk * kChunk, std::min(num_splats, (chunk + 1) * kChunk), footprints_.data(), visible_.data());
  });
  sort_by_depth();
  fill_tiles();
}

void Rasteriser::sort_by_depth() {
  order_.clear();
  for (int i = 0; i < num_splats_; ++i) {
    if (!visible_[i]) continue;
    std::uint32_t bits;  // positive floats order as their bits do
    std::memcpy(&bits, &footprints_[i].depth, sizeof bits);
    order_.push_back(static_cast<std::uint64_t>(bits) << 32 | static_cast<std::uint32_t>(i));
  }
  std::sort(order_.begin(), order_.end());
}

void Rasteriser::fill_tiles() {
  const int num_tiles = tiles_x_ * tiles_y_;
  tile_start_.assign(num_tiles + 1, 0);
  const auto each_tile = [this](int splat, auto&& visit) {
    const Footprint& f = footprints_[splat];
    const TileRange range = tiles_of(f, tiles_x_, tiles_y_);
    for (int ty = range.y0; ty <= range.y1; ++ty) {
      for (int tx = range.x0; tx <= range.x1; ++tx) {
        if (meets_tile(f, tx, ty)) visit(ty * tiles_x_ + tx);
      }
    }
  };
  for (const std::uint64_t key : order_) {
    each_tile(static_cast<int>(key & 0xffffffffu), [this](int tile) { ++tile_start_[tile + 1]; });
  }
  for (int tile = 0; tile < num_tiles; ++tile) tile_start_[tile + 1] += tile_start_[tile];
  tile_splats_.resize(tile_start_[num_tiles]);
  tile_cursor_.assign(tile_start_.begin(), tile_start_.end() - 1);
  for (const std::uint64_t key : order_) {
    const int splat = static_cast<int>(key & 0xffffffffu);
    bool on_some_tile = false;
    each_tile(splat, [&](int tile) {
      tile_splats_[tile_cursor_[tile]++] = splat;
      on_some_tile = true;
    });
    visible_[splat] = on_some_tile;
  }
}

void Rasteriser::forward(float* planes, int num_threads) {
  parallel_for(tiles_x_ * tiles_y_, num_threads, [&](int tile) { forward_tile(tile, planes); });
}

void Rasteriser::forward_tile(int tile, float* planes) const {
  const int x0 = tile % tiles_x_ * kTile, y0 = tile / tiles_x_ * kTile;
  const std::size_t plane_size = static_cast<std::size_t>(camera_.width) * camera_.height;
  Float8 sums[4][kTile][kGroups] = {};  // red, green, blue, depth
  Float8 transmittance[kTile][kGroups];
  Int8 live[kTile][kGroups];
  std::fill_n(&transmittance[0][0], kTile * kGroups, splat8(1.0f));
  clip_to_image(camera_, x0, y0, live);
  for (int k = tile_start_[tile]; k < tile_start_[tile + 1]; ++k) {
    if ((k - tile_start_[tile]) % 8 == 7 && !any_live(live)) break;
    const Footprint& f = footprints_[tile_splats_[k]];
    const float* color = colors_ + 3 * static_cast<std::size_t>(tile_splats_[k]);
    const RowShape shape(f);
    for (int row = 0; row < kTile; ++row) {
      const float dy = static_cast<float>(y0 + row) - f.v;
      RowReach reach;
      if (!shape.reach(dy, &reach)) continue;
      for (int group = 0; group < kGroups; ++group) {
        const float first = static_cast<float>(x0 + 8 * group) - f.u;
        if (first > reach.high || first + 7.0f < reach.low) continue;
        const Blend b = blend(f, kLanes + first, dy, transmittance[row][group], &live[row][group]);
        transmittance[row][group] = b.next;
        for (int channel = 0; channel < 3; ++channel) sums[channel][row][group] += b.weight * color[channel];
        sums[3][row][group] += b.weight * f.depth;
      }
    }
  }
  for (int row = 0; row < kTile; ++row) {
    for (int plane = 0; plane < 4; ++plane) {
      store_row(planes + plane * plane_size, camera_, x0, y0 + row, sums[plane][row]);
    }
    Float8 opacity[kGroups];
    for (int group = 0; group < kGroups; ++group) opacity[group] = 1.0f - transmittance[row][group];
    store_row(planes + 4 * plane_size, camera_, x0, y0 + row, opacity);
  }
}

void Rasteriser::backward(const float* planes, const float* plane_gradients, SplatGradient* gradients,
                          int num_threads) {
  instances_.resize(tile_splats_.size());
  parallel_for(tiles_x_ * tiles_y_, num_threads,
               [&](int tile) { backward_tile(tile, planes, plane_gradients); });
  std::memset(static_cast<void*>(gradients), 0, sizeof(SplatGradient) * num_splats_);
  constexpr int kFloats = sizeof(SplatGradient) / sizeof(float);
  for (std::size_t k = 0; k < tile_splats_.size(); ++k) {  // tile by tile: one order, whatever the threads did
    float sum[kFloats], part[kFloats];
    std::memcpy(sum, &gradients[tile_splats_[k]], sizeof sum);
    std::memcpy(part, &instances_[k], sizeof part);
    for (int j = 0; j < kFloats; ++j) sum[j] += part[j];
    std::memcpy(static_cast<void*>(&gradients[tile_splats_[k]]), sum, sizeof sum);
  }
}

// Front to back again. With f_i = c_i . gC + d_i gD + gA and F the same product of the finished pixel,
// dL/dalpha_i = T_i f_i - (F - sum_{j<=i} w_j f_j) / (1 - alpha_i): no division by a vanishing transmittance.
void Rasteriser::backward_tile(int tile, const float* planes, const float* plane_gradients) {
  const int x0 = tile % tiles_x_ * kTile, y0 = tile / tiles_x_ * kTile;
  const std::size_t plane_size = static_cast<std::size_t>(camera_.width) * camera_.height;
  Float8 g[kNumPlanes][kTile][kGroups];
  Float8 rest[kTile][kGroups] = {};  // F minus what has been blended so far
  Float8 transmittance[kTile][kGroups];
  Int8 live[kTile][kGroups];
  std::fill_n(&transmittance[0][0], kTile * kGroups, splat8(1.0f));
  clip_to_image(camera_, x0, y0, live);
  for (int plane = 0; plane < kNumPlanes; ++plane) {
    for (int row = 0; row < kTile; ++row) {
      Float8 value[kGroups];
      load_row(planes + plane * plane_size, camera_, x0, y0 + row, value);
      load_row(plane_gradients + plane * plane_size, camera_, x0, y0 + row, g[plane][row]);
      for (int group = 0; group < kGroups; ++group) rest[row][group] += value[group] * g[plane][row][group];
    }
  }
  for (int k = tile_start_[tile]; k < tile_start_[tile + 1]; ++k) {
    SplatGradient& out = instances_[k];
    if ((k - tile_start_[tile]) % 8 == 7 && !any_live(live)) {
      std::memset(static_cast<void*>(&instances_[k]), 0, sizeof(SplatGradient) * (tile_start_[tile + 1] - k));
      break;
    }
    const Footprint& f = footprints_[tile_splats_[k]];
    const float* color = colors_ + 3 * static_cast<std::size_t>(tile_splats_[k]);
    const RowShape shape(f);
    // Sums over the rows, lane by lane: dx is the same in every row of a lane. s = dL/d(power).
    Float8 s_1[kGroups] = {}, s_y[kGroups] = {}, s_yy[kGroups] = {}, w_plane[4] = {};
    for (int row = 0; row < kTile; ++row) {
      const float dy = static_cast<float>(y0 + row) - f.v;
      RowReach reach;
      if (!shape.reach(dy, &reach)) continue;
      for (int group = 0; group < kGroups; ++group) {
        const float first = static_cast<float>(x0 + 8 * group) - f.u;
        if (first > reach.high || first + 7.0f < reach.low) continue;
        const Float8 before = transmittance[row][group];
        const Blend b = blend(f, kLanes + first, dy, before, &live[row][group]);
        transmittance[row][group] = b.next;
        const Float8 value = g[0][row][group] * color[0] + g[1][row][group] * color[1] +
                             g[2][row][group] * color[2] + g[3][row][group] * f.depth + g[4][row][group];
        rest[row][group] -= b.weight * value;
        const Float8 g_alpha = before * value - rest[row][group] / (1.0f - b.alpha);
        const Int8 moves = b.blended & (b.gaussian_alpha < splat8(kMaxAlpha));
        const Float8 s = moves ? g_alpha * b.alpha : Float8{};
        s_1[group] += s;
        s_y[group] += s * dy;
        s_yy[group] += s * (dy * dy);
        for (int plane = 0; plane < 4; ++plane) w_plane[plane] += b.weight * g[plane][row][group];
      }
    }
    float m_1 = 0, m_x = 0, m_y = 0, m_xx = 0, m_xy = 0, m_yy = 0;
    for (int group = 0; group < kGroups; ++group) {
      const Float8 dx = kLanes + (static_cast<float>(x0 + 8 * group) - f.u);
      m_1 += sum8(s_1[group]);
      m_x += sum8(s_1[group] * dx);
      m_xx += sum8(s_1[group] * dx * dx);
      m_y += sum8(s_y[group]);
      m_xy += sum8(s_y[group] * dx);
      m_yy += sum8(s_yy[group]);
    }
    out.footprint.u = f.a * m_x + f.b * m_y;
    out.footprint.v = f.b * m_x + f.c * m_y;
    out.footprint.a = -0.5f * m_xx;
    out.footprint.b = -m_xy;
    out.footprint.c = -0.5f * m_yy;
    out.footprint.depth = sum8(w_plane[3]);
    out.footprint.opacity = m_1 / f.opacity;
    for (int channel = 0; channel < 3; ++channel) out.color[channel] = sum8(w_plane[channel]);
  }
}

}  // namespace splatctrl
