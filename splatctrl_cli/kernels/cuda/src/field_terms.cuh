// The log-sum-exps of the two kernels around a point m: which terms count within a radius of it, and their sums at
// places near it. Shared by the kernels that bake and those that answer points (radius 0).
//
// All exponents count from that of the largest term at m, its reference, at the same place.
#pragma once

#include "field.h"

namespace splatctrl {

constexpr float kMostExponent = 30.0f;  // as bake_gaussian: terms this far below the largest are left out
constexpr float kSafeExponent = 80.0f;  // up to here a sum of exponentials does not overflow

// A term: (x, y, z, w), and its radius less the reference's and its sign.
struct Term {
  float4 at;
  float2 of;
};

// A place (x, y, z) relative to m.
struct Place {
  float x, y, z;
};

// Squared exponential: the exponent of a term less its reference's is linear in the place,
// w + (p - p_0).x / l^2; a term holds p - p_0 and w.
struct GaussianTerms {
  struct Sums {
    float weight = 0.0f, radius = 0.0f, first[3] = {}, second[3] = {};  // moments of p - p_0 under both

    template <class Fn>
    __device__ void each(const Fn& fn) {
      fn(weight), fn(radius);
      for (int a = 0; a < 3; ++a) fn(first[a]), fn(second[a]);
    }
    __device__ void add(float w, const Term& t) {
      const float by_radius = w * t.of.x;
      weight += w, radius += by_radius;
      first[0] += w * t.at.x, second[0] += by_radius * t.at.x;
      first[1] += w * t.at.y, second[1] += by_radius * t.at.y;
      first[2] += w * t.at.z, second[2] += by_radius * t.at.z;
    }
  };
  // Exponents at a place.
  struct Exponents {
    float x, y, z;  // place / l^2
    __device__ float of(const float4& t) const { return t.w + t.x * x + t.y * y + t.z * z; }
    __device__ float reach(const float4& t, float radius) const { return radius * sqrtf(squared_length(t.x, t.y, t.z)); }
    __device__ void add(float w, const Term& t, GaussianTerms::Sums& sums) const { sums.add(w, t); }
  };

  const FieldTask& task;
  Point middle, reference;  // reference: relative to the anchor, as the middle
  float radius, limit, reference_radius, inverse;  // inverse: 1 / l^2
  double log_weight;

  __device__ GaussianTerms(const FieldTask& t, Point m, float around, int lane) : task(t), middle(m), radius(around) {
    const Nearest nearest = find_nearest<SquaredScore>(t.spheres, t.offsets, m, lane);
    reference = place_of(t.spheres, nearest.entry);
    reference_radius = t.radius[nearest.entry], log_weight = t.exact[nearest.entry];
    inverse = 1.0f / t.length / t.length;
    const float unit = 2.0f * t.length * t.length;
    const double squared = squared_distance(m, reference) - unit * (log_weight + t.log_count);
    const float distance = larger(squared > 0.0 ? sqrtf(static_cast<float>(squared)) - radius : 0.0f, 0.0f);
    const float exponent = t.log_count - logf(gaussian_log_share(distance, t.tolerance, t.length));
    limit = nearest.score + smaller(exponent, kMostExponent) * unit + rounding_slack(m, nearest.score);
  }

  // q_i(x) - q_0(x) changes by at most 2 R |p_i - p_0| within the radius.
  __device__ bool keeps(int box) const {
    const Box corners = box_at(task.spheres, box);
    const float bound = squared_box_distance(corners, middle) - task.offsets.maximum[box];
    return bound <= limit + 2.0f * radius * sqrtf(squared_farthest_corner(corners, reference));
  }
  __device__ bool chooses(int i) const {
    const Point p = place_of(task.spheres, i);
    const float score = squared_distance(p, middle) - task.offsets.value[i];
    return score <= limit + 2.0f * radius * sqrtf(squared_distance(p, reference));
  }
  __device__ Term term(int i) const {
    const Point p = place_of(task.spheres, i);
    const float x = p.x - reference.x, y = p.y - reference.y, z = p.z - reference.z;
    const float along = (reference.x - middle.x + 0.5f * x) * x + (reference.y - middle.y + 0.5f * y) * y +
                        (reference.z - middle.z + 0.5f * z) * z;
    const float exponent = static_cast<float>(task.exact[i] - log_weight) - along * inverse;
    const float sign = task.sign == nullptr ? 1.0f : task.sign[i];
    return {make_float4(x, y, z, exponent), make_float2(task.radius[i] - reference_radius, sign)};
  }
  __device__ Exponents at(Place x) const { return {x.x * inverse, x.y * inverse, x.z * inverse}; }
  __device__ float reach_scale() const { return radius * inverse; }

