// The arrays of a chain as a view of them, for every bind_*.cpp that walks one.
#pragma once

#include "bind.h"
#include "chain.h"

namespace splatctrl {

using Doubles = Array<const double, nb::shape<-1>>;
using Integers = Array<const long, nb::shape<-1>>;
using Triples = Array<const double, nb::shape<-1, 3>>;
using Placements = Array<const double, nb::shape<-1, 3, 4>>;
using Postures = Array<const double, nb::shape<-1, -1>>;

inline Chain view_chain(const Integers& parent, const Integers& kind, const Placements& placement, const Triples& axis,
                        const Integers& sphere_body, const Triples& offset) {
  const size_t n = parent.shape(0), s = sphere_body.shape(0);
  expect(n > 0 && kind.shape(0) == n && placement.shape(0) == n && axis.shape(0) == n, "chain: expected one entry per body");
  expect(offset.shape(0) == s, "chain: expected one offset per sphere");
  for (size_t b = 1; b < n; ++b)
    expect(parent.data()[b] >= 0 && parent.data()[b] < static_cast<long>(b), "chain: expected every parent before its body");
  for (size_t k = 0; k < s; ++k)
    expect(sphere_body.data()[k] >= 0 && sphere_body.data()[k] < static_cast<long>(n), "chain: expected bodies that are there");
  return {static_cast<int>(n), static_cast<int>(s), parent.data(), kind.data(), placement.data(), axis.data(), sphere_body.data(), offset.data()};
}

}  // namespace splatctrl
