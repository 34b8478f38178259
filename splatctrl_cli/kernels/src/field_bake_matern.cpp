#include <algorithm>

#include "field_bake.h"
#include "field_groups.h"

namespace splatctrl {
namespace {

constexpr float kBlockExponent = 30.0f;  // terms this far below the largest are left out of a block at once
constexpr float kLog2e = 1.44269504f;
constexpr float kSteep = 20.0f;          // exponents that a sub-block may span with one reference
constexpr float kSmallTurn = 0.06f;      // four terms of the exponential of this are off by 5e-7

Float8 exp8(Float8 x) { return exp2_8(min8(max8(x * kLog2e, splat8(-126.0f)), splat8(126.0f))); }
Float8 distances(Float8 dx, Float8 dy, Float8 dz) { return sqrt8(dx * dx + dy * dy + dz * dz); }

struct Work {
  Candidates found;
  std::vector<float> scores[2], weights;
  Terms block, members, near;
};

// The largest term at the middle of a block or sub-block, relative to that middle.
struct Reference {
  float x, y, z, offset;
};

// The weights of the terms by how far they are below the reference's, in exponents.
struct Masses {
  static constexpr int kBins = 128;
  static constexpr float kWidth = 0.25f;
  float fewest;         // the sum of all weights, at least
  float of_bin[kBins];  // of each bin, at most

  static int bin(float exponent) {
    const float place = exponent / kWidth;
    return place < 0.0f ? 0 : place < kBins - 1 ? static_cast<int>(place) : kBins - 1;
  }
  // What lies beyond makes up no more than `share` of the sum.
  float limit(float share) const {
    float beyond = 0.0f;
    int last = kBins;
    while (last > 1 && beyond + of_bin[last - 1] <= share * std::max(1.0f, fewest)) beyond += of_bin[--last];
    return last == kBins ? kFar : kWidth * static_cast<float>(last);
  }
};

// Sums over the terms at eight cells: weights, their errors, and the gradient's numerators.
struct Sums {
  Float8 weight, error, x, y, z;
};

// Eight columns of cells, 2 x 4 of them: places in the frame of the terms, of the columns and of their lowest cells.
struct Columns {
  int lowest[3];
  Float8 x, y;
  float z;
};

struct Baker {
  const Clusters& spheres;
  const Offsets& offsets;
  const double* offset;
  const float* sign;
  float length, truncation;
  const GridSpan& grid;
  const Groups groups;
  float *distance, *gradient;

  void block(const int* lowest, Work& work) const {
    const Point c = middle(grid, lowest, kBlock);
    const Nearest nearest = find_nearest<LinearScore>(spheres, offsets, c, work.found);
    const double common = offset[nearest.entry];
    const float gap = collect(c, nearest, work.block) - grid.radius(kBlock);
    if (is_smooth(gap, kBlock)) {
      if (bake_far(work.block, lowest, common, work)) return;
      expand(work.block, c, common, work.members);
      bake_far(work.members, lowest, common, work);
      return;
    }
    for_each_sub_block(grid, lowest, [&](const int* corner) {
      const bool as_parabolas = is_smooth(gap, kSubBlock);
      if (bake_near(work.block, corner, c, common, as_parabolas, work)) return;
      expand(work.block, c, common, work.members);
      bake_near(work.members, corner, c, common, as_parabolas, work);
    });
  }

  // True where a distance of at least `gap` is a parabola along so many cells, to a quarter of the truncation: what is
  // left of its third order beside the best line (a quarter of it), and the fourth.
  bool is_smooth(float gap, int cells) const {
    const float half = 0.5f * static_cast<float>((cells - 1) * grid.voxel), ratio = half / gap;
    if (!(gap > 0.0f) || grid.radius(cells) > kSteep * length) return false;
    if (grid.voxel * grid.voxel > kSmallTurn * gap * length) return false;
    return (0.0482f + 0.125f * ratio) * ratio * ratio * half <= 0.25f * truncation * length;
  }

