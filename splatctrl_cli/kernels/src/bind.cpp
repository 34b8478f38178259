// The module: one bind_* per kernel family. Each only checks shapes, releases the GIL and forwards.
#include "bind.h"

namespace {

bool runs_x86_64_v3() {
#if defined(__x86_64__)
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#else
  return false;
#endif
}

}  // namespace

NB_MODULE(SPLATCTRL_MODULE, m) {
  nanobind::set_leak_warnings(false);  // an interrupted run keeps objects in its traceback; that is no leak
  m.def("runs_x86_64_v3", &runs_x86_64_v3, "True where this processor has AVX2, FMA and BMI2.");
  splatctrl::bind_raster(m);
  splatctrl::bind_gaussians(m);
  splatctrl::bind_field(m);
  splatctrl::bind_chain(m);
  splatctrl::bind_edges(m);
  splatctrl::bind_occupancy(m);
  splatctrl::bind_surface(m);
}
