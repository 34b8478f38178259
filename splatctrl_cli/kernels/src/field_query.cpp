#include "field_query.h"

#include <algorithm>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr int kPointsPerChunk = 64;
constexpr float kNear = 5.0f;  // exponents of the first pass: it sees most of the sum, and tells how far the second goes
constexpr float kLog2e = 1.44269504f;

// e^x for x <= 0; what rounding leaves above 0 counts as 0.
Float8 exp8(Float8 x) { return exp2_8(min8(max8(x * kLog2e, splat8(-126.0f)), Float8{})); }

template <typename Fn>
void for_each_point(const Query& query, const Fn& fn) {
  const int num_chunks = (query.num_points + kPointsPerChunk - 1) / kPointsPerChunk;
  parallel_for(num_chunks, query.num_threads, [&](int chunk) {
    Candidates found;
    const int end = std::min(query.num_points, (chunk + 1) * kPointsPerChunk);
    for (int i = chunk * kPointsPerChunk; i < end; ++i)
      fn(i, Point{query.points[3 * i], query.points[3 * i + 1], query.points[3 * i + 2]}, found);
  });
}

// Calls add(cluster) for the clusters whose terms count: first those within `near` exponents of the largest, then those
// that can still add up to more than `share(sum)` of the sum() that is there; `unit` is an exponent's worth of score.
template <typename Sum, typename Share, typename Add>
void add_in_two_passes(const Candidates& found, float least, float slack, float unit, float num_entries, const Sum& sum,
                       const Share& share, const Add& add) {
  const float near = least + kNear * unit + slack;
  for (int i = 0; i < found.size; ++i)
    if (found.bound[i] <= near) add(found.cluster[i]);
  const float total = sum(), far = least + std::log(num_entries / (share(total) * total)) * unit + slack;
  for (int i = 0; i < found.size; ++i)
    if (found.bound[i] > near && found.bound[i] <= far) add(found.cluster[i]);
}

// A distance at one point, and its gradient.
struct Distance {
  float value, x, y, z;

  void write(const Query& query, int i) const {
    query.score[i] = value;
    query.gradient[3 * i] = x, query.gradient[3 * i + 1] = y, query.gradient[3 * i + 2] = z;
  }
};

Distance to_sphere(const Clusters& s, Nearest nearest, Point q) {
  const float dx = q.x - s.x[nearest.entry], dy = q.y - s.y[nearest.entry], dz = q.z - s.z[nearest.entry];
  const float d = std::sqrt(dx * dx + dy * dy + dz * dz), scale = d > 0.0f ? 1.0f / d : 0.0f;  // none at a centre: zero
  return {nearest.score, scale * dx, scale * dy, scale * dz};
}

}  // namespace

void query_nearest(const Clusters& spheres, const Offsets& radii, const Query& query, int* entry) {
  for_each_point(query, [&](int i, Point q, Candidates& found) {
    const Nearest nearest = find_nearest<LinearScore>(spheres, radii, q, found);
    to_sphere(spheres, nearest, q).write(query, i);
    entry[i] = nearest.entry;
  });
}

void query_matern(const Clusters& spheres, const Offsets& offsets, const float* sign, float length, float truncation,
                  const Query& query) {
  const auto num_entries = static_cast<float>(kLanes * spheres.num_clusters);
  const float spread = std::log(num_entries / truncation) * length;
  for_each_point(query, [&](int i, Point q, Candidates& found) {
    const float least = find_nearest<LinearScore>(spheres, offsets, q, found, [&](float) { return spread; }).score;
    const float inverse_length = 1.0f / length;
    Float8 weight_sum{}, size_sum{}, x{}, y{}, z{};
    const auto add = [&](int cluster) {
      for (int entry = kLanes * cluster; entry < kLanes * (cluster + 1); entry += 8) {
        const Float8 dx = q.x - load8(spheres.x + entry), dy = q.y - load8(spheres.y + entry);
        const Float8 dz = q.z - load8(spheres.z + entry), o = load8(offsets.value + entry);
        const Float8 d = sqrt8(dx * dx + dy * dy + dz * dz);
        const Float8 size = exp8((least - (d - o)) * inverse_length);
        const Float8 weight = sign == nullptr ? size : size * load8(sign + entry);
        const Float8 by_distance = weight / max8(d, splat8(1e-20f));
        size_sum += size;
        weight_sum += weight;
        x += by_distance * dx;
        y += by_distance * dy;
        z += by_distance * dz;
      }
    };
    add_in_two_passes(found, least, rounding_slack(q, least), length, num_entries, [&] { return sum8(size_sum); },
                      [&](float) { return truncation; }, add);
    const float weight = sum8(weight_sum);
    query.score[i] = least - length * std::log(weight);
    query.gradient[3 * i] = sum8(x) / weight;
    query.gradient[3 * i + 1] = sum8(y) / weight;
    query.gradient[3 * i + 2] = sum8(z) / weight;
  });
}

namespace {

constexpr float kSpareOffset = -1e29f;  // spare entries have less

// The field of query_gaussian.
struct GaussianField {
  const Clusters& spheres;
  const Offsets& offsets;
  const float *radii, *sign;
  double common;
  float length, tolerance;
  float log_count = std::log(static_cast<float>(kLanes * spheres.num_clusters));
  float largest_radius = sign == nullptr ? kFar : largest_of(radii, kLanes * spheres.num_clusters);