  // Groups that may be taken together from here, and the spheres of the others; returns the distance to the nearest.
  float collect(Point c, Nearest nearest, Terms& terms) const {
    terms.clear(spheres);
    const int first = nearest.entry;
    const Point p0{spheres.x[first], spheres.y[first], spheres.z[first]};
    const float d0 = nearest.score + offsets.value[first], radius = grid.radius(kBlock);
    const float limit = nearest.score + kBlockExponent * length + rounding_slack(c, nearest.score);
    float gap = kFar;
    for (int cluster = 0; cluster < spheres.num_clusters; cluster += 8) {
      const Float8 near = box_distances(spheres, cluster, c), far = farthest_corners(spheres, cluster, p0);
      unsigned kept = signs8(near - load8(offsets.maximum + cluster) <= limit + turn(far, near, d0, radius));
      for (; kept != 0; kept &= kept - 1) {
        const int k = __builtin_ctz(kept);
        gap = std::min(gap, near[k]);
        add_cluster(cluster + k, c, nearest.score, offset[first], terms);
      }
    }
    terms.pad();
    return gap;
  }

  void add_cluster(int cluster, Point c, float least, double common, Terms& terms) const {
    if (is_alike(groups.of_16[cluster], c, least)) return add_group(groups.of_16[cluster], c, common, terms);
    for (int k = 4 * cluster; k < 4 * (cluster + 1); ++k)
      if (is_alike(groups.of_4[k], c, least))
        add_group(groups.of_4[k], c, common, terms);
      else
        add_members(groups.of_4[k], c, common, terms);
  }

  // A guess, which the error of the view confirms or not: are the third cumulant of a group and the curvature of its
  // correction small beside what its share can be?
  bool is_alike(const Group& g, Point c, float least) const {
    if (sign != nullptr || g.count < 2) return false;
    const float dx = c.x - g.place[0], dy = c.y - g.place[1], dz = c.z - g.place[2];
    const float d = std::sqrt(dx * dx + dy * dy + dz * dz), around = grid.radius(kSubBlock), near = d - around - g.radius;
    if (!(near > 2.0f * g.radius)) return false;
    const float spread = (g.extent[0] * std::fabs(dx) + g.extent[1] * std::fabs(dy) + g.extent[2] * std::fabs(dz)) / d;
    const float half = (std::min(spread, g.radius) + g.radius * around / d) / length, seen = around / (near * length);
    const float trace = g.covariance[0] + g.covariance[3] + g.covariance[5];
    const float room = 0.5f * (d - static_cast<float>(g.offset) - least - 0.5f * grid.radius(kBlock)) / length;
    const float error = 0.1284f * half * half * half + 1.5f * trace * seen * seen;
    return error <= 0.2f * truncation * std::exp(std::min(std::max(room, 0.0f), 8.0f));
  }

  void add_group(const Group& g, Point c, double common, Terms& terms) const {
    terms.grouped.add(g, g.place[0] - c.x, g.place[1] - c.y, g.place[2] - c.z, static_cast<float>(g.offset - common));
  }

  void add_members(const Group& g, Point c, double common, Terms& terms) const {
    for (int i = g.begin; i < g.begin + g.count; ++i)
      terms.single.add(spheres.x[i] - c.x, spheres.y[i] - c.y, spheres.z[i] - c.z, static_cast<float>(offset[i] - common),
                       sign == nullptr ? 1.0f : sign[i]);
  }

  // The spheres of every group of `from`.
  void expand(const Terms& from, Point c, double common, Terms& terms) const {
    terms.clear(spheres);
    const TermList& s = from.single;
    for (int i = 0; i < s.size; ++i) terms.single.add(s.x[i], s.y[i], s.z[i], s.offset[i], s.sign[i]);
    for (int i = 0; i < from.grouped.size; ++i) add_members(*from.grouped.group[i], c, common, terms);
    terms.pad();
  }

  // A block far from everything: its columns at once. False where groups would cost more than a quarter of the truncation.
  bool bake_far(const Terms& from, const int* lowest, double common, Work& work) const {
    const auto voxel = static_cast<float>(grid.voxel);
    const Reference r = narrow(from, {0.0f, 0.0f, 0.0f}, grid.radius(kBlock), work);
    Terms& terms = work.near;
    for (int i = 0; i < kBlock && lowest[0] + i < grid.last; i += kSubBlock)
      for (int j = 0; j < kBlock && lowest[1] + j < grid.size[1]; j += kSubBlock) {
        const Point m{voxel * (static_cast<float>(i) - 2.0f), voxel * (static_cast<float>(j) - 2.0f), 0.0f};
        terms.grouped.view(m, radius_of(kBlock), length);
        for (int h = 0; h < 2; ++h) {
          const Columns columns = columns_at({lowest[0] + i, lowest[1] + j, lowest[2]}, m, h, kBlock);
          if (!bake_parabolas<kBlock>(terms, r, m, columns, common)) return false;
        }
      }
    return true;
  }

