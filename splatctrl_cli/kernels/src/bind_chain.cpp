#include "bind_chain.h"

namespace splatctrl {
namespace {

using Pairs = Array<const long, nb::shape<-1, 2>>;

void centers(const Integers& parent, const Integers& kind, const Placements& placement, const Triples& axis,
             const Integers& sphere_body, const Triples& offset, const Postures& q, int threads,
             const Array<double, nb::shape<-1, -1, 3>>& out) {
  const Chain chain = view_chain(parent, kind, placement, axis, sphere_body, offset);
  expect(q.shape(1) + 1 == parent.shape(0) && out.shape(0) == q.shape(0) && out.shape(1) == sphere_body.shape(0),
         "postures: expected (T, J), centres (T, S, 3)");
  const nb::gil_scoped_release release;
  sphere_centers(chain, q.data(), static_cast<long>(q.shape(0)), threads, out.data());
}

void jacobians(const Integers& parent, const Integers& kind, const Placements& placement, const Triples& axis,
               const Integers& sphere_body, const Triples& offset, const Doubles& q, const Array<double, nb::shape<-1, 3>>& centers_out,
               const Array<double, nb::shape<-1, 3, -1>>& out) {
  const Chain chain = view_chain(parent, kind, placement, axis, sphere_body, offset);
  const size_t s = sphere_body.shape(0);
  expect(q.shape(0) + 1 == parent.shape(0) && centers_out.shape(0) == s && out.shape(0) == s && out.shape(2) == q.shape(0),
         "posture: expected (J,), centres (S, 3), jacobians (S, 3, J)");
  const nb::gil_scoped_release release;
  sphere_jacobians(chain, q.data(), centers_out.data(), out.data());
}

void frame(const Integers& parent, const Integers& kind, const Placements& placement, const Triples& axis,
           const Integers& sphere_body, const Triples& offset, const Doubles& q, int body,
           const Array<const double, nb::shape<3, 4>>& in_body, const Array<double, nb::shape<3, 4>>& pose,
           const Array<double, nb::shape<6, -1>>& out) {
  const Chain chain = view_chain(parent, kind, placement, axis, sphere_body, offset);
  expect(q.shape(0) + 1 == parent.shape(0) && out.shape(1) == q.shape(0), "posture: expected (J,), Jacobian (6, J)");
  expect(body >= 0 && body < chain.num_bodies, "body: expected one that is there");
  const nb::gil_scoped_release release;
  frame_jacobian(chain, q.data(), body, in_body.data(), pose.data(), out.data());
}

void gaps(const Triples& centers_in, const Doubles& radii, const Pairs& pairs, const Array<double, nb::shape<-1>>& gap,
          const Array<double, nb::shape<-1, 3>>& direction) {
  const size_t s = centers_in.shape(0), n = pairs.shape(0);
  expect(radii.shape(0) == s && gap.shape(0) == n && direction.shape(0) == n, "pairs: expected one gap and direction each");
  for (size_t k = 0; k < 2 * n; ++k)
    expect(pairs.data()[k] >= 0 && pairs.data()[k] < static_cast<long>(s), "pairs: expected spheres that are there");
  const nb::gil_scoped_release release;
  pair_gaps(centers_in.data(), radii.data(), pairs.data(), static_cast<long>(n), gap.data(), direction.data());
}

}  // namespace

void bind_chain(nb::module_& m) {
  m.def("chain_centers", &centers, nb::arg("parent").noconvert(), nb::arg("kind").noconvert(), nb::arg("placement").noconvert(),
        nb::arg("axis").noconvert(), nb::arg("sphere_body").noconvert(), nb::arg("offset").noconvert(), nb::arg("q").noconvert(),
        nb::arg("threads"), nb::arg("centers").noconvert());
  m.def("chain_jacobians", &jacobians, nb::arg("parent").noconvert(), nb::arg("kind").noconvert(), nb::arg("placement").noconvert(),
        nb::arg("axis").noconvert(), nb::arg("sphere_body").noconvert(), nb::arg("offset").noconvert(), nb::arg("q").noconvert(),
        nb::arg("centers").noconvert(), nb::arg("jacobians").noconvert());
  m.def("chain_frame", &frame, nb::arg("parent").noconvert(), nb::arg("kind").noconvert(), nb::arg("placement").noconvert(),
        nb::arg("axis").noconvert(), nb::arg("sphere_body").noconvert(), nb::arg("offset").noconvert(), nb::arg("q").noconvert(),
        nb::arg("body"), nb::arg("in_body").noconvert(), nb::arg("pose").noconvert(), nb::arg("jacobian").noconvert());
  m.def("pair_gaps", &gaps, nb::arg("centers").noconvert(), nb::arg("radii").noconvert(), nb::arg("pairs").noconvert(),
        nb::arg("gap").noconvert(), nb::arg("direction").noconvert());
}

}  // namespace splatctrl
