#include "field_density.h"

#include <algorithm>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr float kOne = 16777216.0f;       // 2^24
constexpr float kReach = 17.4f;           // e^-17.4 < 2^-25
constexpr int kClustersPerFlush = 32;     // 32 * 2 terms of at most 2^24 stay below 2^31 in a lane
constexpr float kLog2e = 1.44269504f;

// Distance between the boxes of two clusters, less what rounding may have added.
float box_gap(const Clusters& s, int a, int b) {
  float squared = 0.0f, size = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    const float *lower = s.boxes[axis], *upper = s.boxes[axis + 3];
    const float gap = std::max(0.0f, std::max(lower[b] - upper[a], lower[a] - upper[b]));
    squared += gap * gap;
    size = std::max(size, std::max(std::fabs(lower[a]), std::fabs(lower[b])));
  }
  return std::sqrt(squared) - 1e-6f * size;
}

// Integer terms (8) of eight spheres at p; the same for (p, q) and (q, p).
template <Kernel kernel>
Int8 terms(const Clusters& s, int entry, Point p, float scale) {
  const Float8 dx = p.x - load8(s.x + entry), dy = p.y - load8(s.y + entry), dz = p.z - load8(s.z + entry);
  const Float8 squared = dx * dx + dy * dy + dz * dz;
  const Float8 exponent = (kernel == Kernel::kMatern ? sqrt8(squared) : squared) * -scale;
  const Float8 term = exp2_8(max8(exponent, splat8(-126.0f))) * kOne;
  return __builtin_convertvector(term + 0.5f, Int8);
}

template <Kernel kernel>
void sum_cluster(const Clusters& s, const unsigned char* has_sphere, int cluster, float reach, float scale, double* sum) {
  long total[kLanes] = {};
  Int8 part[kLanes] = {};
  const auto flush = [&] {
    for (int k = 0; k < kLanes; ++k) {
      for (int lane = 0; lane < 8; ++lane) total[k] += part[k][lane];
      part[k] = Int8{};
    }
  };
  int num_added = 0;
  for (int other = 0; other < s.num_clusters; ++other) {
    if (other % kLanes == 0 && box_gap(s, cluster, s.num_clusters + other / kLanes) > reach) {
      other += kLanes - 1;
      continue;
    }
    if (box_gap(s, cluster, other) > reach) continue;
    for (int k = 0; k < kLanes; ++k) {
      const int i = kLanes * cluster + k;
      const Point p{s.x[i], s.y[i], s.z[i]};
      part[k] += terms<kernel>(s, kLanes * other, p, scale) + terms<kernel>(s, kLanes * other + 8, p, scale);
    }
    if (++num_added % kClustersPerFlush == 0) flush();
  }
  flush();
  for (int k = 0; k < kLanes; ++k) {
    const int i = kLanes * cluster + k;
    sum[i] = has_sphere[i] ? static_cast<double>(total[k]) / kOne : 0.0;
  }
}

}  // namespace

void row_sums(const Clusters& spheres, const unsigned char* has_sphere, Kernel kernel, float length, int num_threads,
              double* sum) {
  const bool is_matern = kernel == Kernel::kMatern;
  const float reach = is_matern ? kReach * length : std::sqrt(2.0f * kReach) * length;
  const float scale = is_matern ? kLog2e / length : 0.5f * kLog2e / length / length;
  parallel_for(spheres.num_clusters, num_threads, [&](int cluster) {
    if (is_matern)
      sum_cluster<Kernel::kMatern>(spheres, has_sphere, cluster, reach, scale, sum);
    else
      sum_cluster<Kernel::kGaussian>(spheres, has_sphere, cluster, reach, scale, sum);
  });
}

}  // namespace splatctrl