  template <int kCells>
  bool bake_parabolas(const Terms& terms, const Reference& r, Point m, const Columns& columns, double common) const {
    Sums sums[kCells] = {};
    const Float8 shift = distances(columns.x - r.x, columns.y - r.y, splat8(r.z)) - r.offset;
    if (gradient == nullptr) {
      add_parabolas<kCells, false, false>(terms.single.size, terms, m, columns, shift, sums);
      add_parabolas<kCells, true, false>(terms.grouped.size, terms, m, columns, shift, sums);
    } else {
      add_parabolas<kCells, false, true>(terms.single.size, terms, m, columns, shift, sums);
      add_parabolas<kCells, true, true>(terms.grouped.size, terms, m, columns, shift, sums);
    }
    for (int k = 0; k < kCells; ++k)
      if (!write(columns, k, shift, sums[k], common)) return false;
    return true;
  }

  bool bake_near(const Terms& from, const int* lowest, Point c, double common, bool as_parabolas, Work& work) const {
    const float radius = grid.radius(kSubBlock);
    const Reference r = narrow(from, middle_from(grid, lowest, kSubBlock, c), radius, work);
    Terms& terms = work.near;
    const Point m{0.0f, 0.0f, 0.0f};
    terms.grouped.view(m, radius, length);
    for (int h = 0; h < 2; ++h) {
      const Columns columns = columns_at({lowest[0], lowest[1], lowest[2]}, m, h, kSubBlock);
      if (as_parabolas) {
        if (!bake_parabolas<kSubBlock>(terms, r, m, columns, common)) return false;
        continue;
      }
      for (int k = 0; k < kSubBlock; ++k) {
        const float z = columns.z + static_cast<float>(k * grid.voxel);
        Float8 shift = distances(columns.x - r.x, columns.y - r.y, splat8(z - r.z)) - r.offset;
        if (radius > kSteep * length) shift = least_scores(terms.single, columns, z);
        Sums sums{};
        add_each<false>(terms.single.size, terms, shift, columns, z, sums);
        add_each<true>(terms.grouped.size, terms, shift, columns, z, sums);
        if (!write(columns, k, shift, sums, common)) return false;
      }
    }
    return true;
  }

  // Half the diagonal of 4 x 4 columns of so many cells.
  float radius_of(int cells) const {
    const auto b = static_cast<float>(cells - 1);
    return 0.500001f * static_cast<float>(grid.voxel) * std::sqrt(18.0f + b * b);
  }

  // Half h of 4 x 4 columns around m, of so many cells.
  Columns columns_at(std::initializer_list<int> lowest, Point m, int h, int cells) const {
    const auto voxel = static_cast<float>(grid.voxel);
    Columns columns;
    std::copy_n(lowest.begin(), 3, columns.lowest);
    columns.lowest[0] += 2 * h;
    for (int k = 0; k < 8; ++k) {
      columns.x[k] = m.x + voxel * (static_cast<float>(2 * h + k / 4) - 1.5f);
      columns.y[k] = m.y + voxel * (static_cast<float>(k % 4) - 1.5f);
    }
    columns.z = m.z - 0.5f * voxel * static_cast<float>(cells - 1);
    return columns;
  }

  // The largest term at m, and into work.near, relative to m, those that count within `around` of it.
  Reference narrow(const Terms& from, Point m, float around, Work& work) const {
    Reference r{0.0f, 0.0f, 0.0f, 0.0f};
    float least = kFar;
    score(from.single, m, work.scores[0], least, r);
    score(from.grouped, m, work.scores[1], least, r);
    Masses masses{};
    widen(from.single, m, around, r, least, work.scores[0], work.weights, masses);
    widen(from.grouped, m, around, r, least, work.scores[1], work.weights, masses);
    const float limit = masses.limit(0.5f * truncation) * length + 1e-6f * std::fabs(least);
    work.near.clear(spheres);
    const TermList& s = from.single;
    for (int i = 0; i < s.size; ++i)
      if (work.scores[0][i] <= limit) work.near.single.add(s.x[i] - m.x, s.y[i] - m.y, s.z[i] - m.z, s.offset[i], s.sign[i]);
    const GroupList& g = from.grouped;
    for (int i = 0; i < g.size; ++i)
      if (work.scores[1][i] <= limit) work.near.grouped.add(*g.group[i], g.x[i] - m.x, g.y[i] - m.y, g.z[i] - m.z, g.offset[i]);
    work.near.pad();
    return r;
  }

