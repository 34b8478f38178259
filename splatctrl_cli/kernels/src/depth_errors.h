// How far a rendered map lies behind measured depth.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatctrl {

// Images (H W): depth [m] as blended, opacity, measured depth [m], and which pixels count.
struct RenderedDepth {
  const float *depth, *opacity, *measured;
  const std::uint8_t* counted;
  std::size_t size;
};

// error (H W) [m]: depth / opacity (0 below `opaque`) minus measured; infinite in holes, whose opacity is below `hole`,
// and -infinite where a pixel does not count. sizes: |error| of all others; returns their number.
std::size_t depth_errors(const RenderedDepth& image, float hole, float opaque, float* error, float* sizes);

}  // namespace splatctrl
