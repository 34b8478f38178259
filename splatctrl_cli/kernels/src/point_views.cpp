#include <algorithm>
#include <numeric>

#include "parallel.h"
#include "points.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

constexpr int kLanes = 64;  // points projected together

// Rounded pixels u, v of up to kLanes points, and their depths z [m].
template <typename Scalar>
void project(const Scalar* points, int num, const NearestDepth& view, double* u, double* v, double* z) {
  for (int i = 0; i < num; ++i) {
    const double p[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    double q[3];
    moved(view.rotation, view.translation, p, q);
    u[i] = std::floor(view.fx * q[0] / q[2] + view.cx + 0.5);
    v[i] = std::floor(view.fy * q[1] / q[2] + view.cy + 0.5);
    z[i] = q[2];
  }
}

// Marks those of up to kLanes points that a view sees through.
void mark(const float* points, int num, const NearestDepth& view, float tolerance, std::uint8_t* is_seen_through) {
  double u[kLanes], v[kLanes], z[kLanes];
  project(points, num, view, u, v, z);
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

void mark_inside(const ChosenDepth& image, const double* low, const double* high, float min_range,
                 std::uint8_t* is_inside, int num_threads) {
  parallel_for(parts(image.height, kRows), num_threads, [&](int chunk) {
    const std::size_t end = static_cast<std::size_t>(std::min((chunk + 1) * kRows, image.height)) * image.width;
    for (std::size_t pixel = static_cast<std::size_t>(chunk) * kRows * image.width; pixel < end; ++pixel) {
      const float z = image.depth[pixel];
      is_inside[pixel] = z > 0.0f && z >= min_range;
      if (!is_inside[pixel]) continue;
      double p[3];
      back_project_pixel(image, pixel, p);
      for (int k = 0; k < 3; ++k) is_inside[pixel] &= p[k] >= low[k] && p[k] <= high[k];
    }
  });
}

void pixels_at(const double* points, int num_points, const NearestDepth& view, std::int64_t* pixel, float* depth) {
  double u[kLanes], v[kLanes], z[kLanes];
  for (int first = 0; first < num_points; first += kLanes) {
    const int num = std::min(kLanes, num_points - first);
    project(points + 3 * static_cast<std::size_t>(first), num, view, u, v, z);
    for (int i = 0; i < num; ++i) {
      depth[first + i] = static_cast<float>(z[i]);
      const bool is_in = depth[first + i] > 0.0f && u[i] >= 0.0 && u[i] < view.width && v[i] >= 0.0 &&
                         v[i] < view.height;
      pixel[first + i] = is_in ? static_cast<std::int64_t>(v[i]) * view.width + static_cast<std::int64_t>(u[i]) : -1;
    }
  }
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