  template <typename List>
  static void score(const List& list, Point m, std::vector<float>& scores, float& least, Reference& r) {
    scores.resize(list.x.size());
    Float8 lowest = splat8(least);
    for (int i = 0; i < list.size; i += 8) {
      const Float8 d = distances(load8(&list.x[i]) - m.x, load8(&list.y[i]) - m.y, load8(&list.z[i]) - m.z);
      const Float8 value = d - load8(&list.offset[i]);
      store8(&scores[i], value);
      lowest = min8(lowest, value);
    }
    for (int k = 0; k < 8; ++k)
      if (lowest[k] < least) least = lowest[k], r.offset = NAN;
    if (!std::isnan(r.offset)) return;
    const int i = static_cast<int>(std::find(scores.begin(), scores.begin() + list.size, least) - scores.begin());
    r = {list.x[i] - m.x, list.y[i] - m.y, list.z[i] - m.z, list.offset[i]};
  }

  // Lowers the scores to what they can be above the reference's within `around` of m, and adds up the weights.
  template <typename List>
  void widen(const List& list, Point m, float around, const Reference& r, float least, std::vector<float>& scores,
             std::vector<float>& weights, Masses& masses) const {
    const float d0 = least + r.offset, scale = 1.0f / length;
    Float8 fewest{};
    weights.resize(scores.size());
    for (int i = 0; i < list.size; i += 8) {
      const Float8 above = load8(&scores[i]) - least, d = above + least + load8(&list.offset[i]);
      const Float8 apart = distances(load8(&list.x[i]) - m.x - r.x, load8(&list.y[i]) - m.y - r.y, load8(&list.z[i]) - m.z - r.z);
      const Float8 change = turn(apart, d, d0, around);
      fewest += exp8((above + change) * -scale);
      store8(&scores[i], above - change);
      store8(&weights[i], exp8((above - change) * -scale));
    }
    masses.fewest += sum8(fewest);
    for (int i = 0; i < list.size; ++i) masses.of_bin[Masses::bin(scores[i] * scale)] += weights[i];
  }

  // Adds the terms at eight cells of height z.
  template <bool kGroups>
  void add_each(int size, const Terms& terms, Float8 shift, const Columns& columns, float z, Sums& sums) const {
    const auto& list = terms.list<kGroups>();
    const float scale = 1.0f / length;
    for (int i = 0; i < size; ++i) {
      const Float8 dx = columns.x - list.x[i], dy = columns.y - list.y[i], dz = splat8(z - list.z[i]);
      const Float8 d = distances(dx, dy, dz);
      Float8 o = splat8(list.offset[i]);
      if constexpr (kGroups) o += list.seen_offset[i] + list.slope[0][i] * columns.x + list.slope[1][i] * columns.y + list.slope[2][i] * z;
      Float8 weight = exp8((shift - (d - o)) * scale);
      if constexpr (!kGroups) weight *= list.sign[i];
      add_weight<kGroups>(list, i, weight, sums);
      if (gradient != nullptr) add_slope<kGroups>(list, i, weight, dx, dy, dz, 1.0f / max8(d, splat8(1e-20f)), sums);
    }
  }

  template <bool kGroups, typename List>
  static void add_weight(const List& list, int i, Float8 weight, Sums& sums) {
    sums.weight += weight;
    if constexpr (kGroups) sums.error += weight * list.error[i];
  }

  template <bool kGroups, typename List>
  static void add_slope(const List& list, int i, Float8 weight, Float8 dx, Float8 dy, Float8 dz, Float8 inverse, Sums& sums) {
    const Float8 by_distance = weight * inverse;
    sums.x += by_distance * dx, sums.y += by_distance * dy, sums.z += by_distance * dz;
    if constexpr (kGroups)
      sums.x -= weight * list.slope[0][i], sums.y -= weight * list.slope[1][i], sums.z -= weight * list.slope[2][i];
  }

