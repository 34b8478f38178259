#include <algorithm>
#include <limits>
#include <numeric>
#include <stdexcept>

#include "parallel.h"
#include "points.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

constexpr int kLeaf = 8;     // balls that are not split further
constexpr int kAsked = 8;    // nearest centres that count
constexpr int kQueries = 256;  // of a chunk

}  // namespace

// Up to `wanted` balls by the squares of their centres' distances, nearest first.
struct SplatTree::Nearest {
  int wanted, num = 0;
  double bound;  // beyond it nothing is looked for
  double squared[kAsked];
  int ball[kAsked];

  void add(double distance, int which) {
    int at = num < wanted ? num++ : wanted - 1;
    for (; at > 0 && squared[at - 1] > distance; --at) {
      squared[at] = squared[at - 1];
      ball[at] = ball[at - 1];
    }
    squared[at] = distance;
    ball[at] = which;
    if (num == wanted) bound = squared[wanted - 1];
  }
};

SplatTree::SplatTree(const float* centers, const float* radii, int num) : index_(num), axis_(num, 0) {
  for (int i = 0; i < 3 * num; ++i) {
    if (!std::isfinite(centers[i])) throw std::invalid_argument("centers: expected finite numbers");
  }
  std::iota(index_.begin(), index_.end(), 0);
  build(centers, 0, num);
  for (const int ball : index_) {
    for (int k = 0; k < 3; ++k) center_.push_back(centers[3 * static_cast<std::size_t>(ball) + k]);
    radius_.push_back(radii[ball]);
    largest_ = std::max(largest_, static_cast<double>(radii[ball]));
  }
}

// Halves [first, last) at its middle along the axis in which it is longest.
void SplatTree::build(const float* centers, int first, int last) {
  if (last - first <= kLeaf) return;
  int axis = 0;
  float longest = -1.0f;
  for (int k = 0; k < 3; ++k) {
    float low = std::numeric_limits<float>::infinity(), high = -low;
    for (int i = first; i < last; ++i) {
      const float x = centers[3 * static_cast<std::size_t>(index_[i]) + k];
      low = std::min(low, x);
      high = std::max(high, x);
    }
    if (high - low > longest) {
      longest = high - low;
      axis = k;
    }
  }
  const int middle = first + (last - first) / 2;
  std::nth_element(index_.begin() + first, index_.begin() + middle, index_.begin() + last, [&](int a, int b) {
    return centers[3 * static_cast<std::size_t>(a) + axis] < centers[3 * static_cast<std::size_t>(b) + axis];
  });
  axis_[middle] = axis;
  build(centers, first, middle);
  build(centers, middle + 1, last);
}

void SplatTree::look(const double* p, int first, int last, Nearest& found) const {
  const auto ask = [&](int i) {
    const double* c = center_.data() + 3 * static_cast<std::size_t>(i);
    const double x = p[0] - c[0], y = p[1] - c[1], z = p[2] - c[2];
    const double squared = x * x + y * y + z * z;
    if (squared < found.bound) found.add(squared, i);
  };
  if (last - first <= kLeaf) {
    for (int i = first; i < last; ++i) ask(i);
    return;
  }
  const int middle = first + (last - first) / 2, axis = axis_[middle];
  const double beyond = p[axis] - center_[3 * static_cast<std::size_t>(middle) + axis];
  const bool is_low = beyond < 0.0;
  is_low ? look(p, first, middle, found) : look(p, middle + 1, last, found);
  ask(middle);
  if (beyond * beyond >= found.bound) return;
  is_low ? look(p, middle + 1, last, found) : look(p, first, middle, found);
}

void SplatTree::are_further(const double* points, int num_points, double gap, std::uint8_t* out,
                            int num_threads) const {
  const double most = (gap + largest_) * 1.001;
  const auto is_further = [&](const double* p, int wanted) {
    Nearest found;
    found.wanted = wanted;
    found.bound = most * most;
    look(p, 0, size(), found);
    for (int i = 0; i < found.num; ++i) {
      if (!(std::sqrt(found.squared[i]) - radius_[found.ball[i]] > gap)) return false;
    }
    return true;
  };
  parallel_for(parts(num_points, kQueries), num_threads, [&](int chunk) {
    for (int i = chunk * kQueries; i < std::min(num_points, (chunk + 1) * kQueries); ++i) {
      const double* p = points + 3 * static_cast<std::size_t>(i);
      out[i] = is_further(p, 1) && is_further(p, kAsked);  // the nearest settles most
    }
  });
}

}  // namespace splatctrl
