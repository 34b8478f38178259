#include "field_bake.h"

#include <algorithm>

#include "fast_exp.h"
#include "parallel.h"

namespace splatctrl {
namespace {

constexpr int kBlock = 8, kSubBlock = 4;
constexpr float kSqrt3 = 1.7320508f;
constexpr int kBins = 64;  // of the scores in a sub-block's list, half a length scale each

// Spheres that can matter in a block, relative to the block's centre.
struct SphereList {
  std::vector<float> x, y, z, offset, score, weight;
  int size = 0;

  void reserve(int n) {
    if (static_cast<int>(x.size()) >= n) return;
    for (auto* values : {&x, &y, &z, &offset, &score, &weight}) values->resize(n);
  }
};

struct BlockWork {
  Scratch scratch;
  SphereList hard, soft, sub_hard, sub_soft;
};

// Spheres of `s` whose score at c is within `margin` of the least there.
void collect(const Clusters& s, Point c, float margin, Scratch& scratch, SphereList& list) {
  const float least = find_nearest(s, c, scratch).score;
  const float limit = least + margin + rounding_slack(s, c, least);
  list.size = 0;
  float scores[kLanes];
  for (int cluster = 0; cluster < s.num_clusters; ++cluster) {
    if (scratch.bounds[cluster] > limit) continue;
    list.reserve(list.size + kLanes);
    cluster_scores(s, cluster, c, scores);
    for (int k = 0; k < kLanes; ++k) {
      const int i = kLanes * cluster + k, n = list.size;
      list.x[n] = s.x[i] - c.x;
      list.y[n] = s.y[i] - c.y;
      list.z[n] = s.z[i] - c.z;
      list.offset[n] = s.offset[i];
      list.size += scores[k] <= limit ? 1 : 0;
    }
  }
}

// Scores of the list at c (block coordinates); returns the least.
float score_list(SphereList& from, Point c) {
  float least = 3e38f;
  for (int i = 0; i < from.size; ++i) {
    const float dx = c.x - from.x[i], dy = c.y - from.y[i], dz = c.z - from.z[i];
    from.score[i] = std::sqrt(dx * dx + dy * dy + dz * dz) - from.offset[i];
  }
  for (int i = 0; i < from.size; ++i) least = from.score[i] < least ? from.score[i] : least;
  return least;
}

// The scored spheres up to `limit`.
void narrow(const SphereList& from, float limit, SphereList& list) {
  list.reserve(from.size);
  int n = 0;
  for (int i = 0; i < from.size; ++i) {
    list.x[n] = from.x[i];
    list.y[n] = from.y[i];
    list.z[n] = from.z[i];
    list.offset[n] = from.offset[i];
    n += from.score[i] <= limit ? 1 : 0;
  }
  list.size = n;
}

// A limit on the scores at c: what lies beyond makes up no more than `share` of the sum of exp(-score / length).
float limit_of_share(SphereList& from, float length, float least, float share) {
  const float inverse_length = 1.0f / length;
  float mass[kBins] = {}, total = 0.0f, beyond = 0.0f;
  for (int i = 0; i < from.size; ++i) from.weight[i] = fast_exp((least - from.score[i]) * inverse_length);
  for (int i = 0; i < from.size; ++i) {
    const float bin = 2.0f * (from.score[i] - least) * inverse_length;
    mass[bin < kBins - 1 ? static_cast<int>(bin) : kBins - 1] += from.weight[i];
  }
  for (const float m : mass) total += m;
  int last = kBins;
  while (last > 1 && beyond + mass[last - 1] <= share * total) beyond += mass[--last];
  return last == kBins ? 3e38f : least + 0.5f * static_cast<float>(last) * length;
}

// 16 cells of one x: four along y by four along z.
struct Slab {
  float x, y[kLanes], z[kLanes];
};

struct SlabDistance {
  float distance[kLanes], x[kLanes], y[kLanes], z[kLanes];  // distance and its gradient
};

void least_scores(const SphereList& list, const Slab& slab, float* best, int* entry) {
  for (int k = 0; k < kLanes; ++k) best[k] = 3e38f, entry[k] = 0;
  for (int i = 0; i < list.size; ++i) {
    const float dx = slab.x - list.x[i], y = list.y[i], z = list.z[i], offset = list.offset[i];
    for (int k = 0; k < kLanes; ++k) {
      const float dy = slab.y[k] - y, dz = slab.z[k] - z;
      const float score = std::sqrt(dx * dx + dy * dy + dz * dz) - offset;
      entry[k] = score < best[k] ? i : entry[k];
      best[k] = score < best[k] ? score : best[k];
    }
  }
}

void hard_slab(const SphereList& list, const Slab& slab, SlabDistance& out) {
  int entry[kLanes];
  least_scores(list, slab, out.distance, entry);
  for (int k = 0; k < kLanes; ++k) {
    const int i = entry[k];
    const float dx = slab.x - list.x[i], dy = slab.y[k] - list.y[i], dz = slab.z[k] - list.z[i];
    const float d = std::sqrt(dx * dx + dy * dy + dz * dz);
    const float scale = d > 0.0f ? 1.0f / d : 0.0f;
    out.x[k] = scale * dx;
    out.y[k] = scale * dy;
    out.z[k] = scale * dz;
  }
}

// `least`: the least score at the sub-block's centre; over its cells it changes by no more than `radius`, so that one
// shift serves them all unless l is tiny beside the cells.
void soft_slab(const SphereList& list, const Slab& slab, float length, float least, float radius, SlabDistance& out) {
  float shift[kLanes], sum[kLanes] = {}, x[kLanes] = {}, y[kLanes] = {}, z[kLanes] = {};
  int entry[kLanes];
  if (radius > 20.0f * length)
    least_scores(list, slab, shift, entry);
  else
    std::fill_n(shift, kLanes, least);
  const float inverse_length = 1.0f / length;
  for (int i = 0; i < list.size; ++i) {
    const float dx = slab.x - list.x[i], center_y = list.y[i], center_z = list.z[i], offset = list.offset[i];
    for (int k = 0; k < kLanes; ++k) {
      const float dy = slab.y[k] - center_y, dz = slab.z[k] - center_z;
      const float d = std::sqrt(dx * dx + dy * dy + dz * dz);
      const float weight = fast_exp((shift[k] - (d - offset)) * inverse_length);
      const float by_distance = weight / (d > 1e-20f ? d : 1e-20f);
      sum[k] += weight;
      x[k] += by_distance * dx;
      y[k] += by_distance * dy;
      z[k] += by_distance * dz;
    }
  }
  for (int k = 0; k < kLanes; ++k) {
    out.distance[k] = shift[k] - length * std::log(sum[k]);
    out.x[k] = x[k] / sum[k];
    out.y[k] = y[k] / sum[k];
    out.z[k] = z[k] / sum[k];
  }
}

// Bakes one block of cells; first (3): its lowest cell.
struct Baker {
  const Clusters &hard, &soft;
  double soft_common_offset;
  float length, truncation;
  const GridLayout& grid;
  float *sdf_out, *soft_out, *hard_out, *gradient_out;