  // Adds the terms at all cells of eight columns: along z a distance is d + a z + b z^2 / 2, so that the weight of a cell
  // is that of the one below times a ratio, which itself changes by one ratio.
  template <int kCells, bool kGroups, bool kGradient>
  void add_parabolas(int size, const Terms& terms, Point m, const Columns& columns, Float8 shift, Sums* sums) const {
    const auto& list = terms.list<kGroups>();
    const auto voxel = static_cast<float>(grid.voxel);
    const float scale = 1.0f / length, half = -columns.z;
    const Float8 x = columns.x - m.x, y = columns.y - m.y;
    Sums total[kCells];
    std::copy_n(sums, kCells, total);
    for (int i = 0; i < size; ++i) {
      const Float8 dx = columns.x - list.x[i], dy = columns.y - list.y[i];
      const float dz = -list.z[i];
      const Float8 squared = dx * dx + dy * dy + dz * dz, d = sqrt8(squared), inverse = 1.0f / d;
      const Float8 along = dz * inverse, curve = (1.0f - along * along) * inverse;
      // The third order of the distance is followed by the line that is nearest to it.
      Float8 slope = along - (0.375f * half * half) * along * curve * inverse, o = splat8(list.offset[i]);
      if constexpr (kGroups) slope -= list.slope[2][i], o += list.seen_offset[i] + list.slope[0][i] * x + list.slope[1][i] * y;
      Float8 weight = exp8((shift - d + o + half * slope - (0.5f * half * half) * curve) * scale);
      if constexpr (!kGroups) weight *= list.sign[i];
      Float8 ratio = exp2_8(((half - 0.5f * voxel) * curve - slope) * (voxel * scale * kLog2e));
      const Float8 turn = curve * (-voxel * voxel * scale), change = 1.0f + turn * (1.0f + turn * (0.5f + turn * 0.16666667f));
#pragma GCC unroll 8
      for (int k = 0; k < kCells; ++k) {
        add_weight<kGroups>(list, i, weight, total[k]);
        if constexpr (kGradient) {
          const float rise = dz + columns.z + voxel * static_cast<float>(k);
          const Float8 there = 1.0f / sqrt8(squared + (rise * rise - dz * dz));
          add_slope<kGroups>(list, i, weight, dx, dy, splat8(rise), there, total[k]);
        }
        weight *= ratio, ratio *= change;
      }
    }
    std::copy_n(total, kCells, sums);
  }

  // The cells at height k of eight columns; false, with nothing written, where groups would cost too much there.
  bool write(const Columns& columns, int k, Float8 shift, const Sums& s, double common) const {
    const Int8 has_value = s.weight > 0.0f;
    const Float8 inverse = has_value ? 1.0f / s.weight : splat8(NAN);
    if (any8(s.error * inverse > splat8(0.25f * truncation))) return false;
    const Float8 value = has_value ? shift - length * log8(s.weight) : splat8(NAN);
    const int z = columns.lowest[2] + k;
    for (int lane = 0; lane < 8 && z < grid.size[2]; ++lane) {
      const int i = columns.lowest[0] + lane / 4, j = columns.lowest[1] + lane % 4;
      if (i >= grid.last || j >= grid.size[1]) continue;
      const long cell = grid.cell(i, j, z);
      distance[cell] = static_cast<float>(value[lane] - common);
      if (gradient == nullptr) continue;
      gradient[3 * cell] = (s.x * inverse)[lane], gradient[3 * cell + 1] = (s.y * inverse)[lane];
      gradient[3 * cell + 2] = (s.z * inverse)[lane];
    }
    return true;
  }

  static Float8 least_scores(const TermList& list, const Columns& columns, float z) {
    Float8 least = splat8(kFar);
    for (int i = 0; i < list.size; ++i)
      least = min8(least, distances(columns.x - list.x[i], columns.y - list.y[i], splat8(z - list.z[i])) - list.offset[i]);
    return least;
  }
};

}  // namespace

void bake_matern(const Clusters& spheres, const Offsets& offsets, const double* offset, const float* sign, float length,
                 float truncation, const GridSpan& grid, float* distance, float* gradient) {
  const Baker baker{spheres, offsets, offset, sign, length, truncation, grid, make_groups(spheres, offset, length), distance, gradient};
  for_each_block<Work>(grid, [&](const int* block, Work& work) { baker.block(block, work); });
}

}  // namespace splatctrl
