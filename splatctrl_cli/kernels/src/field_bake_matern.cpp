#include <algorithm>

#include "field_bake.h"

namespace splatctrl {
namespace {

constexpr float kBlockExponent = 30.0f;  // terms this far below the largest are left out of a block at once
constexpr float kLog2e = 1.44269504f;

Float8 exp8(Float8 x) { return exp2_8(min8(max8(x * kLog2e, splat8(-126.0f)), splat8(126.0f))); }
Float8 distances(Float8 dx, Float8 dy, Float8 dz) { return sqrt8(dx * dx + dy * dy + dz * dz); }

// Terms that count in a block or sub-block, relative to its middle; offset less that of the block's reference.
struct TermList {
  std::vector<float> x, y, z, offset, sign;
  int size = 0;

  void add(float px, float py, float pz, float o, float c) {
    if (static_cast<int>(x.size()) < size + 8)
      for (auto* values : {&x, &y, &z, &offset, &sign}) values->resize(2 * size + 64);
    x[size] = px, y[size] = py, z[size] = pz, offset[size] = o, sign[size] = c;
    ++size;
  }
  // Fills up the last eight with terms of no weight.
  void pad() {
    for (int i = size; i % 8 != 0; ++i) x[i] = y[i] = z[i] = sign[i] = 0.0f, offset[i] = -1e30f;
  }
};

struct Work {
  std::vector<float> bounds, scores, turns;
  TermList block, sub_block;
};

// The largest term at the middle of a sub-block, relative to that middle.
struct Reference {
  float x, y, z, offset;
};

struct Baker {
  const Clusters& spheres;
  const Offsets& offsets;
  const double* offset;
  const float* sign;
  float length, truncation;
  const GridSpan& grid;
  float *distance, *gradient;

  void block(const int* lowest, Work& work) const {
    const Point c = middle(grid, lowest, kBlock);
    const Nearest nearest = find_nearest<LinearScore>(spheres, offsets, c, work.bounds);
    collect(c, nearest, work.block);
    for_each_sub_block(grid, lowest, [&](const int* corner) {
      const Reference r = narrow(work.block, middle_from(grid, corner, kSubBlock, c), work);
      for (int plane = 0; plane < kSubBlock && corner[0] + plane < grid.last; ++plane)
        bake_slab(work.sub_block, r, offset[nearest.entry], slab_of(grid, plane), corner, plane);
    });
  }

  void collect(Point c, Nearest nearest, TermList& list) const {
    list.size = 0;
    const int first = nearest.entry;
    const Point p0{spheres.x[first], spheres.y[first], spheres.z[first]};
    const float d0 = nearest.score + offsets.value[first], radius = grid.radius(kBlock);
    const float limit = nearest.score + kBlockExponent * length + rounding_slack(c, nearest.score);
    for (int cluster = 0; cluster < spheres.num_clusters; cluster += 8) {
      const Float8 near = box_distances(spheres, cluster, c), far = farthest_corners(spheres, cluster, p0);
      unsigned kept = signs8(near - load8(offsets.maximum + cluster) <= limit + turn(far, near, d0, radius));
      for (; kept != 0; kept &= kept - 1) {
        const int begin = kLanes * (cluster + __builtin_ctz(kept));
        for (int entry = begin; entry < begin + kLanes; entry += 8) {
          const Float8 d = center_distances(spheres, entry, c), apart = center_distances(spheres, entry, p0);
          unsigned chosen = signs8(d - load8(offsets.value + entry) <= limit + turn(apart, d, d0, radius));
          for (; chosen != 0; chosen &= chosen - 1) {
            const int i = entry + __builtin_ctz(chosen);
            list.add(spheres.x[i] - c.x, spheres.y[i] - c.y, spheres.z[i] - c.z,
                     static_cast<float>(offset[i] - offset[first]), sign == nullptr ? 1.0f : sign[i]);
          }
        }
      }
    }
    list.pad();
  }

