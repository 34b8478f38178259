// The fields at the cells of a grid: a warp for 4^3 cells, two for each lane. It lists the spheres that count there in
// shared memory; where they are more than fit, it works through the list and goes on.
#pragma once

#include "field_terms.cuh"

namespace splatctrl {

constexpr int kRoom = 256;  // spheres of a list

// 4^3 cells, the middle of their centres, and a lane's two.
struct Cells {
  int lowest[3];
  bool is_there;
  Point middle;
  Place place[2];  // relative to the middle

  __device__ Cells(const GridSpan& grid, int index, int lane) {
    const int num_y = (grid.size[1] + kSubBlock - 1) / kSubBlock, num_z = (grid.size[2] + kSubBlock - 1) / kSubBlock;
    lowest[0] = grid.first + kSubBlock * (index / (num_y * num_z));
    lowest[1] = kSubBlock * (index / num_z % num_y), lowest[2] = kSubBlock * (index % num_z);
    is_there = lowest[0] < grid.last;
    middle = splatctrl::middle(grid, lowest, kSubBlock);
    const Point beside = middle_from(grid, lowest, kSubBlock, middle);  // what its float lost
    const auto voxel = static_cast<float>(grid.voxel);
    for (int h = 0; h < 2; ++h) {
      place[h].x = beside.x + voxel * (static_cast<float>(lane / 16 + 2 * h) - 1.5f);
      place[h].y = beside.y + voxel * (static_cast<float>(lane / 4 % 4) - 1.5f);
      place[h].z = beside.z + voxel * (static_cast<float>(lane % 4) - 1.5f);
    }
  }

  // Where cell h of a lane stands in the arrays; -1 beyond the grid.
  __device__ long at(const GridSpan& grid, int h, int lane) const {
    const int i = lowest[0] + lane / 16 + 2 * h, j = lowest[1] + lane / 4 % 4, k = lowest[2] + lane % 4;
    return i < grid.last && j < grid.size[1] && k < grid.size[2] ? grid.cell(i, j, k) : -1;
  }
};

// Spheres that can be the nearest within a radius of the middle; see bake_hard of the processor.
struct NearSpheres {
  const FieldTask& task;
  Point middle, reference;
  float score, distance, radius, slack;

