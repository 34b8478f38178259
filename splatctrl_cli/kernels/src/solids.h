// Exact solids and the gap from a point to them, as squares where that is enough.
#pragma once

#include <cmath>

#include "projection.h"

namespace splatctrl {

struct Ball {
  double center[3], radius;
};

// A box, placed by `turn` (row-major) and `shift` from world into its own axes.
struct Cuboid {
  double turn[9], shift[3], half[3];
};

// A cylinder about its z axis with `round` added all about: a capsule has no radius of its own.
struct Rod {
  double turn[9], shift[3], radius, half_length, round;
};

struct Vector3 {
  double x, y, z;
};

SPLATCTRL_HOST_DEVICE inline double above0(double v) { return v > 0.0 ? v : 0.0; }

SPLATCTRL_HOST_DEVICE inline Vector3 local_to(const double* R, const double* shift, Vector3 p) {
  return {R[0] * p.x + R[1] * p.y + R[2] * p.z + shift[0], R[3] * p.x + R[4] * p.y + R[5] * p.z + shift[1],
          R[6] * p.x + R[7] * p.y + R[8] * p.z + shift[2]};
}

// Outside a solid whose faces are `a`, `b`, `c` away along three directions at right angles (negative: inside), the
// squared distance; 0 inside.
SPLATCTRL_HOST_DEVICE inline double squared_outside(double a, double b, double c) {
  const double x = above0(a), y = above0(b), z = above0(c);
  return x * x + y * y + z * z;
}

SPLATCTRL_HOST_DEVICE inline Vector3 beyond_faces(const Cuboid& s, Vector3 p) {
  const Vector3 q = local_to(s.turn, s.shift, p);
  return {std::fabs(q.x) - s.half[0], std::fabs(q.y) - s.half[1], std::fabs(q.z) - s.half[2]};
}

SPLATCTRL_HOST_DEVICE inline Vector3 beyond_faces(const Rod& s, Vector3 p) {
  const Vector3 q = local_to(s.turn, s.shift, p);  // no third face
  return {std::sqrt(q.x * q.x + q.y * q.y) - s.radius, std::fabs(q.z) - s.half_length, -1e30};
}

// Signed distance by how far a point lies beyond the faces: inside, less the way to the nearest of them.
SPLATCTRL_HOST_DEVICE inline double signed_distance(Vector3 beyond) {
  const double nearest = beyond.x > beyond.y ? beyond.x : beyond.y, inside = nearest > beyond.z ? nearest : beyond.z;
  return std::sqrt(squared_outside(beyond.x, beyond.y, beyond.z)) + (inside < 0.0 ? inside : 0.0);
}

}  // namespace splatctrl