  // The largest term at m, and those that count in the sub-block around it.
  Reference narrow(const TermList& from, Point m, Work& work) const {
    work.scores.resize(from.x.size()), work.turns.resize(from.x.size());
    float least = kFar;
    int best = 0;
    for (int i = 0; i < from.size; i += 8) {
      const Float8 d = distances(load8(&from.x[i]) - m.x, load8(&from.y[i]) - m.y, load8(&from.z[i]) - m.z);
      store8(&work.scores[i], d - load8(&from.offset[i]));
    }
    for (int i = 0; i < from.size; ++i)
      if (work.scores[i] < least) least = work.scores[i], best = i;
    const Reference r{from.x[best] - m.x, from.y[best] - m.y, from.z[best] - m.z, from.offset[best]};
    const float radius = grid.radius(kSubBlock), d0 = least + r.offset, scale = 1.0f / length;
    Float8 fewest{};
    for (int i = 0; i < from.size; i += 8) {
      const Float8 score = load8(&work.scores[i]) - least, d = score + least + load8(&from.offset[i]);
      const Float8 apart = distances(load8(&from.x[i]) - from.x[best], load8(&from.y[i]) - from.y[best], load8(&from.z[i]) - from.z[best]);
      const Float8 change = turn(apart, d, d0, radius);
      fewest += exp8((score + change) * -scale);
      store8(&work.scores[i], score - change);
    }
    const float share = truncation * std::max(1.0f, sum8(fewest)) / static_cast<float>(from.size);
    const float limit = std::min(kBlockExponent, -std::log(share)) * length + 1e-6f * std::fabs(least);
    TermList& list = work.sub_block;
    list.size = 0;
    for (int i = 0; i < from.size; ++i)
      if (work.scores[i] <= limit) list.add(from.x[i] - m.x, from.y[i] - m.y, from.z[i] - m.z, from.offset[i], from.sign[i]);
    return r;
  }

  void bake_slab(const TermList& list, const Reference& r, double common, const Slab& slab, const int* corner, int plane) const {
    float values[kLanes], slopes[3][kLanes];
    for (int h = 0; h < 2; ++h) {
      const Float8 scale = splat8(1.0f / length);
      Float8 shift = distances(splat8(slab.x - r.x), slab.y[h] - r.y, slab.z[h] - r.z) - r.offset;
      if (grid.radius(kSubBlock) > 20.0f * length) shift = least_scores(list, slab, h);
      Float8 sum{}, x{}, y{}, z{};
      for (int i = 0; i < list.size; ++i) {
        const Float8 dx = splat8(slab.x - list.x[i]), dy = slab.y[h] - list.y[i], dz = slab.z[h] - list.z[i];
        const Float8 d = distances(dx, dy, dz);
        const Float8 weight = exp8((shift - (d - list.offset[i])) * scale) * list.sign[i];
        sum += weight;
        if (gradient == nullptr) continue;
        const Float8 by_distance = weight / max8(d, splat8(1e-20f));
        x += by_distance * dx, y += by_distance * dy, z += by_distance * dz;
      }
      const Int8 has_value = sum > 0.0f;
      const Float8 none = splat8(NAN), value = shift - length * log8(sum);
      for (int k = 0; k < 8; ++k) values[8 * h + k] = has_value[k] ? static_cast<float>(value[k] - common) : NAN;
      store8(slopes[0] + 8 * h, has_value ? x / sum : none);
      store8(slopes[1] + 8 * h, has_value ? y / sum : none);
      store8(slopes[2] + 8 * h, has_value ? z / sum : none);
    }
    write_slab(grid, corner, plane, values, distance, 1);
    if (gradient == nullptr) return;
    for (int a = 0; a < 3; ++a) write_slab(grid, corner, plane, slopes[a], gradient + a, 3);
  }

  static Float8 least_scores(const TermList& list, const Slab& slab, int h) {
    Float8 least = splat8(kFar);
    for (int i = 0; i < list.size; ++i)
      least = min8(least, distances(splat8(slab.x - list.x[i]), slab.y[h] - list.y[i], slab.z[h] - list.z[i]) - list.offset[i]);
    return least;
  }
};

}  // namespace

void bake_matern(const Clusters& spheres, const Offsets& offsets, const double* offset, const float* sign, float length,
                 float truncation, const GridSpan& grid, float* distance, float* gradient) {
  const Baker baker{spheres, offsets, offset, sign, length, truncation, grid, distance, gradient};
  for_each_block<Work>(grid, [&](const int* block, Work& work) { baker.block(block, work); });
}

}  // namespace splatctrl
