// Distances and gradients at points: the exact one, and the log-sum-exp of the Matern field.
#pragma once

#include "field_clusters.h"

namespace splatctrl {

// Score and its gradient at Q points (Q, 3): min_i s_i(x).
void query_nearest(const Clusters& spheres, const float* points, int num_points, int num_threads, float* score,
                   float* gradient);

// -l log sum_i exp(-s_i(x) / l) and its gradient. Terms may be left out that together make up no more than the share
// `truncation` of the sum: the result is then too large by at most -l log(1 - truncation).
void query_soft(const Clusters& spheres, float length, float truncation, const float* points, int num_points,
                int num_threads, float* score, float* gradient);

}  // namespace splatctrl
