// CUDA on one processor: a block's threads are fibers that take turns at barriers, so that the kernels run as they are
// written, in their own order of summation. Blocks run one after the other. With `backwards` threads and blocks take
// turns in the opposite order: what depends on the order is then found by comparing bits.
#pragma once

#include <setjmp.h>
#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <tuple>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __shared__ static
#define __launch_bounds__(...)

struct Index3 {
  unsigned x, y, z;
};
struct float2 {
  float x, y;
};
struct float4 {
  float x, y, z, w;
};
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline float2 make_float2(float x, float y) { return {x, y}; }

constexpr unsigned kAllLanes = 0xffffffffu;

namespace emulated {

constexpr std::size_t kStackBytes = 256 * 1024;
enum class Waits { kNot, kWarp, kBlock, kDone };

struct Fiber {
  ucontext_t context;  // to begin with; later turns jump, which needs no call of the system
  jmp_buf turn;
  bool has_begun = false;
  std::vector<char> stack = std::vector<char>(kStackBytes);
  Waits waits = Waits::kDone;
  std::uint64_t given = 0;  // to the warp's other lanes
};

inline std::vector<Fiber> fibers;
inline ucontext_t origin;
inline jmp_buf scheduler;
inline int current = 0, num_threads = 0;
inline bool backwards = false;
inline void (*body)(void*) = nullptr;
inline void* body_arguments = nullptr;

inline void wait(Waits what) {
  fibers[current].waits = what;
  if (_setjmp(fibers[current].turn) == 0) _longjmp(scheduler, 1);
}

inline void enter() {
  body(body_arguments);
  wait(Waits::kDone);
}

// Lets the fibers that wait for `what` go on if all of `first` to `last` that are not done do.
inline bool release(int first, int last, Waits what) {
  bool any = false;
  for (int k = first; k < last; ++k) {
    if (fibers[k].waits == Waits::kDone) continue;
    if (fibers[k].waits != what) return false;
    any = true;
  }
  for (int k = first; any && k < last; ++k) {
    if (fibers[k].waits == what) fibers[k].waits = Waits::kNot;
  }
  return any;
}

inline void resume(Fiber& fiber) {
  if (std::exchange(fiber.has_begun, true)) _longjmp(fiber.turn, 1);
  swapcontext(&origin, &fiber.context);
}

inline void run_block() {
  if (static_cast<int>(fibers.size()) < num_threads) fibers = std::vector<Fiber>(num_threads);
  for (int k = 0; k < num_threads; ++k) {
    getcontext(&fibers[k].context);
    fibers[k].context.uc_stack.ss_sp = fibers[k].stack.data();
    fibers[k].context.uc_stack.ss_size = kStackBytes;
    fibers[k].context.uc_link = nullptr;
    fibers[k].waits = Waits::kNot;
    makecontext(&fibers[k].context, enter, 0);
    fibers[k].has_begun = false;
  }
  for (;;) {
    volatile int num_run = 0, num_done = 0;  // they outlive a jump
    for (volatile int k = 0; k < num_threads; k = k + 1) {
      const int which = backwards ? num_threads - 1 - k : k;
      num_done = num_done + (fibers[which].waits == Waits::kDone);
      if (fibers[which].waits != Waits::kNot) continue;
      current = which;
      num_run = num_run + 1;
      if (_setjmp(scheduler) == 0) resume(fibers[which]);
    }
    if (num_done == num_threads) return;
    bool any = num_run > 0;
    for (int warp = 0; warp < num_threads; warp += 32) any |= release(warp, warp + 32, Waits::kWarp);
    any |= release(0, num_threads, Waits::kBlock);
    if (!any) {
      std::fprintf(stderr, "emulator: threads of a block wait at different barriers\n");
      std::abort();
    }
  }
}

template <class T>
T exchanged(T value, int from) {
  static_assert(sizeof(T) <= sizeof(std::uint64_t), "");
  std::memcpy(&fibers[current].given, &value, sizeof value);
  wait(Waits::kWarp);
  T got;
  std::memcpy(&got, &fibers[from].given, sizeof got);
  wait(Waits::kWarp);
  return got;
}

template <class Fold>
std::uint64_t folded(std::uint64_t value, int first, int last, Waits what, Fold&& fold) {
  fibers[current].given = value;
  wait(what);
  std::uint64_t result = fibers[first].given;
  for (int k = first + 1; k < last; ++k) result = fold(result, fibers[k].given);
  wait(what);
  return result;
}

}  // namespace emulated

