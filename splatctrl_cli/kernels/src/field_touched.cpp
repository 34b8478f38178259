#include <algorithm>
#include <type_traits>

#include "field_bake.h"

namespace splatctrl {
namespace {

constexpr float kBlockExponent = 30.0f;  // as bake_gaussian

struct Work {
  Candidates found;
};

template <typename Score>
bool has_changed(const Clusters& s, const Offsets& o, const unsigned char* changed, Point c, float limit, float radius, Point p0, float d0) {
  constexpr bool is_linear = std::is_same_v<Score, LinearScore>;
  for (int cluster = 0; cluster < s.num_clusters; cluster += 8) {
    const Float8 near = box_distances(s, cluster, c), far = farthest_corners(s, cluster, p0);
    const Float8 room = is_linear ? turn(far, near, d0, radius) : 2.0f * radius * far;
    unsigned kept = signs8(Score::of(near * near, load8(o.maximum + cluster)) <= limit + room);
    for (; kept != 0; kept &= kept - 1) {
      const int begin = kLanes * (cluster + __builtin_ctz(kept));
      for (int i = begin; i < begin + kLanes; ++i) {
        if (!changed[i]) continue;
        const Float8 d = center_distances(s, i & ~7, c), apart = center_distances(s, i & ~7, p0);
        const Float8 space = is_linear ? turn(apart, d, d0, radius) : 2.0f * radius * apart;
        if ((Score::of(d * d, load8(o.value + (i & ~7))) <= limit + space)[i & 7]) return true;
      }
    }
  }
  return false;
}

template <typename Score>
void mark(const Clusters& s, const Offsets& o, const unsigned char* changed, float length, const GridSpan& grid, unsigned char* is_touched) {
  const float radius = grid.radius(kBlock);
  for_each_block<Work>(grid, [&](const int* block, Work& work) {
    const Point c = middle(grid, block, kBlock);
    const Nearest nearest = find_nearest<Score>(s, o, c, work.found);
    const Point p0{s.x[nearest.entry], s.y[nearest.entry], s.z[nearest.entry]};
    const float dx = p0.x - c.x, dy = p0.y - c.y, dz = p0.z - c.z, d0 = std::sqrt(dx * dx + dy * dy + dz * dz);
    const float slack = rounding_slack(c, std::fabs(nearest.score) + radius);
    const float limit = nearest.score + kBlockExponent * 2.0f * length * length + 2.0f * slack;
    const long index = (static_cast<long>(block[0] / kBlock) * grid.blocks(1) + block[1] / kBlock) * grid.blocks(2) + block[2] / kBlock;
    if (has_changed<Score>(s, o, changed, c, limit, radius, p0, d0)) is_touched[index] = 1;
  });
}

}  // namespace

void touched_blocks(const Clusters& spheres, const Offsets& offsets, const unsigned char* changed, float length,
                    const GridSpan& grid, unsigned char* is_touched) {
  if (length > 0.0f)
    mark<SquaredScore>(spheres, offsets, changed, length, grid, is_touched);
  else
    mark<LinearScore>(spheres, offsets, changed, length, grid, is_touched);
}

}  // namespace splatctrl
