// Trilinear interpolation of a baked channel, and the gradient of that very interpolant.
#pragma once

namespace splatctrl {

// Values (X, Y, Z) at the nodes origin + voxel (i, j, k); every size is at least 2.
struct GridView {
  const float* values;
  long size[3];
  double origin[3], voxel;
};

// Per point (Q, 3): the interpolated value and its gradient. Outside the box of the nodes: the value at the nearest
// point of the box less the distance to it, which stays below a 1-Lipschitz function that the interpolant stays below.
void interpolate_grid(const GridView& grid, const double* points, long num_points, double* value, double* gradient);

// Per point: max over the corners of its cell of (value - |x - corner|), the greatest lower bound that the corners give
// for a 1-Lipschitz function; outside the box the corners are those of the nearest cell.
void bound_grid(const GridView& grid, const double* points, long num_points, double* bound);

}  // namespace splatctrl
