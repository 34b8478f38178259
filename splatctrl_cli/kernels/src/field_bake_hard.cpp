#include "field_bake.h"

namespace splatctrl {
namespace {

// Spheres that can be the nearest somewhere in a block or sub-block, relative to its middle.
struct SphereList {
  std::vector<float> x, y, z, offset;
  std::vector<int> entry;
  int size = 0;

  void reserve(int n) {
    if (static_cast<int>(x.size()) >= n) return;
    for (auto* values : {&x, &y, &z, &offset}) values->resize(2 * n);
    entry.resize(2 * n);
  }
  void add(float px, float py, float pz, float o, int i) {
    reserve(size + 8);
    x[size] = px, y[size] = py, z[size] = pz, offset[size] = o, entry[size] = i;
    ++size;
  }
  // Fills up the last eight with spheres that are nowhere near.
  void pad() {
    reserve(size + 8);
    for (int i = size; i % 8 != 0; ++i) x[i] = y[i] = z[i] = 1e15f, offset[i] = -1e30f, entry[i] = -1;
  }
};

struct Work {
  Candidates found;
  SphereList block, sub_block;
  std::vector<float> scores;
};

float distance(Point a, Point b) {
  const float x = a.x - b.x, y = a.y - b.y, z = a.z - b.z;
  return std::sqrt(x * x + y * y + z * z);
}

Float8 distances(Float8 dx, Float8 dy, Float8 dz) { return sqrt8(dx * dx + dy * dy + dz * dz); }

// The reference of a block: the sphere nearest to its middle.
struct Reference {
  Point place, middle;
  float score, distance, radius, slack;

