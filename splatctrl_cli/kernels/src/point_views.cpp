#include <algorithm>
#include <numeric>

#include "parallel.h"
#include "points.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

constexpr int kLanes = 64;  // points projected together

// Marks those of up to kLanes points that a view sees through.
void mark(const float* points, int num, const NearestDepth& view, float tolerance, std::uint8_t* is_seen_through) {
  double u[kLanes], v[kLanes], z[kLanes];
  for (int i = 0; i < num; ++i) {
    const double p[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    double q[3];
    moved(view.rotation, view.translation, p, q);
    u[i] = std::floor(view.fx * q[0] / q[2] + view.cx + 0.5);
    v[i] = std::floor(view.fy * q[1] / q[2] + view.cy + 0.5);
    z[i] = q[2];
  }
  for (int i = 0; i < num; ++i) {
    if (!(z[i] > 0.0 && u[i] >= 0.0 && u[i] < view.width && v[i] >= 0.0 && v[i] < view.height)) continue;
    const float nearest = view.depth[static_cast<std::size_t>(v[i]) * view.width + static_cast<std::size_t>(u[i])];
    if (std::isfinite(nearest) && z[i] < static_cast<double>(nearest - tolerance)) is_seen_through[i] = 1;
  }
}

constexpr int kRows = 16;  // of an image, of a chunk

}  // namespace

void back_project(const ChosenDepth& image, double* points, int num_threads) {
  const int chunks = parts(image.height, kRows);
  const auto begin_of = [&](int chunk) { return static_cast<std::size_t>(std::min(chunk * kRows, image.height)) * image.width; };
  std::vector<std::size_t> first(chunks + 1, 0);  // of each chunk's points
  parallel_for(chunks, num_threads, [&](int chunk) {
    const std::size_t begin = begin_of(chunk), end = begin_of(chunk + 1);
    first[chunk + 1] = end - begin;
    if (image.chosen) first[chunk + 1] -= std::count(image.chosen + begin, image.chosen + end, 0);
  });
  std::partial_sum(first.begin(), first.end(), first.begin());
  parallel_for(chunks, num_threads, [&](int chunk) {
    double* out = points + 3 * first[chunk];
    for (std::size_t pixel = begin_of(chunk); pixel < begin_of(chunk + 1); ++pixel) {
      if (image.chosen && !image.chosen[pixel]) continue;
      back_project_pixel(image, pixel, out);
      out += 3;
    }
  });
}

void seen_through(const float* points, int num_points, const NearestDepth* views, int num_views, float tolerance,
                  std::uint8_t* is_seen_through, int num_threads) {
  parallel_for(parts(num_points, kPointsAtOnce), num_threads, [&](int chunk) {
    const int last = std::min(num_points, (chunk + 1) * kPointsAtOnce);
    std::fill(is_seen_through + chunk * kPointsAtOnce, is_seen_through + last, 0);
    for (int view = 0; view < num_views; ++view) {
      for (int i = chunk * kPointsAtOnce; i < last; i += kLanes) {
        mark(points + 3 * static_cast<std::size_t>(i), std::min(kLanes, last - i), views[view], tolerance,
             is_seen_through + i);
      }
    }
  });
}

}  // namespace splatctrl
