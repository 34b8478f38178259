#include "surface_steps.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

namespace splatctrl {
namespace {

// Of the support in one column of a window: its number, and sums of y, y^2, 1/z, y/z and 1/z^2.
struct ColumnSums {
  double num, y, yy, i, yi, ii;
};

void add_row(std::vector<ColumnSums>& columns, const PlaneImage& image, int row, double sign) {
  const std::size_t first = static_cast<std::size_t>(row) * image.width;
  const double y = row, signed_y = sign * y;
  for (int x = 0; x < image.width; ++x) {
    if (!image.support[first + x]) continue;
    const double inverse = 1.0 / image.depth[first + x], signed_inverse = sign * inverse;
    ColumnSums& sums = columns[x];
    sums.num += sign;
    sums.y += signed_y;
    sums.yy += signed_y * y;
    sums.i += signed_inverse;
    sums.yi += signed_inverse * y;
    sums.ii += signed_inverse * inverse;
  }
}

// How far [1/m] 1 / z of pixel (u, v) lies from the plane of the columns first to last; 0 where there is none.
double off_plane(const std::vector<ColumnSums>& columns, int first, int last, int u, int v, double inverse,
                 const PlaneRule& rule) {
  double num = 0, x = 0, y = 0, i = 0, xx = 0, xy = 0, yy = 0, xi = 0, yi = 0, ii = 0;
  for (int at = first; at <= last; ++at) {  // x and y from the pixel
    const ColumnSums& column = columns[at];
    const double dx = at - u, dy = column.y - v * column.num;
    num += column.num;
    x += dx * column.num;
    y += dy;
    i += column.i;
    xx += dx * dx * column.num;
    xy += dx * dy;
    yy += column.yy - v * (column.y + dy);
    xi += dx * column.i;
    yi += column.yi - v * column.i;
    ii += column.ii;
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
  std::vector<ColumnSums> columns(image.width);
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
