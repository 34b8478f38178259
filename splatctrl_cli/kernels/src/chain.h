// Kinematic trees of one-axis joints, and spheres fixed to their bodies: places, Jacobians, gaps between pairs.
#pragma once

namespace splatctrl {

// Body b in [0, B): body 0 is the base, body b > 0 moves by joint b - 1 of J = B - 1, after its parent.
// T_b = T_parent(b) placement_b joint_b(q): a turn about `axis` (kind 0) or a slide along it (kind 1).
struct Chain {
  int num_bodies, num_spheres;
  const long *parent, *kind;  // (B)
  const double* placement;    // (B, 3, 4); that of the base is its place in the world
  const double* axis;         // (B, 3) unit
  const long* sphere_body;    // (S)
  const double* offset;       // (S, 3) in its body
};

// centers (T, S, 3), world, at postures q (T, J).
void sphere_centers(const Chain& chain, const double* q, long num_postures, int num_threads, double* centers);

// centers (S, 3) and jacobians d center / d q (S, 3, J), world, at q (J).
void sphere_jacobians(const Chain& chain, const double* q, double* centers, double* jacobians);

// pose (3, 4) of a frame at `placement` (3, 4) in a body, world, and its Jacobian (6, J), linear rows first, at q (J).
void frame_jacobian(const Chain& chain, const double* q, int body, const double* placement, double* pose, double* jacobian);

// Pairs (P, 2) of spheres: gap (P) between surfaces and the unit direction (P, 3) from the second centre to the first,
// zero where they coincide.
void pair_gaps(const double* centers, const double* radii, const long* pairs, long num_pairs, double* gap, double* direction);

}  // namespace splatctrl