  // True where something at these distances (lower bounds) and scores can beat the reference in the block; apart: its
  // distance from the reference (an upper bound).
  Int8 may_be_beaten(Float8 scores, Float8 distances, Float8 apart) const {
    return scores - score <= turn(apart, distances, distance, radius) + slack;
  }
};

void collect(const Clusters& s, const Offsets& o, const Reference& ref, const Candidates& found, SphereList& list) {
  list.size = 0;
  const float limit = ref.score + 2.0f * ref.radius + ref.slack;
  const int groups = s.num_clusters / kLanes;
  for (int g = 0; g < groups; ++g) {
    if (!(found.group_bounds[g] <= limit)) continue;
    for (int cluster = kLanes * g; cluster < kLanes * (g + 1); cluster += 8) {
      const Float8 near = box_distances(s, cluster, ref.middle);
      unsigned kept = signs8(ref.may_be_beaten(near - load8(o.maximum + cluster), near, farthest_corners(s, cluster, ref.place)));
      for (; kept != 0; kept &= kept - 1) {
        const int c = cluster + __builtin_ctz(kept);
        for (int entry = kLanes * c; entry < kLanes * (c + 1); entry += 8) {
          const Float8 x = load8(s.x + entry), y = load8(s.y + entry), z = load8(s.z + entry);
          const Float8 d = distances(x - ref.middle.x, y - ref.middle.y, z - ref.middle.z);
          const Float8 apart = distances(x - ref.place.x, y - ref.place.y, z - ref.place.z);
          unsigned chosen = signs8(ref.may_be_beaten(d - load8(o.value + entry), d, apart));
          for (; chosen != 0; chosen &= chosen - 1) {
            const int i = entry + __builtin_ctz(chosen);
            list.add(s.x[i] - ref.middle.x, s.y[i] - ref.middle.y, s.z[i] - ref.middle.z, o.value[i], i);
          }
        }
      }
    }
  }
  list.pad();
}

// The spheres of `from` that can be the nearest in the sub-block of this radius around `middle`.
void narrow(const SphereList& from, Point middle, float radius, float slack, std::vector<float>& scores, SphereList& list) {
  scores.resize(from.x.size());
  float least = kFar;
  int nearest = 0;
  for (int i = 0; i < from.size; i += 8) {
    const Float8 d = distances(load8(&from.x[i]) - middle.x, load8(&from.y[i]) - middle.y, load8(&from.z[i]) - middle.z);
    store8(&scores[i], d - load8(&from.offset[i]));
  }
  for (int i = 0; i < from.size; ++i)
    if (scores[i] < least) least = scores[i], nearest = i;
  const Point place{from.x[nearest], from.y[nearest], from.z[nearest]};
  const Reference ref{place, middle, least, least + from.offset[nearest], radius, slack};
  list.size = 0;
  for (int i = 0; i < from.size; i += 8) {
    const Float8 x = load8(&from.x[i]), y = load8(&from.y[i]), z = load8(&from.z[i]), score = load8(&scores[i]);
    const Float8 apart = distances(x - place.x, y - place.y, z - place.z);
    unsigned chosen = signs8(ref.may_be_beaten(score, score + load8(&from.offset[i]), apart));
    for (; chosen != 0; chosen &= chosen - 1) {
      const int k = i + __builtin_ctz(chosen);
      list.add(from.x[k] - middle.x, from.y[k] - middle.y, from.z[k] - middle.z, from.offset[k], from.entry[k]);
    }
  }
}

void write_nearest(const SphereList& list, const Slab& slab, const Int8 nearest[2], const GridSpan& grid, const int* lowest,
                   int plane, float* gradient, int* entry) {
  for (int lane = 0; lane < kLanes; ++lane) {
    const int j = lowest[1] + lane / kSubBlock, k = lowest[2] + lane % kSubBlock, i = nearest[lane / 8][lane % 8];
    if (j >= grid.size[1] || k >= grid.size[2]) continue;
    const long cell = grid.cell(lowest[0] + plane, j, k);
    if (entry != nullptr) entry[cell] = list.entry[i];
    if (gradient == nullptr) continue;
    const float dx = slab.x - list.x[i], dy = slab.y[lane / 8][lane % 8] - list.y[i];
    const float dz = slab.z[lane / 8][lane % 8] - list.z[i];
    const float d = std::sqrt(dx * dx + dy * dy + dz * dz), scale = d > 0.0f ? 1.0f / d : 0.0f;
    gradient[3 * cell] = scale * dx, gradient[3 * cell + 1] = scale * dy, gradient[3 * cell + 2] = scale * dz;
  }
}

void bake_sub_block(const SphereList& list, const GridSpan& grid, const int* lowest, float* hard, float* gradient, int* entry) {
  for (int plane = 0; plane < kSubBlock && lowest[0] + plane < grid.last; ++plane) {
    const Slab slab = slab_of(grid, plane);
    Float8 best[2] = {splat8(kFar), splat8(kFar)};
    Int8 nearest[2] = {};
    for (int i = 0; i < list.size; ++i) {
      const float dx = slab.x - list.x[i], xx = dx * dx;
      for (int h = 0; h < 2; ++h) {
        const Float8 dy = slab.y[h] - list.y[i], dz = slab.z[h] - list.z[i];
        const Float8 score = sqrt8(dy * dy + dz * dz + xx) - list.offset[i];
        const Int8 is_less = score < best[h];
        nearest[h] = is_less ? Int8{} + i : nearest[h];
        best[h] = min8(score, best[h]);
      }
    }
    float values[kLanes];
    store8(values, best[0]);
    store8(values + 8, best[1]);
    write_slab(grid, lowest, plane, values, hard, 1);
    if (gradient != nullptr || entry != nullptr) write_nearest(list, slab, nearest, grid, lowest, plane, gradient, entry);
  }
}

Reference reference_at(const Clusters& s, const Offsets& o, const GridSpan& grid, const int* block, Candidates& found) {
  const Point c = middle(grid, block, kBlock);
  const Nearest nearest = find_nearest<LinearScore>(s, o, c, found);
  const Point place{s.x[nearest.entry], s.y[nearest.entry], s.z[nearest.entry]};
  const float radius = grid.radius(kBlock);
  return {place, c, nearest.score, distance(place, c), radius, rounding_slack(c, std::fabs(nearest.score) + radius)};
}

}  // namespace

void bake_hard(const Clusters& spheres, const Offsets& radii, const GridSpan& grid, float* hard, float* gradient, int* entry) {
  for_each_block<Work>(grid, [&](const int* block, Work& work) {
    const Reference ref = reference_at(spheres, radii, grid, block, work.found);
    collect(spheres, radii, ref, work.found, work.block);
    for_each_sub_block(grid, block, [&](const int* lowest) {
      const Point inside = middle_from(grid, lowest, kSubBlock, ref.middle);
      narrow(work.block, inside, grid.radius(kSubBlock), ref.slack, work.scores, work.sub_block);
      bake_sub_block(work.sub_block, grid, lowest, hard, gradient, entry);
    });
  });
}

}  // namespace splatctrl
