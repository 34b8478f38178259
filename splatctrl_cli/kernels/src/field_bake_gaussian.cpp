#include <algorithm>

#include "field_bake.h"
#include "field_query.h"

namespace splatctrl {
namespace {

constexpr float kBlockExponent = 30.0f;  // terms this far below the largest are left out of a block at once
constexpr float kSafeExponent = 80.0f;   // factors up to e^80 either way neither over- nor underflow
constexpr float kLog2e = 1.44269504f;
constexpr int kPlane = kLanes;           // cells of a sub-block at one x

Float8 exp8(Float8 x) { return exp2_8(min8(max8(x * kLog2e, splat8(-126.0f)), splat8(126.0f))); }

// Terms that count in a block, relative to its middle; log_weight less that of the block's reference.
struct TermList {
  std::vector<float> x, y, z, log_weight, radius, sign;
  int size = 0;

  void add(const Clusters& s, const GaussianTerms& terms, int i, Point middle, double reference) {
    if (static_cast<int>(x.size()) < size + 8)
      for (auto* values : {&x, &y, &z, &log_weight, &radius, &sign}) values->resize(2 * size + 64);
    x[size] = s.x[i] - middle.x, y[size] = s.y[i] - middle.y, z[size] = s.z[i] - middle.z;
    log_weight[size] = static_cast<float>(terms.log_weight[i] - reference);
    radius[size] = terms.radius[i];
    sign[size] = terms.sign == nullptr ? 1.0f : terms.sign[i];
    ++size;
  }
  // Fills up the last eight with terms of no weight.
  void pad() {
    for (int i = size; i % 8 != 0; ++i) x[i] = y[i] = z[i] = radius[i] = sign[i] = 0.0f, log_weight[i] = -1e30f;
  }
};

// Exponents in a sub-block, less that of its reference at the same place: exponent + slope . (x - middle).
struct Exponents {
  std::vector<float> value, reach, slope_x, slope_y, slope_z;  // reach: by how much it can differ in the sub-block
  std::vector<float> x, y, z, radius, sign;                    // place and radius less the reference's
  std::vector<float> factor_x, factor_yz;                      // (4), with the sign, and (16) of each
  int size = 0;

  void reserve(int n) {
    if (static_cast<int>(value.size()) >= n) return;
    for (auto* values : {&value, &reach, &slope_x, &slope_y, &slope_z, &x, &y, &z, &radius, &sign}) values->resize(2 * n);
    factor_x.resize(2 * n * kSubBlock);
    factor_yz.resize(2 * n * kPlane);
  }
};

struct Work {
  Candidates found;
  TermList block;
  Exponents sub_block;
};

// The largest term at the middle of a sub-block, relative to that middle.
struct Reference {
  float x, y, z, radius;
  double log_weight;
};

// Sums over the terms at 16 cells: of the weights, and of weight times radius; first moments of both for the gradient.
struct Sums {
  Float8 weight[2] = {}, radius[2] = {}, first[3][2] = {}, second[3][2] = {};
  Float8 shift[2] = {}, base[2] = {};  // what was taken off the exponents, and off the radii
};

struct Baker {
  const Clusters& spheres;
  const Offsets& offsets;
  const GaussianTerms& terms;
  float length, tolerance;
  const GridSpan& grid;
  float *distance, *gradient;
  float largest_radius;  // where terms have signs, a mean radius beyond it has no distance

  float unit() const { return 2.0f * length * length; }

  void block(const int* lowest, Work& work) const {
    const Point c = middle(grid, lowest, kBlock);
    const Nearest nearest = find_nearest<SquaredScore>(spheres, offsets, c, work.found);
    const double reference = terms.log_weight[nearest.entry];
    collect(c, nearest, reference, work.block);
    for_each_sub_block(grid, lowest, [&](const int* corner) {
      const Reference r = refer(work.block, middle_from(grid, corner, kSubBlock, c), reference, work.sub_block);
      const bool is_safe = narrow(r, work.sub_block);
      if (is_safe) factor(work.sub_block);
      for (int plane = 0; plane < kSubBlock && corner[0] + plane < grid.last; ++plane) {
        const Slab slab = slab_of(grid, plane);
        Sums sums;
        if (is_safe)
          add_factored(work.sub_block, plane, sums);
        else
          add_each(work.sub_block, slab, sums);
        finish(r, slab, sums, corner, plane);
      }
    });
  }

