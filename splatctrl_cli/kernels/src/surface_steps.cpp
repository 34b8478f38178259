#include "surface_steps.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace splatctrl {
namespace {

// Of the support in each column of a window: its number, and sums of y, y^2, 1/z, y/z and 1/z^2.
struct ColumnSums {
  std::vector<double> num, y, yy, i, yi, ii;

  explicit ColumnSums(int width) : num(width), y(width), yy(width), i(width), yi(width), ii(width) {}
};

void add_row(ColumnSums& sums, const PlaneImage& image, int row, double sign) {
  const std::size_t first = static_cast<std::size_t>(row) * image.width;
  const float* depth = image.depth + first;
  const std::uint8_t* support = image.support + first;
  const double y = row, signed_y = sign * y, signed_yy = signed_y * y;
  double *num = sums.num.data(), *sum_y = sums.y.data(), *yy = sums.yy.data();
  double *i = sums.i.data(), *yi = sums.yi.data(), *ii = sums.ii.data();
#pragma GCC ivdep
  for (int x = 0; x < image.width; ++x) {
    const double inverse = support[x] ? 1.0 / depth[x] : 0.0, signed_inverse = sign * inverse;
    num[x] += support[x] ? sign : 0.0;
    sum_y[x] += support[x] ? signed_y : 0.0;
    yy[x] += support[x] ? signed_yy : 0.0;
    i[x] += signed_inverse;
    yi[x] += signed_inverse * y;
    ii[x] += signed_inverse * inverse;
  }
}

// How far [1/m] 1 / z of pixel (u, v) lies from the plane of the columns first to last; 0 where there is none.
double off_plane(const ColumnSums& sums, int first, int last, int u, int v, double inverse,
                 const PlaneRule& rule) {
  double num = 0, x = 0, y = 0, i = 0, xx = 0, xy = 0, yy = 0, xi = 0, yi = 0, ii = 0;
  for (int at = first; at <= last; ++at) {  // x and y from the pixel
    const double dx = at - u, dy = sums.y[at] - v * sums.num[at];
    num += sums.num[at];
    x += dx * sums.num[at];
    y += dy;
    i += sums.i[at];
    xx += dx * dx * sums.num[at];
    xy += dx * dy;
    yy += sums.yy[at] - v * (sums.y[at] + dy);
    xi += dx * sums.i[at];
    yi += sums.yi[at] - v * sums.i[at];
    ii += sums.ii[at];
  }
  if (num < 3) return 0.0;
  x /= num, y /= num, i /= num;
  xx = xx / num - x * x, xy = xy / num - x * y, yy = yy / num - y * y;
  xi = xi / num - x * i, yi = yi / num - y * i, ii = ii / num - i * i;
  const double det = xx * yy - xy * xy;
  if (det < 1e-9) return 0.0;  // on one line
  const double by_x = (yy * xi - xy * yi) / det, by_y = (xx * yi - xy * xi) / det;
  const double variance = (1.0 + (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det) / num;
  if (variance > rule.variance || ii - by_x * xi - by_y * yi > rule.residual) return 0.0;
  return std::abs(inverse - (i - by_x * x - by_y * y));
}

}  // namespace

void surface_steps(const PlaneImage& image, int reach, const PlaneRule& rule, float* steps) {
  ColumnSums columns(image.width);
  for (int row = 0; row < std::min(reach, image.height); ++row) add_row(columns, image, row, 1.0);
  for (int v = 0; v < image.height; ++v) {
    if (v + reach < image.height) add_row(columns, image, v + reach, 1.0);
    if (v > reach) add_row(columns, image, v - reach - 1, -1.0);
    for (int u = 0; u < image.width; ++u) {
      const std::size_t at = static_cast<std::size_t>(v) * image.width + u;
      if (!image.asked[at]) continue;
      const int first = std::max(u - reach, 0), last = std::min(u + reach, image.width - 1);
      const double z = image.depth[at];
      const double off = off_plane(columns, first, last, u, v, 1.0 / z, rule) * z * z;
      if (off > image.tolerance[at]) steps[at] = std::min(steps[at], static_cast<float>(0.5 * off));
    }
  }
}

}  // namespace splatctrl