  // shift: what was taken off the exponents.
  __device__ Distance finish(Place x, float shift, const Sums& s) const {
    const float dx = x.x - (reference.x - middle.x), dy = x.y - (reference.y - middle.y);
    const float dz = x.z - (reference.z - middle.z);
    const float unit = 2.0f * task.length * task.length, scale = 1.0f / s.weight, mean = s.radius * scale;
    const float log_sum = unit * (shift + logf(s.weight));
    const float squared = squared_length(dx, dy, dz) - static_cast<float>(unit * log_weight) - log_sum;
    const float root = sqrtf(squared), mean_radius = reference_radius + mean;
    const bool has_value = root > 0.0f && s.weight > 0.0f && fabsf(mean_radius) <= 1.001f * task.largest_radius;
    if (!has_value) return no_distance();
    const float to[3] = {dx, dy, dz};
    float gradient[3];
    for (int a = 0; a < 3; ++a) {
      const float middle_of = s.first[a] * scale;
      gradient[a] = (to[a] - middle_of) / root + (mean * middle_of - s.second[a] * scale) / task.length / task.length;
    }
    return {root - mean_radius, gradient[0], gradient[1], gradient[2]};
  }
};

// Matern-1/2: the exponent of a term is (o - |x - p|) / l; a term holds p - m and o - o_0.
struct MaternTerms {
  struct Sums {
    float weight = 0.0f, x = 0.0f, y = 0.0f, z = 0.0f;  // and of the weights times the directions away

    template <class Fn>
    __device__ void each(const Fn& fn) {
      fn(weight), fn(x), fn(y), fn(z);
    }
  };
  struct Exponents {
    float x, y, z, from_reference, inverse;
    __device__ float of(const float4& t) const {
      const float squared = squared_length(x - t.x, y - t.y, z - t.z);
      return (from_reference - (squared * inverse_root(squared) - t.w)) * inverse;
    }
    __device__ float reach(const float4&, float radius) const { return 2.0f * radius; }
    __device__ void add(float w, const Term& t, MaternTerms::Sums& sums) const {
      const float dx = x - t.at.x, dy = y - t.at.y, dz = z - t.at.z;
      const float by_distance = w * inverse_root(squared_length(dx, dy, dz));
      sums.weight += w, sums.x += by_distance * dx, sums.y += by_distance * dy, sums.z += by_distance * dz;
    }
    __device__ static float inverse_root(float squared) { return inverse_root_fast(larger(squared, 1e-36f)); }
  };

  const FieldTask& task;
  Point middle, reference;
  float radius, limit, from_reference;
  double offset;

  __device__ MaternTerms(const FieldTask& t, Point m, float around, int lane) : task(t), middle(m), radius(around) {
    const Nearest nearest = find_nearest<LinearScore>(t.spheres, t.offsets, m, lane);
    reference = place_of(t.spheres, nearest.entry);
    offset = t.exact[nearest.entry];
    from_reference = sqrtf(squared_distance(m, reference));
    limit = nearest.score + (t.log_count - logf(t.tolerance)) * t.length + rounding_slack(m, nearest.score);
  }

  __device__ bool keeps(int box) const {
    const Box corners = box_at(task.spheres, box);
    const float near = sqrtf(squared_box_distance(corners, middle));
    const float apart = sqrtf(squared_farthest_corner(corners, reference));
    return near - task.offsets.maximum[box] <= limit + turn(apart, near, from_reference, radius);
  }
  __device__ bool chooses(int i) const {
    const Point p = place_of(task.spheres, i);
    const float d = sqrtf(squared_distance(p, middle)), apart = sqrtf(squared_distance(p, reference));
    return d - task.offsets.value[i] <= limit + turn(apart, d, from_reference, radius);
  }
  __device__ Term term(int i) const {
    const Point p = place_of(task.spheres, i);
    return {make_float4(p.x - middle.x, p.y - middle.y, p.z - middle.z, static_cast<float>(task.exact[i] - offset)),
            make_float2(0.0f, task.sign == nullptr ? 1.0f : task.sign[i])};
  }
  __device__ float from(Place x) const {
    return sqrtf(squared_length(x.x - (reference.x - middle.x), x.y - (reference.y - middle.y),
                                x.z - (reference.z - middle.z)));
  }
  __device__ Exponents at(Place x) const { return {x.x, x.y, x.z, from(x), 1.0f / task.length}; }
  __device__ float reach_scale() const { return radius / task.length; }

  __device__ Distance finish(Place x, float shift, const Sums& s) const {
    if (!(s.weight > 0.0f)) return no_distance();
    const float scale = 1.0f / s.weight, value = from(x) - task.length * (shift + logf(s.weight));
    return {static_cast<float>(value - offset), s.x * scale, s.y * scale, s.z * scale};
  }
};

__device__ inline float weight_of(float exponent) { return exp2_fast(exponent * kLog2e); }

}  // namespace splatctrl
