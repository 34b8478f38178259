// What every bind_*.cpp shares: array types without silent copies, and the functions that fill the module.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "projection.h"

namespace splatctrl {

namespace nb = nanobind;

// C-contiguous arrays on the CPU; every argument is bound with .noconvert(), so a wrong dtype is a TypeError.
template <typename Scalar, typename... Extra>
using Array = nb::ndarray<Scalar, nb::c_contig, nb::device::cpu, Extra...>;

inline void expect(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

// camera: fx, fy, cx, cy, width, height, world-to-camera rotation (9, row-major), translation (3).
inline Camera camera_from(const Array<const double>& values) {
  expect(values.size() == 18, "camera: expected 18 numbers");
  const double* p = values.data();
  Camera camera;
  camera.fx = static_cast<float>(p[0]);
  camera.fy = static_cast<float>(p[1]);
  camera.cx = static_cast<float>(p[2]);
  camera.cy = static_cast<float>(p[3]);
  camera.width = static_cast<int>(p[4]);
  camera.height = static_cast<int>(p[5]);
  for (int k = 0; k < 9; ++k) camera.rotation[k] = static_cast<float>(p[6 + k]);
  for (int k = 0; k < 3; ++k) camera.translation[k] = static_cast<float>(p[15 + k]);
  return camera;
}

void bind_raster(nb::module_& m);
void bind_gaussians(nb::module_& m);
void bind_field(nb::module_& m);
void bind_occupancy(nb::module_& m);
void bind_chain(nb::module_& m);
void bind_edges(nb::module_& m);
void bind_surface(nb::module_& m);
void bind_points(nb::module_& m);
void bind_triangles(nb::module_& m);

}  // namespace splatctrl
