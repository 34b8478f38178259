// The depth image of solids that a camera would measure, by casting a ray through every pixel, and where a measured
// depth lies inside one of them.
#pragma once

#include <cstdint>

#include "surface_mesh.h"

namespace splatctrl {

enum class SolidKind { kBox, kCylinder, kBall, kCapsule };

// A solid in its own frame, its origin in its middle: `turn` (row-major) and `shift` lead there from the camera's
// optical frame. size: half edges of a box; radius and half length along z of a cylinder or a capsule (its cylinder's);
// radius of a ball.
struct SurfaceSolid {
  SolidKind kind;
  double turn[9], shift[3], size[3];
  std::int16_t link;
};

// poses (L, 3, 4) lead from the links of the triangles to the optical frame.
struct PlacedMesh {
  const SurfaceMesh& triangles;
  const double* poses;
};

// measured (H, W) [m] along the optical axis, 0 = none. A measured point is inside where it lies by more than
// `tolerance` [m], plus `quadratic` times its depth squared, behind the front and before the back of one solid on its
// ray.
struct SurfaceMeasurement {
  const float* depth;
  float tolerance, quadratic;
};

// depth (H, W) [m] of the nearest surface, 0 = none, and its link, -1 = none; inside (H, W): the link of the solid that
// holds the measured point, -1 = none. A solid that holds the camera is not seen; nor is a triangle that reaches behind
// the camera.
struct SurfaceImage {
  float* depth;
  std::int16_t* link;
  std::int16_t* inside;
};

void render_surface(const SurfaceCamera& camera, const SurfaceSolid* solids, int num_solids,
                    const PlacedMesh& mesh, const SurfaceMeasurement& measured, const SurfaceImage& out,
                    int num_threads);

}  // namespace splatctrl
