// The kernels of one iteration of the fit, in the order in which they run: project, blend, ssim_derivatives,
// loss_gradient, blend_backward, step. No sum depends on the order in which threads run: integers alone are added
// atomically, and the lists that they place are sorted.
#include "project.cuh"
#include "blend.cuh"
#include "loss.cuh"
#include "blend_backward.cuh"
#include "step.cuh"
