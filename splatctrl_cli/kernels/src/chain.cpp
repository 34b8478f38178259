#include "chain.h"

#include <cmath>
#include <vector>

#include "parallel.h"

namespace splatctrl {
namespace {

constexpr long kPosturesPerChunk = 64;

// Rotation, row-major, and translation.
struct Pose {
  double r[9], t[3];
};

Pose compose(const Pose& a, const Pose& b) {
  Pose c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.r[3 * i + j] = a.r[3 * i] * b.r[j] + a.r[3 * i + 1] * b.r[3 + j] + a.r[3 * i + 2] * b.r[6 + j];
    c.t[i] = a.r[3 * i] * b.t[0] + a.r[3 * i + 1] * b.t[1] + a.r[3 * i + 2] * b.t[2] + a.t[i];
  }
  return c;
}

Pose placement_of(const Chain& chain, int body) {
  const double* p = chain.placement + 12 * body;
  return {{p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10]}, {p[3], p[7], p[11]}};
}

// Rodrigues' formula, or a slide.
Pose joint_at(const Chain& chain, int body, double q) {
  const double *a = chain.axis + 3 * body, x = a[0], y = a[1], z = a[2];
  if (chain.kind[body] == 1) return {{1, 0, 0, 0, 1, 0, 0, 0, 1}, {q * x, q * y, q * z}};
  const double c = std::cos(q), s = std::sin(q), v = 1.0 - c;
  return {{c + x * x * v, x * y * v - z * s, x * z * v + y * s, y * x * v + z * s, c + y * y * v, y * z * v - x * s, z * x * v - y * s,
           z * y * v + x * s, c + z * z * v},
          {0, 0, 0}};
}

void place_bodies(const Chain& chain, const double* q, std::vector<Pose>& poses) {
  poses.resize(chain.num_bodies);
  poses[0] = placement_of(chain, 0);
  for (int b = 1; b < chain.num_bodies; ++b)
    poses[b] = compose(compose(poses[chain.parent[b]], placement_of(chain, b)), joint_at(chain, b, q[b - 1]));
}

void place_spheres(const Chain& chain, const std::vector<Pose>& poses, double* centers) {
  for (int s = 0; s < chain.num_spheres; ++s) {
    const Pose& p = poses[chain.sphere_body[s]];
    const double* o = chain.offset + 3 * s;
    for (int i = 0; i < 3; ++i) centers[3 * s + i] = p.r[3 * i] * o[0] + p.r[3 * i + 1] * o[1] + p.r[3 * i + 2] * o[2] + p.t[i];
  }
}

// Columns of the joints that carry `body`: how its point c moves (3, J), and how it turns (3, J) where that is not null.
// A joint's own turn does not move its axis.
void add_columns(const Chain& chain, const std::vector<Pose>& poses, int body, const double* c, double* linear, double* angular) {
  const int J = chain.num_bodies - 1;
  for (int b = body; b > 0; b = static_cast<int>(chain.parent[b])) {
    const Pose& p = poses[b];
    const double* a = chain.axis + 3 * b;
    double w[3], arm[3];
    for (int i = 0; i < 3; ++i) {
      w[i] = p.r[3 * i] * a[0] + p.r[3 * i + 1] * a[1] + p.r[3 * i + 2] * a[2];
      arm[i] = c[i] - p.t[i];
    }
    const double turned[3] = {w[1] * arm[2] - w[2] * arm[1], w[2] * arm[0] - w[0] * arm[2], w[0] * arm[1] - w[1] * arm[0]};
    for (int i = 0; i < 3; ++i) {
      linear[i * J + b - 1] = chain.kind[b] == 1 ? w[i] : turned[i];
      if (angular != nullptr) angular[i * J + b - 1] = chain.kind[b] == 1 ? 0.0 : w[i];
    }
  }
}

}  // namespace

void sphere_centers(const Chain& chain, const double* q, long num_postures, int num_threads, double* centers) {
  const long chunks = (num_postures + kPosturesPerChunk - 1) / kPosturesPerChunk;
  parallel_for(static_cast<int>(chunks), num_threads, [&](int chunk) {
    std::vector<Pose> poses;
    const long end = chunk == chunks - 1 ? num_postures : (chunk + 1) * kPosturesPerChunk;
    for (long t = chunk * kPosturesPerChunk; t < end; ++t) {
      place_bodies(chain, q + t * (chain.num_bodies - 1), poses);
      place_spheres(chain, poses, centers + 3 * t * chain.num_spheres);
    }
  });
}

void sphere_jacobians(const Chain& chain, const double* q, double* centers, double* jacobians) {
  std::vector<Pose> poses;
  place_bodies(chain, q, poses);
  place_spheres(chain, poses, centers);
  const int J = chain.num_bodies - 1;
  for (int k = 0; k < 3 * chain.num_spheres * J; ++k) jacobians[k] = 0.0;
  for (int s = 0; s < chain.num_spheres; ++s)
    add_columns(chain, poses, static_cast<int>(chain.sphere_body[s]), centers + 3 * s, jacobians + 3 * s * J, nullptr);
}

void frame_jacobian(const Chain& chain, const double* q, int body, const double* placement, double* pose, double* jacobian) {
  std::vector<Pose> poses;
  place_bodies(chain, q, poses);
  const double* p = placement;
  const Pose frame = compose(poses[body], {{p[0], p[1], p[2], p[4], p[5], p[6], p[8], p[9], p[10]}, {p[3], p[7], p[11]}});
  const int J = chain.num_bodies - 1;
  for (int k = 0; k < 6 * J; ++k) jacobian[k] = 0.0;
  add_columns(chain, poses, body, frame.t, jacobian, jacobian + 3 * J);
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) pose[4 * i + k] = frame.r[3 * i + k];
    pose[4 * i + 3] = frame.t[i];
  }
}

void pair_gaps(const double* centers, const double* radii, const long* pairs, long num_pairs, double* gap, double* direction) {
  for (long k = 0; k < num_pairs; ++k) {
    const long a = pairs[2 * k], b = pairs[2 * k + 1];
    const double x = centers[3 * a] - centers[3 * b], y = centers[3 * a + 1] - centers[3 * b + 1];
    const double z = centers[3 * a + 2] - centers[3 * b + 2], d = std::sqrt(x * x + y * y + z * z);
    const double scale = d > 0.0 ? 1.0 / d : 0.0;
    gap[k] = d - radii[a] - radii[b];
    direction[3 * k] = scale * x, direction[3 * k + 1] = scale * y, direction[3 * k + 2] = scale * z;
  }
}

}  // namespace splatctrl
