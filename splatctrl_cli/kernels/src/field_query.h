// Distances and gradients at points: the exact one, and the log-sum-exps of the two kernels.
#pragma once

#include "field_clusters.h"

namespace splatctrl {

// What is asked at Q points (Q, 3), and where the answers go: score (Q) and its gradient (Q, 3).
struct Query {
  const float* points;
  int num_points, num_threads;
  float *score, *gradient;
};

// min_i s_i(x); entry (Q): which sphere has it.
void query_nearest(const Clusters& spheres, const Offsets& radii, const Query& query, int* entry);

// -l log sum_i c_i exp(-s_i(x) / l), c_i = sign (16 C) or 1 where it is null. Terms may be left out that together make
// up no more than the share `truncation` of the sum of all |terms|: without signs the result is too large by at most
// -l log(1 - truncation). NaN where the sum is not positive.
void query_matern(const Clusters& spheres, const Offsets& offsets, const float* sign, float length, float truncation,
                  const Query& query);

// With L = log sum_i c_i exp(-q_i(x) / (2 l^2)), b_i = 2 l^2 log w_i less `common`: sqrt(-2 l^2 L - common) less the mean
// of the radii (16 C) under the terms. Without signs the terms left out raise it by at most `tolerance`. NaN where the
// root has no positive argument, and, with signs, where the mean is beyond all radii.
void query_gaussian(const Clusters& spheres, const Offsets& offsets, const float* radii, const float* sign, double common,
                    float length, float tolerance, const Query& query);

// The least of query_gaussian and query_nearest, and its gradient; the exact one where they are equal or the other has
// no value. radii: those of query_gaussian too.
void query_safe(const Clusters& spheres, const Offsets& offsets, const Offsets& radii, const float* sign, double common,
                float length, float tolerance, const Query& query);

inline float largest_of(const float* values, int count) {
  float largest = 0.0f;
  for (int i = 0; i < count; ++i) largest = values[i] > largest ? values[i] : largest;
  return largest;
}

}  // namespace splatctrl
