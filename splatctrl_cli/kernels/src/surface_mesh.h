// The depth image of triangles.
#pragma once

#include <cstdint>
#include <vector>

namespace splatctrl {

struct SurfaceCamera {
  double fx, fy, cx, cy;
  int width, height;
};

// Part of an image, from pixel (left, top) on: nearest depth (height, width) [m] and the triangle that has it, of
// equals the first; the largest float and -1 where none is.
struct TriangleImage {
  int left = 0, top = 0, width = 0, height = 0;
  std::vector<float> near;
  std::vector<std::int32_t> number;
};

// Triangles in the frames of links. A corner that several triangles of a link share is stored and projected once.
class SurfaceMesh {
 public:
  // corners (num, 3, 3) [m], counter-clockwise seen from outside; links (num), of at least 0.
  SurfaceMesh(const double* corners, const std::int16_t* links, int num);

  int num_links() const { return num_links_; }
  std::int16_t link(int triangle) const { return links_[triangle]; }

  // The part of an image that may show triangles; poses (L, 3, 4) lead from links to the optical frame. A triangle that
  // reaches behind the camera is not drawn.
  TriangleImage draw(const double* poses, const SurfaceCamera& camera) const;

 private:
  int num_links_ = 0;
  std::vector<std::int16_t> links_, corner_links_;
  std::vector<std::int32_t> faces_;  // (F, 3), numbers of corners
  std::vector<double> corners_;      // (K, 3)
};

}  // namespace splatctrl
