// Row sums of the kernel matrix: how dense the spheres are around each of them.
#pragma once

#include "field_clusters.h"

namespace splatctrl {

enum class Kernel { kMatern, kGaussian };

// sum (16 C): sum_j k(p_i, p_j) over all spheres, j = i included; zero for spare entries. has_sphere (16 C).
//
// Terms are rounded to 2^-24 and added as integers, so that the bits of a sum depend on the distances alone, not on
// the order of the spheres or the number of threads. A term is off by at most 2^-25; those smaller are left out.
void row_sums(const Clusters& spheres, const unsigned char* has_sphere, Kernel kernel, float length, int num_threads,
              double* sum);

}  // namespace splatctrl