  float unit() const { return 2.0f * length * length; }

  // The largest term at q and the clusters that count, from their bounds up to `limit`: N terms beyond make up no more
  // than may be lost at the least distance there can be.
  Nearest find(Point q, Candidates& found, float& limit) const {
    float room = 0.0f;
    const Nearest nearest = find_nearest<SquaredScore>(spheres, offsets, q, found, [&](float lowest) {
      const double squared = lowest - common - static_cast<double>(unit() * log_count);
      const float distance = squared > 0.0 ? std::sqrt(static_cast<float>(squared)) : 0.0f;
      return room = unit() * (log_count - std::log(gaussian_log_share(distance, tolerance, length)));
    });
    limit = nearest.score + rounding_slack(q, nearest.score) + room;
    return nearest;
  }

  Distance at(Point q, Nearest nearest, const Candidates& found, float limit) const {
    Float8 sums[8] = {};  // of the weights, weights by radius, and the first moments of x - p under both
    for (int k = 0; k < found.size; ++k) {
      if (!(found.bound[k] <= limit)) continue;
      if (sign == nullptr)
        add<false>(found.cluster[k], q, nearest, sums);
      else
        add<true>(found.cluster[k], q, nearest, sums);
    }
    const Float8 total = sums8(sums);
    const double log_sum = static_cast<double>(unit()) * std::log(static_cast<double>(total[0]));
    const float inverse = 1.0f / total[0], radius = total[1] * inverse;
    const float root = std::sqrt(static_cast<float>(nearest.score - common - log_sum));
    const float mean_radius = radii[nearest.entry] + radius;
    // Of terms with signs, a mean beyond all radii tells that the sum has all but cancelled.
    if (!(root > 0.0f) || !(std::fabs(mean_radius) <= 1.001f * largest_radius)) return {NAN, NAN, NAN, NAN};  // NaN too
    float gradient[3];
    for (int a = 0; a < 3; ++a) {
      const float mean = total[2 + a] * inverse;
      gradient[a] = mean / root + (total[5 + a] * inverse - radius * mean) * 2.0f / unit();
    }
    return {root - mean_radius, gradient[0], gradient[1], gradient[2]};
  }

  // Radii count from that of the largest term: where it stands alone nothing is left to cancel.
  template <bool kSigned>
  void add(int cluster, Point q, Nearest nearest, Float8* sums) const {
    const float reference = radii[nearest.entry], scale = 1.0f / unit();
    for (int entry = kLanes * cluster; entry < kLanes * (cluster + 1); entry += 8) {
      const Float8 dx = q.x - load8(spheres.x + entry), dy = q.y - load8(spheres.y + entry), dz = q.z - load8(spheres.z + entry);
      Float8 weight = exp8((nearest.score - (dx * dx + dy * dy + dz * dz - load8(offsets.value + entry))) * scale);
      if constexpr (kSigned) weight *= load8(sign + entry);
      const Float8 by_radius = weight * (load8(radii + entry) - reference);
      sums[0] += weight, sums[1] += by_radius;
      sums[2] += weight * dx, sums[3] += weight * dy, sums[4] += weight * dz;
      sums[5] += by_radius * dx, sums[6] += by_radius * dy, sums[7] += by_radius * dz;
    }
  }
};


}  // namespace

void query_gaussian(const Clusters& spheres, const Offsets& offsets, const float* radii, const float* sign, double common,
                    float length, float tolerance, const Query& query) {
  const GaussianField field{spheres, offsets, radii, sign, common, length, tolerance};
  for_each_point(query, [&](int i, Point q, Candidates& found) {
    float limit;
    const Nearest nearest = field.find(q, found, limit);
    field.at(q, nearest, found, limit).write(query, i);
  });
}

void query_safe(const Clusters& spheres, const Offsets& offsets, const Offsets& radii, const float* sign, double common,
                float length, float tolerance, const Query& query) {
  const GaussianField field{spheres, offsets, radii.value, sign, common, length, tolerance};
  const float largest_radius = largest_of(radii.maximum, spheres.num_clusters);
  float least_offset = kFar;  // of a cluster, spare ones aside
  for (int c = 0; c < spheres.num_clusters; ++c)
    if (offsets.maximum[c] > kSpareOffset) least_offset = std::min(least_offset, offsets.maximum[c]);
  for_each_point(query, [&](int i, Point q, Candidates& found) {
    float limit;
    const Nearest largest = field.find(q, found, limit);
    const Distance smooth = field.at(q, largest, found, limit);
    LeastScores scores;
    for (int k = 0; k < found.size; ++k)
      if (found.bound[k] <= limit) visit_cluster<LinearScore>(spheres, radii, found.cluster[k], q, scores);
    Nearest nearest = scores.nearest();
    // Clusters not visited are farther than the root of this, and no sphere is larger than the largest.
    const float beyond = limit + least_offset;
    if (!(beyond > 0.0f) || nearest.score + rounding_slack(q, nearest.score) > std::sqrt(beyond) - largest_radius)
      nearest = find_nearest<LinearScore>(spheres, radii, q, found);
    (smooth.value < nearest.score ? smooth : to_sphere(spheres, nearest, q)).write(query, i);
  });
}

}  // namespace splatctrl
