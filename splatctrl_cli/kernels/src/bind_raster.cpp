#include "bind.h"

namespace splatctrl {

void bind_raster(nb::module_&) {}

}  // namespace splatctrl
