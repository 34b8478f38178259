// Points are sorted by the number of their cube, which leaves those of one cube in their order: sums over a cube then
// run in the order of the points, whichever thread takes it.
#include <algorithm>
#include <array>
#include <limits>
#include <memory>

#include "parallel.h"
#include "points.h"
#include "voxel_grid.h"

namespace splatctrl {
namespace {

constexpr int kDigit = 11, kValues = 1 << kDigit;  // bits sorted by at once
constexpr int kPart = 1 << 15;                     // points of a chunk, cubes of a chunk below
constexpr int kCubesAtOnce = 128;
constexpr float kFar = std::numeric_limits<float>::infinity();

struct Numbered {
  std::uint64_t cube;
  std::uint32_t point;
};

using Sorted = std::unique_ptr<Numbered[]>;  // not set to 0: millions

struct Extent {
  float low[3] = {kFar, kFar, kFar}, high[3] = {-kFar, -kFar, -kFar};

  void add(int axis, float x) {
    low[axis] = std::min(low[axis], x);
    high[axis] = std::max(high[axis], x);
  }
};

double cell_of(float x, double edge) { return std::floor(static_cast<double>(x) / edge); }

// The number of the cube of each point: of two cubes the lower x has the lower, then y, then z.
class Numbers {
 public:
  Numbers(const float* points, int num_points, double edge, int num_threads) : edge_(edge) {
    std::vector<Extent> parts_of(std::max(parts(num_points, kPart), 1));
    parallel_for(parts(num_points, kPart), num_threads, [&](int chunk) {
      for (int i = chunk * kPart; i < std::min(num_points, (chunk + 1) * kPart); ++i) {
        for (int k = 0; k < 3; ++k) parts_of[chunk].add(k, points[3 * static_cast<std::size_t>(i) + k]);
      }
    });
    double size[3], all = 1.0;
    for (int k = 0; k < 3; ++k) {
      for (const Extent& part : parts_of) {
        parts_of[0].add(k, part.low[k]);
        parts_of[0].add(k, part.high[k]);
      }
      least_[k] = cell_of(parts_of[0].low[k], edge);
      size[k] = cell_of(parts_of[0].high[k], edge) - least_[k] + 1.0;
      all *= size[k];
    }
    if (all < 4e18) {  // else as far apart as 2^21 cubes along each axis can be
      step_[1] = static_cast<std::uint64_t>(size[2]);
      step_[0] = step_[1] * static_cast<std::uint64_t>(size[1]);
      num_bits_ = 1;
      while (num_bits_ < 63 && static_cast<double>(std::uint64_t{1} << num_bits_) < all) ++num_bits_;
    }
  }

  int num_bits() const { return num_bits_; }

  std::uint64_t operator()(const float* point) const {
    std::uint64_t number = 0;
    for (int k = 0; k < 3; ++k) {
      number += step_[k] * static_cast<std::uint64_t>(static_cast<std::int64_t>(cell_of(point[k], edge_) - least_[k]));
    }
    return number;
  }

