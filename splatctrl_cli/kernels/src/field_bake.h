// Both distances on a regular grid, with exact culling by blocks of 8^3 and 4^3 cells.
#pragma once

#include "field_clusters.h"

namespace splatctrl {

// Cell (i, j, k) is centred at origin + voxel (i, j, k), in the frame of the spheres.
struct GridLayout {
  double origin[3];
  double voxel;
  int size[3];
};

// `soft` has offsets less a common one, which is taken off its distance in double at the end.
// Writes, per cell (last index fastest): hard, the least score of `hard`; soft, the log-sum-exp of `soft` (the same
// centres, other offsets; terms left out make up no more than the share `truncation` of the sum, as in query_soft);
// sdf, the smaller of the two; gradient (3), that of sdf, not normalised.
//
// Culling: with c the centre of a block and R its half-diagonal, |s_i(x) - s_i(c)| <= R in the block. So
// - sphere i can be the nearest somewhere in it only if s_i(c) <= min_j s_j(c) + 2 R;
// - its term there is at most e^(2 R / l) times as large a share of the sum as it is at c. Blocks of 8^3 drop terms that
//   cannot reach truncation / (2 N) each; sub-blocks of 4^3 drop the farthest, while their shares at c, times
//   e^(2 R / l), add up to no more than truncation / 2.
void bake_grid(const Clusters& hard, const Clusters& soft, double soft_common_offset, float length, float truncation,
               const GridLayout& grid, int num_threads, float* sdf_out, float* soft_out, float* hard_out, float* gradient_out);

}  // namespace splatctrl
