// The normal distribution's cumulative function Φ, to rounding.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cmath>

#include "arguments.h"

namespace nb = nanobind;

namespace {

template <class T>
using Numbers = nb::ndarray<T, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

template <class Real>
void normal_cdf(Numbers<const Real> x, Numbers<Real> out) {
  perception::require_aligned("x", x, "out", out);
  if (x.size() != out.size()) throw nb::value_error("x and out must have the same length");
  const Real *from = x.data();
  Real *to = out.data();
  nb::gil_scoped_release release;
  for (std::size_t n = 0; n < x.size(); ++n) to[n] = Real(0.5) * std::erfc(from[n] * Real(-0.70710678118654752440));
}

}  // namespace

void bind_normal(nb::module_ &m) {
  const char *text = "Fills out [N] with Phi(x) of x [N].";
  m.def("normal_cdf", &normal_cdf<float>, nb::arg("x").noconvert(), nb::arg("out").noconvert(), text);
  m.def("normal_cdf", &normal_cdf<double>, nb::arg("x").noconvert(), nb::arg("out").noconvert(), text);
}