inline Index3 blockIdx, blockDim, gridDim;
struct ThreadIndex {
  struct {
    operator int() const { return emulated::current; }
  } x;
};
inline ThreadIndex threadIdx;

inline void __syncthreads() { emulated::wait(emulated::Waits::kBlock); }
inline void __syncwarp() { emulated::wait(emulated::Waits::kWarp); }
inline int __syncthreads_or(int value) {
  return static_cast<int>(emulated::folded(value != 0, 0, emulated::num_threads, emulated::Waits::kBlock,
                                           [](std::uint64_t a, std::uint64_t b) { return a | b; }));
}
inline int __any_sync(unsigned, int value) {
  const int first = emulated::current / 32 * 32;
  return static_cast<int>(emulated::folded(value != 0, first, first + 32, emulated::Waits::kWarp,
                                           [](std::uint64_t a, std::uint64_t b) { return a | b; }));
}
template <class T>
T __shfl_xor_sync(unsigned, T value, int mask) {
  return emulated::exchanged(value, emulated::current ^ mask);
}
template <class T>
T __shfl_sync(unsigned, T value, int lane, int width) {
  return emulated::exchanged(value, emulated::current / width * width + lane);
}
template <class T>
T __shfl_up_sync(unsigned, T value, int step) {
  return emulated::exchanged(value, emulated::current % 32 >= step ? emulated::current - step : emulated::current);
}
inline unsigned __ballot_sync(unsigned, int value) {
  const int first = emulated::current / 32 * 32;
  return static_cast<unsigned>(
      emulated::folded(static_cast<std::uint64_t>(value != 0) << emulated::current % 32, first, first + 32,
                       emulated::Waits::kWarp, [](std::uint64_t a, std::uint64_t b) { return a | b; }));
}
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __ffs(int bits) { return __builtin_ffs(bits); }
inline int atomicAdd(int* at, int value) { return std::exchange(*at, *at + value); }
inline int atomicMax(int* at, int value) { return std::exchange(*at, *at > value ? *at : value); }

inline float __fmaf_rn(float a, float b, float c) { return std::fma(a, b, c); }
inline float __fmul_rn(float a, float b) { return a * b; }
inline float __fadd_rn(float a, float b) { return a + b; }
inline float __fdividef(float a, float b) { return a / b; }
inline float exp2_fast(float x) { return std::exp2(x); }
inline float sqrt_fast(float x) { return std::sqrt(x); }
inline float inverse_root_fast(float x) { return 1.0f / std::sqrt(x); }
inline float not_a_number() { return std::nanf(""); }
inline unsigned __float_as_uint(float x) {
  unsigned bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits;
}

namespace emulated {

template <class... Arguments>
struct Call {
  void (*kernel)(Arguments...);
  std::tuple<Arguments...> arguments;
};

// arguments[k] points at the value of the k-th argument, as for cuLaunchKernel.
template <class... Arguments, std::size_t... Indices>
void launch(void (*kernel)(Arguments...), const int* grid, int block, void** arguments,
            std::index_sequence<Indices...>) {
  using Kernel = Call<Arguments...>;
  Kernel call{kernel, {*static_cast<Arguments*>(arguments[Indices])...}};
  body_arguments = &call;
  body = [](void* of) {
    auto* it = static_cast<Kernel*>(of);
    std::apply(it->kernel, it->arguments);
  };
  num_threads = block;
  gridDim = {static_cast<unsigned>(grid[0]), static_cast<unsigned>(grid[1]), static_cast<unsigned>(grid[2])};
  blockDim = {static_cast<unsigned>(block), 1, 1};
  const unsigned count = gridDim.x * gridDim.y * gridDim.z;
  for (unsigned k = 0; k < count; ++k) {
    const unsigned which = backwards ? count - 1 - k : k;
    blockIdx = {which % gridDim.x, which / gridDim.x % gridDim.y, which / gridDim.x / gridDim.y};
    run_block();
  }
}

template <class... Arguments>
void launch(void (*kernel)(Arguments...), const int* grid, int block, void** arguments) {
  launch(kernel, grid, block, arguments, std::index_sequence_for<Arguments...>{});
}

}  // namespace emulated