  // q_i(x) - q_0(x) changes by at most 2 R |p_i - p_0| over the block.
  void collect(Point c, Nearest nearest, double reference, TermList& list) const {
    list.size = 0;
    const Point p0{spheres.x[nearest.entry], spheres.y[nearest.entry], spheres.z[nearest.entry]};
    const float twice_radius = 2.0f * grid.radius(kBlock);
    const float limit = nearest.score + kBlockExponent * unit() + rounding_slack(c, nearest.score);
    for (int cluster = 0; cluster < spheres.num_clusters; cluster += 8) {
      const Float8 near = box_distances(spheres, cluster, c), far = farthest_corners(spheres, cluster, p0);
      unsigned kept = signs8(near * near - load8(offsets.maximum + cluster) <= limit + twice_radius * far);
      for (; kept != 0; kept &= kept - 1) {
        const int begin = kLanes * (cluster + __builtin_ctz(kept));
        for (int entry = begin; entry < begin + kLanes; entry += 8) {
          const Float8 d = center_distances(spheres, entry, c), apart = center_distances(spheres, entry, p0);
          unsigned chosen = signs8(d * d - load8(offsets.value + entry) <= limit + twice_radius * apart);
          for (; chosen != 0; chosen &= chosen - 1) list.add(spheres, terms, entry + __builtin_ctz(chosen), c, reference);
        }
      }
    }
    list.pad();
  }

  // The largest term at m, and every term's exponent less its.
  Reference refer(const TermList& list, Point m, double block_reference, Exponents& out) const {
    out.reserve(list.size + 8);
    float least = kFar;
    int best = 0;
    for (int i = 0; i < list.size; i += 8) {
      const Float8 dx = load8(&list.x[i]) - m.x, dy = load8(&list.y[i]) - m.y, dz = load8(&list.z[i]) - m.z;
      store8(&out.value[i], dx * dx + dy * dy + dz * dz - unit() * load8(&list.log_weight[i]));
    }
    for (int i = 0; i < list.size; ++i)
      if (out.value[i] < least) least = out.value[i], best = i;
    const Reference r{list.x[best] - m.x, list.y[best] - m.y, list.z[best] - m.z, list.radius[best],
                      block_reference + list.log_weight[best]};
    const float scale = 1.0f / length, half = 0.5f * (kSubBlock - 1) * static_cast<float>(grid.voxel) * 1.000001f;
    const float weight = list.log_weight[best];
    for (int i = 0; i < list.size; i += 8) {
      const Float8 x = load8(&list.x[i]) - list.x[best], y = load8(&list.y[i]) - list.y[best], z = load8(&list.z[i]) - list.z[best];
      const Float8 along = ((r.x + 0.5f * x) * x + (r.y + 0.5f * y) * y + (r.z + 0.5f * z) * z) * -scale;  // times l
      const Float8 sx = x * scale, sy = y * scale, sz = z * scale;
      store8(&out.value[i], along * scale + (load8(&list.log_weight[i]) - weight));
      store8(&out.reach[i], (max8(sx, -sx) + max8(sy, -sy) + max8(sz, -sz)) * (half * scale));
      store8(&out.slope_x[i], sx * scale), store8(&out.slope_y[i], sy * scale), store8(&out.slope_z[i], sz * scale);
      store8(&out.x[i], x), store8(&out.y[i], y), store8(&out.z[i], z);
      store8(&out.radius[i], load8(&list.radius[i]) - r.radius), store8(&out.sign[i], load8(&list.sign[i]));
    }
    out.size = list.size;
    return r;
  }

  // Leaves out what cannot raise the distance by more than the tolerance; true where no factor can overflow.
  bool narrow(const Reference& r, Exponents& e) const {
    Float8 most{}, fewest{};
    for (int i = 0; i < e.size; i += 8) {
      const Float8 value = load8(&e.value[i]), reach = load8(&e.reach[i]);
      most += exp8(value + reach), fewest += exp8(value - reach);
    }
    const float d = std::max(0.0f, std::sqrt(r.x * r.x + r.y * r.y + r.z * r.z) - grid.radius(kSubBlock));
    const double squared = d * d - unit() * (r.log_weight + std::log(static_cast<double>(sum8(most))));
    const float nearest = squared > 0.0 ? static_cast<float>(std::sqrt(squared)) : 0.0f;
    const float share = gaussian_log_share(nearest, tolerance, length) * std::max(1.0f, sum8(fewest));
    const float limit = std::max(-kBlockExponent, std::log(share / static_cast<float>(e.size)));
    bool is_safe = true;
    int n = 0;
    for (int i = 0; i < e.size; ++i) {
      if (!(e.value[i] + e.reach[i] >= limit)) continue;
      is_safe = is_safe && std::fabs(e.value[i]) + e.reach[i] < kSafeExponent;
      for (auto* values : {&e.value, &e.slope_x, &e.slope_y, &e.slope_z, &e.x, &e.y, &e.z, &e.radius, &e.sign})
        (*values)[n] = (*values)[i];
      ++n;
    }
    e.size = n;
    return is_safe;
  }

