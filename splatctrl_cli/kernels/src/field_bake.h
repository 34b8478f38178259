// The distances of field_query.h at every cell of a grid, faster: spheres are culled by blocks of cells.
//
// Each block's result in bake_hard and bake_gaussian depends on the spheres that can matter in it and on their order,
// never on the others: the same block of two scenes that differ elsewhere has the same bits, if the order of the spheres
// they share is the same.
#pragma once

#include "field_blocks.h"

namespace splatctrl {

// hard (X, Y, Z): min_i |x - p_i| - r_i. gradient (X, Y, Z, 3) and entry (X, Y, Z), the sphere that has it, where they
// are not null.
//
// With s_0 the least score at the middle c of a block of radius R, sphere i can be the nearest in it only if
// s_i(c) - s_0(c) <= turn(...): exact, and far tighter than 2 R where the block is far from both.
void bake_hard(const Clusters& spheres, const Offsets& radii, const GridSpan& grid, float* hard, float* gradient, int* entry);

// Per sphere: what bake_gaussian needs beside the place. log_weight (16 C) log |w_i|; radius (16 C); sign (16 C) or null.
struct GaussianTerms {
  const double* log_weight;
  const float* radius;
  const float* sign;
};

// As query_gaussian. offsets: 2 l^2 log |w_i| less any constant; they only cull.
//
// Exponents of one kernel differ by a linear function: E_i(x) - E_0(x) = E_i(c) - E_0(c) + (x - c).(p_i - p_0) / l^2. So the
// largest of it over a block is known exactly, the sum over a block factors into exponentials along x, y and z, and
// with the largest term at the block's middle as reference the sum cannot underflow anywhere in it. Where a factor
// could overflow, each cell is summed from its own largest term.
void bake_gaussian(const Clusters& spheres, const Offsets& offsets, const GaussianTerms& terms, float length,
                   float tolerance, const GridSpan& grid, float* distance, float* gradient);

// As query_matern, but off by up to -l log(1 - truncation) either way. offset (16 C): o_i in double; offsets: the same
// less any constant; they only cull.
//
// Half of the truncation goes to terms left out; a quarter to neighbouring spheres taken together where they look alike
// (field_groups.h), which each cell checks against the errors' bounds, and takes the spheres one by one where it must; a
// quarter to distances taken as parabolas along the columns of a block, where their third and fourth order allow it.
void bake_matern(const Clusters& spheres, const Offsets& offsets, const double* offset, const float* sign, float length,
                 float truncation, const GridSpan& grid, float* distance, float* gradient);

// changed (16 C) marks spheres; is_touched (blocks of the grid): set to 1 where a marked sphere can matter in bake_hard
// (length 0) or in bake_gaussian. `offsets` are the radii, or 2 l^2 log |w_i| less any constant.
void touched_blocks(const Clusters& spheres, const Offsets& offsets, const unsigned char* changed, float length,
                    const GridSpan& grid, unsigned char* is_touched);

}  // namespace splatctrl
