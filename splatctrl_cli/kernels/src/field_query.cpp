#include "field_query.h"

#include <algorithm>

#include "fast_exp.h"
#include "parallel.h"

namespace splatctrl {
namespace {

constexpr int kPointsPerChunk = 16;
constexpr float kNearLengths = 4.0f;  // the first pass: it sees most of the sum, and tells how far the second must go

template <typename Fn>
void for_each_point(const float* points, int num_points, int num_threads, const Fn& fn) {
  const int num_chunks = (num_points + kPointsPerChunk - 1) / kPointsPerChunk;
  parallel_for(num_chunks, num_threads, [&](int chunk) {
    Scratch scratch;
    const int end = std::min(num_points, (chunk + 1) * kPointsPerChunk);
    for (int i = chunk * kPointsPerChunk; i < end; ++i)
      fn(i, Point{points[3 * i], points[3 * i + 1], points[3 * i + 2]}, scratch);
  });
}

// Sums over the clusters that can matter at q, by lane.
struct LaneSums {
  float weight[kLanes] = {}, x[kLanes] = {}, y[kLanes] = {}, z[kLanes] = {};
};

void add_cluster(const Clusters& s, int c, Point q, float shift, float inverse_length, LaneSums& sums) {
  const float *x = s.x + kLanes * c, *y = s.y + kLanes * c, *z = s.z + kLanes * c, *o = s.offset + kLanes * c;
  for (int k = 0; k < kLanes; ++k) {
    const float dx = q.x - x[k], dy = q.y - y[k], dz = q.z - z[k];
    const float d = std::sqrt(dx * dx + dy * dy + dz * dz);
    const float weight = fast_exp((shift - (d - o[k])) * inverse_length);
    const float by_distance = weight / (d > 1e-20f ? d : 1e-20f);
    sums.weight[k] += weight;
    sums.x[k] += by_distance * dx;
    sums.y[k] += by_distance * dy;
    sums.z[k] += by_distance * dz;
  }
}

}  // namespace

void query_nearest(const Clusters& spheres, const float* points, int num_points, int num_threads, float* score,
                   float* gradient) {
  for_each_point(points, num_points, num_threads, [&](int i, Point q, Scratch& scratch) {
    const Nearest nearest = find_nearest(spheres, q, scratch);
    const float dx = q.x - spheres.x[nearest.entry], dy = q.y - spheres.y[nearest.entry];
    const float dz = q.z - spheres.z[nearest.entry];
    const float d = std::sqrt(dx * dx + dy * dy + dz * dz);
    const float scale = d > 0.0f ? 1.0f / d : 0.0f;  // at a centre the distance has no gradient: zero
    score[i] = nearest.score;
    gradient[3 * i] = scale * dx;
    gradient[3 * i + 1] = scale * dy;
    gradient[3 * i + 2] = scale * dz;
  });
}

void query_soft(const Clusters& spheres, float length, float truncation, const float* points, int num_points,
                int num_threads, float* score, float* gradient) {
  const float inverse_length = 1.0f / length;
  const auto num_entries = static_cast<float>(kLanes * spheres.num_clusters);
  for_each_point(points, num_points, num_threads, [&](int i, Point q, Scratch& scratch) {
    const float least = find_nearest(spheres, q, scratch).score;
    const float slack = rounding_slack(spheres, q, least), near = least + kNearLengths * length + slack;
    LaneSums sums;
    for (int c = 0; c < spheres.num_clusters; ++c)
      if (scratch.bounds[c] <= near) add_cluster(spheres, c, q, least, inverse_length, sums);
    // What is farther than this cannot add up to more than `truncation` of what is there already.
    const float reach = std::log(num_entries / (truncation * sum_lanes(sums.weight)));
    const float far = least + reach * length + slack;
    for (int c = 0; c < spheres.num_clusters; ++c)
      if (scratch.bounds[c] > near && scratch.bounds[c] <= far)
        add_cluster(spheres, c, q, least, inverse_length, sums);
    const float weight = sum_lanes(sums.weight);
    score[i] = least - length * std::log(weight);
    gradient[3 * i] = sum_lanes(sums.x) / weight;
    gradient[3 * i + 1] = sum_lanes(sums.y) / weight;
    gradient[3 * i + 2] = sum_lanes(sums.z) / weight;
  });
}

}  // namespace splatctrl
