// Python's door to the plane sweep: arguments are checked here, the interpreter lock is released, then work is done.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>

#include "../common/arguments.h"
#include "stereo.h"

namespace nb = nanobind;
namespace ps = perception::stereo;

namespace {

template <class T, class Shape>
using Values = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;
using Grey = Values<const uint8_t, nb::ndim<2>>;

ps::Image image_of(const Grey &grey) {
  if (grey.size() == 0 || grey.shape(0) > 8192 || grey.shape(1) > 8192)
    throw nb::value_error("photo, others: between 1 and 8192 pixels a side are needed");
  return {grey.data(), static_cast<int>(grey.shape(1)), static_cast<int>(grey.shape(0))};
}

void plane_sweep(Grey photo, const std::vector<Grey> &others, Values<const double, nb::shape<-1, 2, 3, 3>> homographies,
                 Values<const float, nb::ndim<2>> prior, double first, double step, int planes,
                 Values<float, nb::ndim<2>> depth, int threads, const std::string &level) {
  perception::require_aligned("homographies", homographies, "prior", prior, "depth", depth);
  const double *maps = homographies.data(), last = first + step * (planes - 1);
  if (others.empty() || homographies.shape(0) != others.size())
    throw nb::value_error("homographies: expected [N, 2, 3, 3] for N others, at least one");
  if (!std::all_of(maps, maps + homographies.size(), [](double v) { return std::abs(v) < 1e30; }))
    throw nb::value_error("homographies: all must be finite");
  for (size_t i = 0; i < 2; ++i)
    if (prior.shape(i) != photo.shape(i) || depth.shape(i) != photo.shape(i))
      throw nb::value_error("prior, depth: expected the shape of photo");
  if (planes < ps::kBlock || planes > 8 * ps::kBlock || planes % ps::kBlock)
    throw nb::value_error("planes: expected 32, 64, ... or 256");
  if (!(std::min(first, last) > 0 && std::max(first, last) < 1e30 && std::abs(step) > 1e-30))
    throw nb::value_error("first, step: the inverse depths must be positive, finite and different");
  ps::Sweep sweep{image_of(photo), {}, first, step, planes, prior.data(), depth.data(), {}, {}, {}, {}, {}, {}};
  for (size_t i = 0; i < others.size(); ++i)
    sweep.others.push_back({image_of(others[i]), maps + 18 * i, maps + 18 * i + 9, {}});
  nb::gil_scoped_release release;
  ps::sweep(sweep, threads, perception::parse_level(level));
}

}  // namespace

void bind_stereo(nb::module_ &m) {
  m.def("plane_sweep", &plane_sweep, nb::arg("photo").noconvert(), nb::arg("others").noconvert(),
        nb::arg("homographies").noconvert(), nb::arg("prior").noconvert(), nb::arg("first"), nb::arg("step"),
        nb::arg("planes"), nb::arg("depth").noconvert(), nb::arg("threads") = 0, nb::arg("level") = "auto",
        "Fills depth [h, w] of photo [h, w] from others and a prior depth (0 = none). Plane i has the inverse depth\n"
        "first + step * i. homographies: A, B per other; A + B / z maps pixels, whose centres are integers.");
}