  __device__ NearSpheres(const FieldTask& t, Point m, float around, int lane) : task(t), middle(m), radius(around) {
    const Nearest nearest = find_nearest<LinearScore>(t.spheres, t.offsets, m, lane);
    reference = place_of(t.spheres, nearest.entry), score = nearest.score;
    distance = sqrtf(squared_distance(m, reference));
    slack = rounding_slack(m, size_of(score) + radius);
  }
  __device__ bool may_be_beaten(float other, float near, float apart) const {
    return other - score <= turn(apart, near, distance, radius) + slack;
  }
  __device__ bool keeps(int box) const {
    const Box corners = box_at(task.spheres, box);
    const float near = sqrtf(squared_box_distance(corners, middle));
    return may_be_beaten(near - task.offsets.maximum[box], near, sqrtf(squared_farthest_corner(corners, reference)));
  }
  __device__ bool chooses(int i) const {
    const Point p = place_of(task.spheres, i);
    const float d = sqrtf(squared_distance(p, middle));
    return may_be_beaten(d - task.offsets.value[i], d, sqrtf(squared_distance(p, reference)));
  }
};

// Calls put(entry, place in the list) for what `from` chooses, and flush(size) whenever the list is full and at the end.
template <class From, class Put, class Flush>
__device__ void through_list(const From& from, int lane, const Put& put, const Flush& flush) {
  Chosen chosen;
  walk(from.task.spheres, lane, [&](int box) { return from.keeps(box); }, [&](int i) {
    const bool counts = i >= 0 && from.chooses(i);
    const int at = chosen.place(counts, lane);
    if (counts) put(i, at);
    if (chosen.size <= kRoom - kWarp) return;
    __syncwarp();
    flush(chosen.size);
    __syncwarp();
    chosen.size = 0;
  });
  __syncwarp();
  flush(chosen.size);
}

extern "C" __global__ __launch_bounds__(kWarp* kWarps) void bake_hard(const FieldTask* given) {
  __shared__ float4 listed[kWarps][kRoom];
  __shared__ int entries[kWarps][kRoom];
  const FieldTask& task = *given;
  const int lane = lane_of_thread(), warp = static_cast<int>(threadIdx.x) / kWarp;
  const Cells cells(task.grid, warp_of_grid(), lane);
  if (!cells.is_there) return;
  const NearSpheres near(task, cells.middle, task.grid.radius(kSubBlock), lane);
  float least[2] = {kFar, kFar};
  int entry[2] = {0, 0};
  through_list(
      near, lane,
      [&](int i, int at) {
        const Point p = place_of(task.spheres, i);
        const Point m = cells.middle;
        listed[warp][at] = make_float4(p.x - m.x, p.y - m.y, p.z - m.z, task.offsets.value[i]);
        entries[warp][at] = i;
      },
      [&](int size) {
        for (int k = 0; k < size; ++k) {
          const float4 s = listed[warp][k];
          for (int h = 0; h < 2; ++h) {
            const Place& x = cells.place[h];
            const float score = sqrt_fast(squared_length(x.x - s.x, x.y - s.y, x.z - s.z)) - s.w;
            if (score < least[h]) least[h] = score, entry[h] = entries[warp][k];
          }
        }
      });
  for (int h = 0; h < 2; ++h) {
    const long at = cells.at(task.grid, h, lane);
    if (at < 0) continue;
    const Point p = place_of(task.spheres, entry[h]), m = cells.middle;
    const Place& x = cells.place[h];
    const float radius = task.offsets.value[entry[h]];
    to_sphere(x.x - (p.x - m.x), x.y - (p.y - m.y), x.z - (p.z - m.z), radius).write(task, at);
    if (task.entry != nullptr) task.entry[at] = entry[h];
  }
}

// Adds the terms of a list at a lane's two places. Where exponents could overflow they are taken less the largest so far.
template <class Terms>
__device__ void add_listed(const float4* listed, const float2* of, int size, bool is_safe,
                           const typename Terms::Exponents at[2], float shift[2], typename Terms::Sums sums[2]) {
  if (!is_safe) {
    for (int h = 0; h < 2; ++h) {
      float most = shift[h];
      for (int k = 0; k < size; ++k) most = larger(most, at[h].of(listed[k]));
      const float scale = weight_of(shift[h] - most);
      sums[h].each([&](float& sum) { sum *= scale; });
      shift[h] = most;
    }
  }
  for (int k = 0; k < size; ++k) {
    const Term term{listed[k], of[k]};
    for (int h = 0; h < 2; ++h) at[h].add(weight_of(at[h].of(term.at) - shift[h]) * term.of.y, term, sums[h]);
  }
}

template <class Terms>
__device__ void bake_terms(const FieldTask& task, float4* listed, float2* of) {
  const int lane = lane_of_thread();
  const Cells cells(task.grid, warp_of_grid(), lane);
  if (!cells.is_there) return;
  const Terms terms(task, cells.middle, task.grid.radius(kSubBlock), lane);
  const typename Terms::Exponents at[2] = {terms.at(cells.place[0]), terms.at(cells.place[1])};
  typename Terms::Sums sums[2];
  float shift[2] = {0.0f, 0.0f}, reach = 0.0f;
  through_list(
      terms, lane,
      [&](int i, int k) {
        const Term term = terms.term(i);
        listed[k] = term.at, of[k] = term.of;
        reach = larger(reach, at[0].reach(term.at, terms.reach_scale()));
      },
      [&](int size) {
        const bool is_safe = !__any_sync(kAllLanes, !(reach < kSafeExponent));
        add_listed<Terms>(listed, of, size, is_safe, at, shift, sums);
      });
  for (int h = 0; h < 2; ++h) {
    const long cell = cells.at(task.grid, h, lane);
    if (cell >= 0) terms.finish(cells.place[h], shift[h], sums[h]).write(task, cell);
  }
}

extern "C" __global__ __launch_bounds__(kWarp* kWarps) void bake_gaussian(const FieldTask* task) {
  __shared__ float4 listed[kWarps][kRoom];
  __shared__ float2 of[kWarps][kRoom];
  const int warp = static_cast<int>(threadIdx.x) / kWarp;
  bake_terms<GaussianTerms>(*task, listed[warp], of[warp]);
}

extern "C" __global__ __launch_bounds__(kWarp* kWarps) void bake_matern(const FieldTask* task) {
  __shared__ float4 listed[kWarps][kRoom];
  __shared__ float2 of[kWarps][kRoom];
  const int warp = static_cast<int>(threadIdx.x) / kWarp;
  bake_terms<MaternTerms>(*task, listed[warp], of[warp]);
}

}  // namespace splatctrl
