// The module: one bind_* per kernel family. Each only checks shapes, releases the GIL and forwards.
#include "bind.h"

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace {

// 4, 3 or 0: of the x86-64 levels that a module is built for, the highest that this processor runs.
int x86_64_level() {
#if defined(__x86_64__)
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma") || !__builtin_cpu_supports("bmi2")) return 0;
  const bool is_wide = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                       __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                       __builtin_cpu_supports("avx512vl");
  return is_wide ? 4 : 3;
#else
  return 0;
#endif
}

// Images of a few MB that are freed stay with the process, up to 512 MB at the end of its heap, instead of going back
// page by page and being faulted in again for the next.
void keep_freed_memory() {
#if defined(__GLIBC__)
  mallopt(M_MMAP_THRESHOLD, 128 << 20);
  mallopt(M_TRIM_THRESHOLD, 512 << 20);
#endif
}

}  // namespace

NB_MODULE(SPLATCTRL_MODULE, m) {
  nanobind::set_leak_warnings(false);  // an interrupted run keeps objects in its traceback; that is no leak
  m.def("x86_64_level", &x86_64_level, "4 where this processor has AVX-512, 3 where AVX2, FMA and BMI2, 0 elsewhere.");
  m.def("keep_freed_memory", &keep_freed_memory, "For the whole process: what is freed is not given back at once.");
  splatctrl::bind_raster(m);
  splatctrl::bind_gaussians(m);
  splatctrl::bind_field(m);
  splatctrl::bind_chain(m);
  splatctrl::bind_edges(m);
  splatctrl::bind_occupancy(m);
  splatctrl::bind_surface(m);
  splatctrl::bind_points(m);
  splatctrl::bind_triangles(m);
}
