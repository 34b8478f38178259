// What every bind_*.cpp shares: array types without silent copies, and the functions that fill the module.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace splatctrl {

namespace nb = nanobind;

// C-contiguous arrays on the CPU; every argument is bound with .noconvert(), so a wrong dtype is a TypeError.
template <typename Scalar, typename... Extra>
using Array = nb::ndarray<Scalar, nb::c_contig, nb::device::cpu, Extra...>;

void bind_raster(nb::module_& m);
void bind_field(nb::module_& m);
void bind_occupancy(nb::module_& m);

}  // namespace splatctrl
