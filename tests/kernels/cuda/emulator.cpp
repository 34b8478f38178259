// The kernels of the fit and of the fields as a library of the processor's.
#include "device.h"
#include "field.cu"
#include "fit.cu"

extern "C" {

void set_backwards(int backwards) { emulated::backwards = backwards != 0; }

// 0 where there is no kernel of that name.
int launch(const char* name, const int* grid, int block, void** arguments) {
  using namespace splatctrl;
#define KERNEL(of) \
  if (std::strcmp(name, #of) == 0) return emulated::launch(of, grid, block, arguments), 1
  KERNEL(project);
  KERNEL(blend);
  KERNEL(ssim_derivatives);
  KERNEL(loss_gradient);
  KERNEL(blend_backward);
  KERNEL(step);
  KERNEL(bake_hard);
  KERNEL(bake_gaussian);
  KERNEL(bake_matern);
  KERNEL(query_hard);
  KERNEL(query_gaussian);
  KERNEL(query_matern);
  KERNEL(choose);
  KERNEL(settle);
  return 0;
}
}
