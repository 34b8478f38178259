#include "field_groups.h"

#include <algorithm>

namespace splatctrl {
namespace {

constexpr float kSpare = 1e14f;  // coordinates of spare entries are beyond

Group make_group(const Clusters& s, const double* offset, float length, int begin, int end) {
  Group group{};
  group.begin = begin;
  double largest = -1e300, total = 0.0, mean[3] = {}, weight[kLanes];
  const float* const axes[3] = {s.x, s.y, s.z};
  while (begin + group.count < end && s.x[begin + group.count] < kSpare)
    largest = std::max(largest, offset[begin + group.count++]);
  if (group.count == 0) return group;
  for (int k = 0; k < group.count; ++k) {
    total += weight[k] = std::exp((offset[begin + k] - largest) / length);
    for (int a = 0; a < 3; ++a) mean[a] += weight[k] * axes[a][begin + k];
  }
  for (int a = 0; a < 3; ++a) group.place[a] = static_cast<float>(mean[a] / total);
  group.offset = largest + length * std::log(total);
  for (int k = 0; k < group.count; ++k) {
    float away[3], squared = 0.0f;
    for (int a = 0; a < 3; ++a) {
      away[a] = axes[a][begin + k] - group.place[a];
      squared += away[a] * away[a];
      group.extent[a] = std::max(group.extent[a], std::fabs(away[a]));
    }
    group.radius = std::max(group.radius, std::sqrt(squared));
    const auto w = static_cast<float>(weight[k] / total);
    for (int a = 0, n = 0; a < 3; ++a)
      for (int b = a; b < 3; ++b, ++n) group.covariance[n] += w * away[a] * away[b];
  }
  return group;
}

}  // namespace

Groups make_groups(const Clusters& spheres, const double* offset, float length) {
  Groups groups;
  for (int begin = 0; begin < kLanes * spheres.num_clusters; begin += kLanes) {
    groups.of_16.push_back(make_group(spheres, offset, length, begin, begin + kLanes));
    for (int i = begin; i < begin + kLanes; i += 4) groups.of_4.push_back(make_group(spheres, offset, length, i, i + 4));
  }
  return groups;
}

void TermList::reserve(int n) {
  if (static_cast<int>(x.size()) >= n + 8) return;
  for (auto* values : {&x, &y, &z, &offset, &sign}) values->resize(n + 8);
}

void TermList::add(float px, float py, float pz, float o, float c) {
  x[size] = px, y[size] = py, z[size] = pz, offset[size] = o, sign[size] = c;
  ++size;
}

void TermList::pad() {
  for (int i = size; i < size + 8; ++i) x[i] = y[i] = z[i] = sign[i] = 0.0f, offset[i] = -1e30f;
}

void GroupList::reserve(int n) {
  if (static_cast<int>(x.size()) >= n + 8) return;
  group.resize(n + 8);
  for (auto* values : {&x, &y, &z, &offset, &radius, &seen_offset, &error}) values->resize(n + 8);
  for (auto& values : covariance) values.resize(n + 8);
  for (auto& values : extent) values.resize(n + 8);
  for (auto& values : slope) values.resize(n + 8);
}

void GroupList::add(const Group& g, float px, float py, float pz, float o) {
  group[size] = &g, x[size] = px, y[size] = py, z[size] = pz, offset[size] = o, radius[size] = g.radius;
  for (int n = 0; n < 6; ++n) covariance[n][size] = g.covariance[n];
  for (int a = 0; a < 3; ++a) extent[a][size] = g.extent[a];
  ++size;
}

void GroupList::pad() {
  for (int i = size; i < size + 8; ++i) {
    x[i] = y[i] = z[i] = radius[i] = 0.0f, offset[i] = -1e30f;
    for (auto& values : covariance) values[i] = 0.0f;
    for (auto& values : extent) values[i] = 0.0f;
  }
}

void GroupList::view(Point m, float around, float length) {
  const float scale = 1.0f / length;
  const Float8 zero{};
  for (int i = 0; i < size; i += 8) {
    const Float8 dx = m.x - load8(&x[i]), dy = m.y - load8(&y[i]), dz = m.z - load8(&z[i]);
    const Float8 xx = load8(&covariance[0][i]), xy = load8(&covariance[1][i]), xz = load8(&covariance[2][i]);
    const Float8 yy = load8(&covariance[3][i]), yz = load8(&covariance[4][i]), zz = load8(&covariance[5][i]);
    const Float8 d = sqrt8(dx * dx + dy * dy + dz * dz), r = load8(&radius[i]), near = d - around - r;
    const Float8 inverse = 1.0f / d, ux = dx * inverse, uy = dy * inverse, uz = dz * inverse;
    const Float8 sx = xx * ux + xy * uy + xz * uz, sy = xy * ux + yy * uy + yz * uz, sz = xz * ux + yz * uy + zz * uz;
    const Float8 along = ux * sx + uy * sy + uz * sz, trace = xx + yy + zz, across = trace - along;
    store8(&seen_offset[i], 0.5f * (along * scale - across * inverse));
    const Float8 turning = (scale + inverse) * inverse;  // (1 / l + 1 / D) / 2 times the 2 / D of the derivative of u.S.u
    const Float8 receding = 0.5f * across * inverse * inverse;
    store8(&slope[0][i], turning * (sx - along * ux) + receding * ux);
    store8(&slope[1][i], turning * (sy - along * uy) + receding * uy);
    store8(&slope[2][i], turning * (sz - along * uz) + receding * uz);
    const Float8 spread = load8(&extent[0][i]) * max8(ux, -ux) + load8(&extent[1][i]) * max8(uy, -uy) +
                          load8(&extent[2][i]) * max8(uz, -uz);
    const Float8 linear = (min8(spread, r) + r * around / (d - around)) * scale, curved = 0.5f * r * r / near * scale;
    const Float8 half = linear + 0.5f * curved, seen = around / near;
    const Float8 bound = 0.1284f * half * half * half + 0.5f * linear * curved + 0.125f * curved * curved +
                         0.25f * r * r * r / (near * near) * scale + trace * scale * (1.5f * scale + 2.5f * inverse) * seen * seen;
    store8(&error[i], near > max8(2.0f * r, zero) ? bound : splat8(kFar));
  }
}

}  // namespace splatctrl
