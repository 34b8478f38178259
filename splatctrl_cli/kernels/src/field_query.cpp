#include "field_query.h"

#include <algorithm>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr int kPointsPerChunk = 16;
constexpr float kNear = 5.0f;  // exponents of the first pass: it sees most of the sum, and tells how far the second goes
constexpr float kLog2e = 1.44269504f;

// e^x for x <= 0; what rounding leaves above 0 counts as 0.
Float8 exp8(Float8 x) { return exp2_8(min8(max8(x * kLog2e, splat8(-126.0f)), Float8{})); }

template <typename Fn>
void for_each_point(const Query& query, const Fn& fn) {
  const int num_chunks = (query.num_points + kPointsPerChunk - 1) / kPointsPerChunk;
  parallel_for(num_chunks, query.num_threads, [&](int chunk) {
    std::vector<float> bounds;
    const int end = std::min(query.num_points, (chunk + 1) * kPointsPerChunk);
    for (int i = chunk * kPointsPerChunk; i < end; ++i)
      fn(i, Point{query.points[3 * i], query.points[3 * i + 1], query.points[3 * i + 2]}, bounds);
  });
}

// Calls add(cluster) for the clusters whose terms count: first those within `near` exponents of the largest, then those
// that can still add up to more than `share(sum)` of the sum() that is there; `unit` is an exponent's worth of score.
template <typename Score, typename Sum, typename Share, typename Add>
void add_in_two_passes(const Clusters& s, const Offsets& o, Point q, const std::vector<float>& bounds, float least,
                       float unit, const Sum& sum, const Share& share, const Add& add) {
  const float slack = rounding_slack(q, least), near = least + kNear * unit + slack;
  walk_clusters<Score>(s, o, q, bounds, [&] { return near; }, add);
  const float total = sum();
  const float reach = std::log(static_cast<float>(kLanes * s.num_clusters) / (share(total) * total));
  const float far = least + reach * unit + slack;
  if (!(far > near)) return;
  float cluster_bounds[kLanes];
  const int groups = (s.num_clusters + kLanes - 1) / kLanes;
  for (int g = 0; g < groups; ++g) {
    if (!(bounds[g] <= far)) continue;
    bound_clusters<Score>(s, o, g, q, cluster_bounds);
    for (int k = 0; k < kLanes; ++k)
      if (cluster_bounds[k] > near && cluster_bounds[k] <= far) add(kLanes * g + k);
  }
}

}  // namespace

void query_nearest(const Clusters& spheres, const Offsets& radii, const Query& query, int* entry) {
  for_each_point(query, [&](int i, Point q, std::vector<float>& bounds) {
    const Nearest nearest = find_nearest<LinearScore>(spheres, radii, q, bounds);
    const float dx = q.x - spheres.x[nearest.entry], dy = q.y - spheres.y[nearest.entry];
    const float dz = q.z - spheres.z[nearest.entry];
    const float d = std::sqrt(dx * dx + dy * dy + dz * dz);
    const float scale = d > 0.0f ? 1.0f / d : 0.0f;  // at a centre the distance has no gradient: zero
    query.score[i] = nearest.score;
    query.gradient[3 * i] = scale * dx;
    query.gradient[3 * i + 1] = scale * dy;
    query.gradient[3 * i + 2] = scale * dz;
    entry[i] = nearest.entry;
  });
}

void query_matern(const Clusters& spheres, const Offsets& offsets, const float* sign, float length, float truncation,
                  const Query& query) {
  for_each_point(query, [&](int i, Point q, std::vector<float>& bounds) {
    const float least = find_nearest<LinearScore>(spheres, offsets, q, bounds).score;
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
    add_in_two_passes<LinearScore>(spheres, offsets, q, bounds, least, length, [&] { return sum8(size_sum); },
                                   [&](float) { return truncation; }, add);
    const float weight = sum8(weight_sum);
    query.score[i] = least - length * std::log(weight);
    query.gradient[3 * i] = sum8(x) / weight;
    query.gradient[3 * i + 1] = sum8(y) / weight;
    query.gradient[3 * i + 2] = sum8(z) / weight;
  });
}

void query_gaussian(const Clusters& spheres, const Offsets& offsets, const float* radii, const float* sign, double common,
                    float length, float tolerance, const Query& query) {
  const auto num_entries = static_cast<float>(kLanes * spheres.num_clusters);
  for_each_point(query, [&](int i, Point q, std::vector<float>& bounds) {
    const Nearest nearest = find_nearest<SquaredScore>(spheres, offsets, q, bounds);
    const float least = nearest.score, reference = radii[nearest.entry];  // radii less this one: its own terms are exact
    const float unit = 2.0f * length * length, inverse_unit = 1.0f / unit;
    Float8 size_sum{}, weight_sum{}, radius_sum{}, first[3] = {}, second[3] = {};
    const auto add = [&](int cluster) {
      for (int entry = kLanes * cluster; entry < kLanes * (cluster + 1); entry += 8) {
        const Float8 dx = q.x - load8(spheres.x + entry), dy = q.y - load8(spheres.y + entry);
        const Float8 dz = q.z - load8(spheres.z + entry);
        const Float8 squared = dx * dx + dy * dy + dz * dz - load8(offsets.value + entry);
        const Float8 size = exp8((least - squared) * inverse_unit);
        const Float8 weight = sign == nullptr ? size : size * load8(sign + entry);
        const Float8 by_radius = weight * (load8(radii + entry) - reference);
        size_sum += size;
        weight_sum += weight;
        radius_sum += by_radius;
        first[0] += weight * dx, first[1] += weight * dy, first[2] += weight * dz;
        second[0] += by_radius * dx, second[1] += by_radius * dy, second[2] += by_radius * dz;
      }
    };
    const auto share = [&](float total) {  // of the sum, from a lower bound of the distance
      const double squared = least - common - unit * std::log(total + num_entries * std::exp(-kNear));
      return gaussian_log_share(squared > 0.0 ? static_cast<float>(std::sqrt(squared)) : 0.0f, tolerance, length);
    };
    add_in_two_passes<SquaredScore>(spheres, offsets, q, bounds, least, unit, [&] { return sum8(size_sum); }, share, add);
    const float weight = sum8(weight_sum), radius = sum8(radius_sum) / weight;
    const float root = std::sqrt(static_cast<float>(least - common - static_cast<double>(unit) * std::log(static_cast<double>(weight))));
    const bool has_value = root > 0.0f;  // false for NaN too
    query.score[i] = has_value ? root - (reference + radius) : NAN;
    for (int a = 0; a < 3; ++a) {
      const float mean = sum8(first[a]) / weight;  // of x - p
      const float turn = (sum8(second[a]) / weight - radius * mean) * 2.0f * inverse_unit;
      query.gradient[3 * i + a] = has_value ? mean / root + turn : NAN;
    }
  });
}

}  // namespace splatctrl