  // N terms, each this far above the least score, make up no more than truncation / 2 of the sum.
  float reach() const {
    return length * std::log(2.0f * static_cast<float>(kLanes * soft.num_clusters) / truncation);
  }

  void block(const int* first, BlockWork& work) const {
    const auto voxel = static_cast<float>(grid.voxel);
    const float radius = 0.5f * (kBlock - 1) * kSqrt3 * voxel;
    double center[3];
    for (int a = 0; a < 3; ++a) center[a] = grid.origin[a] + grid.voxel * (first[a] + 0.5 * (kBlock - 1));
    const Point c{static_cast<float>(center[0]), static_cast<float>(center[1]), static_cast<float>(center[2])};
    collect(hard, c, 2.0f * radius, work.scratch, work.hard);
    collect(soft, c, 2.0f * radius + reach(), work.scratch, work.soft);
    for (int i = 0; i < kBlock; i += kSubBlock)
      for (int j = 0; j < kBlock; j += kSubBlock)
        for (int k = 0; k < kBlock; k += kSubBlock) {
          const int corner[3] = {first[0] + i, first[1] + j, first[2] + k};
          if (corner[0] < grid.size[0] && corner[1] < grid.size[1] && corner[2] < grid.size[2])
            sub_block(corner, c, work);
        }
  }