 private:
  double edge_, least_[3];
  std::uint64_t step_[3] = {std::uint64_t{1} << 42, std::uint64_t{1} << 21, 1};
  int num_bits_ = 64;
};

// Stable, by `kDigit` bits from `shift` on.
void sort_by(const Sorted& from, const Sorted& to, int num, int shift, int num_threads) {
  const int chunks = parts(num, kPart);
  std::vector<std::array<std::uint32_t, kValues>> place(chunks);
  const auto digit = [shift](const Numbered& one) { return one.cube >> shift & (kValues - 1); };
  parallel_for(chunks, num_threads, [&](int chunk) {
    place[chunk].fill(0);
    for (int i = chunk * kPart; i < std::min(num, (chunk + 1) * kPart); ++i) ++place[chunk][digit(from[i])];
  });
  std::uint32_t next = 0;
  for (int value = 0; value < kValues; ++value) {
    for (auto& of_chunk : place) {
      const std::uint32_t count = of_chunk[value];
      of_chunk[value] = next;
      next += count;
    }
  }
  parallel_for(chunks, num_threads, [&](int chunk) {
    for (int i = chunk * kPart; i < std::min(num, (chunk + 1) * kPart); ++i) to[place[chunk][digit(from[i])]++] = from[i];
  });
}

}  // namespace

Cubes::Cubes(const float* points, int num_points, double edge, int num_threads) : order_(num_points) {
  const Numbers number(points, num_points, edge, num_threads);
  Sorted sorted(new Numbered[num_points]), other(new Numbered[num_points]);
  const int chunks = parts(num_points, kPart);
  const auto last_of = [&](int chunk) { return std::min(num_points, (chunk + 1) * kPart); };
  parallel_for(chunks, num_threads, [&](int chunk) {
    for (int i = chunk * kPart; i < last_of(chunk); ++i) {
      sorted[i] = {number(points + 3 * static_cast<std::size_t>(i)), static_cast<std::uint32_t>(i)};
    }
  });
  for (int shift = 0; shift < number.num_bits(); shift += kDigit) {
    sort_by(sorted, other, num_points, shift, num_threads);
    sorted.swap(other);
  }
  std::vector<std::vector<std::uint32_t>> starts(chunks);
  parallel_for(chunks, num_threads, [&](int chunk) {
    for (int i = chunk * kPart; i < last_of(chunk); ++i) {
      order_[i] = sorted[i].point;
      if (i == 0 || sorted[i].cube != sorted[i - 1].cube) starts[chunk].push_back(static_cast<std::uint32_t>(i));
    }
  });
  for (const auto& some : starts) start_.insert(start_.end(), some.begin(), some.end());
  start_.push_back(static_cast<std::uint32_t>(num_points));
}

void Cubes::members(std::int32_t* of_point, std::int64_t* first, int num_threads) const {
  parallel_for(parts(size(), kCubesAtOnce), num_threads, [&](int chunk) {
    for (int cube = chunk * kCubesAtOnce; cube < std::min(size(), (chunk + 1) * kCubesAtOnce); ++cube) {
      first[cube] = order_[start_[cube]];
      for (std::uint32_t i = start_[cube]; i < start_[cube + 1]; ++i) of_point[order_[i]] = cube;
    }
  });
}

void Cubes::measure(const float* points, const float* colors, const CubeMeans& out, int num_threads) const {
  parallel_for(parts(size(), kCubesAtOnce), num_threads, [&](int chunk) {
    for (int cube = chunk * kCubesAtOnce; cube < std::min(size(), (chunk + 1) * kCubesAtOnce); ++cube) {
      const std::uint32_t first = start_[cube], last = start_[cube + 1];
      const double count = static_cast<double>(last - first);
      double *center = out.center + 3 * cube, *color = out.color + 3 * cube, *square = out.square + 3 * cube;
      double* covariance = out.covariance + 6 * cube;
      out.count[cube] = count;
      std::fill(center, center + 3, 0.0);
      std::fill(color, color + 3, 0.0);
      std::fill(square, square + 3, 0.0);
      std::fill(covariance, covariance + 6, 0.0);
      for (std::uint32_t i = first; i < last; ++i) {
        const std::size_t at = 3 * static_cast<std::size_t>(order_[i]);
        for (int k = 0; k < 3; ++k) {
          const double shade = colors[at + k];
          center[k] += points[at + k];
          color[k] += shade;
          square[k] += shade * shade;
        }
      }
      for (int k = 0; k < 3; ++k) {
        center[k] /= count;
        color[k] /= count;
        square[k] /= count;
      }
      double least = std::numeric_limits<double>::infinity();
      out.nearest[cube] = order_[first];
      for (std::uint32_t i = first; i < last; ++i) {
        const std::size_t at = 3 * static_cast<std::size_t>(order_[i]);
        const double x = points[at] - center[0], y = points[at + 1] - center[1], z = points[at + 2] - center[2];
        const double products[6] = {x * x, x * y, x * z, y * y, y * z, z * z};
        for (int k = 0; k < 6; ++k) covariance[k] += products[k];
        const double squared = x * x + y * y + z * z;
        if (squared < least) {
          least = squared;
          out.nearest[cube] = order_[i];
        }
      }
      for (int k = 0; k < 6; ++k) covariance[k] /= count;
    }
  });
}

}  // namespace splatctrl
