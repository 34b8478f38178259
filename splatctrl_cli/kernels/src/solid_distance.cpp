#include <algorithm>
#include <limits>

#include "parallel.h"
#include "points.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

// Of a point in the solid's own frame.
double distance_to(const SurfaceSolid& solid, const double* p) {
  const double* size = solid.size;
  if (solid.kind == SolidKind::kBall) return std::sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) - size[0];
  double beyond[3];
  int num = 3;
  if (solid.kind == SolidKind::kBox) {
    for (int k = 0; k < 3; ++k) beyond[k] = std::fabs(p[k]) - size[k];
  } else {
    const double across = std::hypot(p[0], p[1]), along = std::fabs(p[2]) - size[1];
    if (solid.kind == SolidKind::kCapsule) return std::hypot(across, std::max(along, 0.0)) - size[0];
    beyond[0] = across - size[0];
    beyond[1] = along;
    num = 2;
  }
  double squared = 0.0;
  for (int k = 0; k < num; ++k) squared += std::max(beyond[k], 0.0) * std::max(beyond[k], 0.0);
  return std::sqrt(squared) + std::min(*std::max_element(beyond, beyond + num), 0.0);
}

}  // namespace

void solid_distance(const double* points, int num_points, const SurfaceSolid* solids, int num_solids, double* distance,
                    int num_threads) {
  parallel_for(parts(num_points, kPointsAtOnce), num_threads, [&](int chunk) {
    for (int i = chunk * kPointsAtOnce; i < std::min(num_points, (chunk + 1) * kPointsAtOnce); ++i) {
      double least = std::numeric_limits<double>::infinity(), p[3];
      for (int k = 0; k < num_solids; ++k) {
        moved(solids[k].turn, solids[k].shift, points + 3 * static_cast<std::size_t>(i), p);
        least = std::min(least, distance_to(solids[k], p));
      }
      distance[i] = least;
    }
  });
}

}  // namespace splatctrl