  void sub_block(const int* corner, Point c, BlockWork& work) const {
    const auto voxel = static_cast<float>(grid.voxel);
    const float radius = 0.5f * (kSubBlock - 1) * kSqrt3 * voxel;
    float low[3];  // the corner cell, relative to the block's centre as the lists have it
    const float rounded[3] = {c.x, c.y, c.z};
    for (int a = 0; a < 3; ++a)
      low[a] = static_cast<float>(grid.origin[a] + grid.voxel * corner[a] - static_cast<double>(rounded[a]));
    const float half = 0.5f * (kSubBlock - 1) * voxel;
    const Point middle{low[0] + half, low[1] + half, low[2] + half};
    const float slack = rounding_slack(soft, c, radius) + rounding_slack(hard, middle, radius);
    narrow(work.hard, score_list(work.hard, middle) + 2.0f * radius + slack, work.sub_hard);
    const float least = score_list(work.soft, middle);
    const float share = 0.5f * truncation * std::exp(-2.0f * radius / length);
    const float enough = limit_of_share(work.soft, length, least, share);
    narrow(work.soft, std::min(enough, least + 2.0f * radius + reach()) + slack, work.sub_soft);
    for (int i = 0; i < kSubBlock && corner[0] + i < grid.size[0]; ++i) {
      Slab slab;
      slab.x = low[0] + static_cast<float>(i) * voxel;
      for (int k = 0; k < kLanes; ++k) {
        slab.y[k] = low[1] + static_cast<float>(k / kSubBlock) * voxel;
        slab.z[k] = low[2] + static_cast<float>(k % kSubBlock) * voxel;
      }
      SlabDistance hard_distance, soft_distance;
      hard_slab(work.sub_hard, slab, hard_distance);
      soft_slab(work.sub_soft, slab, length, least, radius, soft_distance);
      write(corner, i, hard_distance, soft_distance);
    }
  }

  void write(const int* corner, int i, const SlabDistance& hard_distance, const SlabDistance& soft_distance) const {
    for (int lane = 0; lane < kLanes; ++lane) {
      const int y = corner[1] + lane / kSubBlock, z = corner[2] + lane % kSubBlock;
      if (y >= grid.size[1] || z >= grid.size[2]) continue;
      const long cell = (static_cast<long>(corner[0] + i) * grid.size[1] + y) * grid.size[2] + z;
      const auto smooth = static_cast<float>(soft_distance.distance[lane] - soft_common_offset);
      const float exact = hard_distance.distance[lane];
      const SlabDistance& least = smooth < exact ? soft_distance : hard_distance;
      hard_out[cell] = exact;
      soft_out[cell] = smooth;
      sdf_out[cell] = smooth < exact ? smooth : exact;
      gradient_out[3 * cell] = least.x[lane];
      gradient_out[3 * cell + 1] = least.y[lane];
      gradient_out[3 * cell + 2] = least.z[lane];
    }
  }
};

}  // namespace

void bake_grid(const Clusters& hard, const Clusters& soft, double soft_common_offset, float length, float truncation,
               const GridLayout& grid, int num_threads, float* sdf_out, float* soft_out, float* hard_out, float* gradient_out) {
  const Baker baker{hard, soft, soft_common_offset, length, truncation, grid, sdf_out, soft_out, hard_out, gradient_out};
  int blocks[3];
  for (int a = 0; a < 3; ++a) blocks[a] = (grid.size[a] + kBlock - 1) / kBlock;
  parallel_for(blocks[0] * blocks[1], num_threads, [&](int column) {
    BlockWork work;
    for (int k = 0; k < blocks[2]; ++k) {
      const int first[3] = {kBlock * (column / blocks[1]), kBlock * (column % blocks[1]), kBlock * k};
      baker.block(first, work);
    }
  });
}

}  // namespace splatctrl