  // Each term over the sub-block is a product of three factors.
  void factor(Exponents& e) const {
    const auto voxel = static_cast<float>(grid.voxel);
    const Float8 steps = voxel * Float8{-1.5f, -0.5f, 0.5f, 1.5f, -1.5f, -0.5f, 0.5f, 1.5f};
    for (int i = 0; i < e.size; ++i) {
      Float8 slope;
      for (int k = 0; k < 8; ++k) slope[k] = k < 4 ? e.slope_x[i] : e.slope_y[i];
      const Float8 xy = exp8(steps * slope + Float8{1, 1, 1, 1, 0, 0, 0, 0} * e.value[i]);
      const Float8 z = exp8(steps * e.slope_z[i]);
      for (int k = 0; k < kSubBlock; ++k) e.factor_x[kSubBlock * i + k] = xy[k] * e.sign[i];
      const Float8 low = __builtin_shufflevector(xy, xy, 4, 4, 4, 4, 5, 5, 5, 5);
      const Float8 high = __builtin_shufflevector(xy, xy, 6, 6, 6, 6, 7, 7, 7, 7);
      store8(&e.factor_yz[kPlane * i], low * z);
      store8(&e.factor_yz[kPlane * i + 8], high * z);
    }
  }

  void add(const Exponents& e, int i, int h, Float8 weight, Sums& sums) const {
    const Float8 by_radius = weight * (e.radius[i] - sums.base[h]);
    sums.weight[h] += weight;
    sums.radius[h] += by_radius;
    if (gradient == nullptr) return;
    sums.first[0][h] += weight * e.x[i], sums.second[0][h] += by_radius * e.x[i];
    sums.first[1][h] += weight * e.y[i], sums.second[1][h] += by_radius * e.y[i];
    sums.first[2][h] += weight * e.z[i], sums.second[2][h] += by_radius * e.z[i];
  }

  void add_factored(const Exponents& e, int plane, Sums& sums) const {
    for (int i = 0; i < e.size; ++i) {
      const float along_x = e.factor_x[kSubBlock * i + plane];
      for (int h = 0; h < 2; ++h) add(e, i, h, along_x * load8(&e.factor_yz[kPlane * i + 8 * h]), sums);
    }
  }

  void add_each(const Exponents& e, const Slab& slab, Sums& sums) const {
    const auto exponent = [&](int i, int h) {
      return e.value[i] + e.slope_x[i] * slab.x + e.slope_y[i] * slab.y[h] + e.slope_z[i] * slab.z[h];
    };
    for (int h = 0; h < 2; ++h) {
      for (int i = 0; i < e.size; ++i) {
        const Float8 other = exponent(i, h);
        sums.base[h] = other > sums.shift[h] ? splat8(e.radius[i]) : sums.base[h];
        sums.shift[h] = max8(sums.shift[h], other);
      }
      for (int i = 0; i < e.size; ++i) add(e, i, h, exp8(exponent(i, h) - sums.shift[h]) * e.sign[i], sums);
    }
  }

  void finish(const Reference& r, const Slab& slab, const Sums& sums, const int* corner, int plane) const {
    float values[kPlane], slopes[3][kPlane];
    const auto constant = static_cast<float>(unit() * r.log_weight);
    for (int h = 0; h < 2; ++h) {
      const Float8 inverse = 1.0f / sums.weight[h], radius = sums.radius[h] * inverse;
      const Float8 dx = splat8(slab.x - r.x), dy = slab.y[h] - r.y, dz = slab.z[h] - r.z;
      const Float8 squared = dx * dx + dy * dy + dz * dz - constant - unit() * (sums.shift[h] + log8(sums.weight[h]));
      const Float8 root = sqrt8(squared);
      const Float8 mean_radius = r.radius + sums.base[h] + radius, limit = splat8(1.001f * largest_radius);
      const Int8 has_value = (root > 0.0f) & (sums.weight[h] > 0.0f) & (max8(mean_radius, -mean_radius) <= limit);  // not NaN
      const Float8 none = splat8(NAN);
      store8(values + 8 * h, has_value ? root - mean_radius : none);
      if (gradient == nullptr) continue;
      const Float8 to_cell[3] = {dx, dy, dz};
      for (int a = 0; a < 3; ++a) {  // mean of x - p, and of (r - mean r)(x - p)
        const Float8 mean = sums.first[a][h] * inverse;
        const Float8 turn = (radius * mean - sums.second[a][h] * inverse) * (1.0f / length) * (1.0f / length);
        store8(slopes[a] + 8 * h, has_value ? (to_cell[a] - mean) / root + turn : none);
      }
    }
    write_slab(grid, corner, plane, values, distance, 1);
    if (gradient == nullptr) return;
    for (int a = 0; a < 3; ++a) write_slab(grid, corner, plane, slopes[a], gradient + a, 3);
  }
};

}  // namespace

void bake_gaussian(const Clusters& spheres, const Offsets& offsets, const GaussianTerms& terms, float length,
                   float tolerance, const GridSpan& grid, float* distance, float* gradient) {
  const float largest = terms.sign == nullptr ? kFar : largest_of(terms.radius, kLanes * spheres.num_clusters);
  const Baker baker{spheres, offsets, terms, length, tolerance, grid, distance, gradient, largest};
  for_each_block<Work>(grid, [&](const int* block, Work& work) { baker.block(block, work); });
}

}  // namespace splatctrl
