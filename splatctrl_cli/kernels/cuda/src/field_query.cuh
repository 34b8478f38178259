// The fields at points, a warp for each, and the choice between the exact distance and a kernel's.
#pragma once

#include "field_terms.cuh"

namespace splatctrl {

__device__ inline Point point_of(const FieldTask& task, int q) {
  const double* x = task.points + 3 * static_cast<long>(q);
  return {static_cast<float>(x[0] - task.anchor[0]), static_cast<float>(x[1] - task.anchor[1]),
          static_cast<float>(x[2] - task.anchor[2])};
}

extern "C" __global__ __launch_bounds__(kWarp* kWarps) void query_hard(const FieldTask* given) {
  const FieldTask& task = *given;
  const int q = warp_of_grid(), lane = lane_of_thread();
  if (q >= task.num_points) return;
  const Point x = point_of(task, q);
  const int entry = find_nearest<LinearScore>(task.spheres, task.offsets, x, lane).entry;
  if (lane != 0) return;
  const Point p = place_of(task.spheres, entry);
  to_sphere(x.x - p.x, x.y - p.y, x.z - p.z, task.offsets.value[entry]).write(task, q);
  if (task.entry != nullptr) task.entry[q] = entry;
}

template <class Terms>
__device__ void query_terms(const FieldTask& task) {
  const int q = warp_of_grid(), lane = lane_of_thread();
  if (q >= task.num_points) return;
  const Terms terms(task, point_of(task, q), 0.0f, lane);
  const Place here{0.0f, 0.0f, 0.0f};
  const typename Terms::Exponents at = terms.at(here);
  typename Terms::Sums sums;
  walk(task.spheres, lane, [&](int box) { return terms.keeps(box); }, [&](int i) {
    if (i < 0 || !terms.chooses(i)) return;
    const Term term = terms.term(i);
    at.add(weight_of(at.of(term.at)) * term.of.y, term, sums);
  });
  sums.each([&](float& sum) { sum = warp_sum(sum); });
  if (lane == 0) terms.finish(here, 0.0f, sums).write(task, q);
}

extern "C" __global__ __launch_bounds__(kWarp* kWarps) void query_gaussian(const FieldTask* task) {
  query_terms<GaussianTerms>(*task);
}

extern "C" __global__ __launch_bounds__(kWarp* kWarps) void query_matern(const FieldTask* task) {
  query_terms<MaternTerms>(*task);
}

// Of n cells or points: hard (n) and kernel (n), gradients (n, 3), the kernel's null where the exact one is taken.
struct ChoiceTask {
  const float *hard, *hard_gradient;
  float *kernel;
  const float* kernel_gradient;
  float *distance, *gradient, *bound;  // what is chosen, and hard less the margin; null where not wanted
  std::int32_t* counts;                // cells where the kernel has no distance, and those where it exceeds hard
  std::int64_t num;
  double margin;
  float resolution;
  std::int32_t takes_least;  // the smaller of both, hard where they are equal; else the kernel's where it has one
};

__device__ inline std::int64_t cell_of_thread() {
  return static_cast<std::int64_t>(blockIdx.x) * blockDim.x + static_cast<int>(threadIdx.x);
}

// The field that the configuration names; the gradient may be in the place of either.
extern "C" __global__ void choose(const ChoiceTask* given) {
  const ChoiceTask& task = *given;
  const std::int64_t at = cell_of_thread();
  if (at >= task.num) return;
  const float hard = task.hard[at], kernel = task.kernel == nullptr ? not_a_number() : task.kernel[at];
  const bool is_smooth = task.takes_least ? kernel < hard : kernel == kernel;
  task.distance[at] = is_smooth ? kernel : hard;
  if (task.bound != nullptr) task.bound[at] = static_cast<float>(static_cast<double>(hard) - task.margin);
  if (task.gradient == nullptr) return;
  const float* gradient = is_smooth ? task.kernel_gradient : task.hard_gradient;
  for (int a = 0; a < 3; ++a) task.gradient[3 * at + a] = gradient[3 * at + a];
}

// Counts what there is to say of a kernel, and puts the exact distance where it has none.
extern "C" __global__ void settle(const ChoiceTask* given) {
  const ChoiceTask& task = *given;
  const std::int64_t at = cell_of_thread();
  if (at >= task.num) return;
  const float hard = task.hard[at], kernel = task.kernel[at];
  if (kernel > hard + task.resolution) atomicAdd(task.counts + 1, 1);
  if (kernel == kernel) return;
  atomicAdd(task.counts, 1);
  task.kernel[at] = hard;
}

}  // namespace splatctrl
