#include "bind.h"

namespace splatctrl {

void bind_field(nb::module_&) {}

}  // namespace splatctrl
