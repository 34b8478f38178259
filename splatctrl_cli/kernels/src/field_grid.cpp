#include "field_grid.h"

#include <algorithm>
#include <cmath>

namespace splatctrl {
namespace {

// The cell of a point, and where in it the nearest point of the box lies.
struct Place {
  long first[3];       // lowest corner
  double fraction[3];  // in [0, 1] along each axis
  double beyond[3];    // point less the nearest point of the box [m]
};

Place locate(const GridView& grid, const double* point) {
  Place place;
  for (int a = 0; a < 3; ++a) {
    const double last = static_cast<double>(grid.size[a] - 1);
    const double node = (point[a] - grid.origin[a]) / grid.voxel;
    const double inside = std::min(std::max(node, 0.0), last);
    place.first[a] = std::min(static_cast<long>(inside), grid.size[a] - 2);
    place.fraction[a] = inside - static_cast<double>(place.first[a]);
    place.beyond[a] = (node - inside) * grid.voxel;
  }
  return place;
}

double corner_value(const GridView& grid, const Place& place, int corner) {
  const long i = place.first[0] + (corner >> 2), j = place.first[1] + ((corner >> 1) & 1);
  return grid.values[(i * grid.size[1] + j) * grid.size[2] + place.first[2] + (corner & 1)];
}

}  // namespace

void interpolate_grid(const GridView& grid, const double* points, long num_points, double* value, double* gradient) {
  for (long q = 0; q < num_points; ++q) {
    const Place place = locate(grid, points + 3 * q);
    double sum = 0.0, slope[3] = {0.0, 0.0, 0.0};
    for (int corner = 0; corner < 8; ++corner) {
      double along[3], change[3];
      for (int a = 0; a < 3; ++a) {
        const bool is_upper = (corner >> (2 - a)) & 1;
        along[a] = is_upper ? place.fraction[a] : 1.0 - place.fraction[a];
        change[a] = (is_upper ? 1.0 : -1.0) / grid.voxel;
      }
      const double v = corner_value(grid, place, corner);
      sum += v * along[0] * along[1] * along[2];
      slope[0] += v * change[0] * along[1] * along[2];
      slope[1] += v * along[0] * change[1] * along[2];
      slope[2] += v * along[0] * along[1] * change[2];
    }
    const double *b = place.beyond, gap = std::sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2]);
    value[q] = sum - gap;
    for (int a = 0; a < 3; ++a) gradient[3 * q + a] = b[a] == 0.0 ? slope[a] : -b[a] / gap;
  }
}

void bound_grid(const GridView& grid, const double* points, long num_points, double* bound) {
  for (long q = 0; q < num_points; ++q) {
    const Place place = locate(grid, points + 3 * q);
    double best = -INFINITY;
    for (int corner = 0; corner < 8; ++corner) {
      double squared = 0.0;
      for (int a = 0; a < 3; ++a) {
        const long node = place.first[a] + ((corner >> (2 - a)) & 1);
        const double step = points[3 * q + a] - (grid.origin[a] + grid.voxel * static_cast<double>(node));
        squared += step * step;
      }
      best = std::max(best, corner_value(grid, place, corner) - std::sqrt(squared));
    }
    bound[q] = best;
  }
}

}  // namespace splatctrl
