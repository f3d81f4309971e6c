// Binds the training operations as _core.training: arrays in place, shapes checked, GIL released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>

#include "../common/arguments.h"
#include "../common/parallel.h"
#include "training.h"

namespace nb = nanobind;
namespace pt = perception::training;
using namespace nb::literals;
using perception::Level;
using perception::parse_level;
using perception::require_aligned;

namespace {

template <class T, size_t N>
using In = nb::ndarray<const T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;
template <class T, size_t N>
using Out = nb::ndarray<T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;

void require(bool fine, const char *message) {
  if (!fine) throw std::invalid_argument(message);
}

template <class A, class B>
bool same_shape(const A &a, const B &b) {
  if (a.ndim() != b.ndim()) return false;
  for (size_t i = 0; i < a.ndim(); ++i)
    if (a.shape(i) != b.shape(i)) return false;
  return true;
}

template <class T, class Target>
auto photometric(In<T, 3> render, In<Target, 3> target, std::optional<In<T, 2>> weight, Out<T, 3> gradient, double beta,
                 int threads, const std::string &level) {
  require_aligned("render", render, "target", target, "weight", weight, "gradient", gradient);
  for (size_t side = 0; side < 3; ++side)
    require(render.shape(side) < size_t(1) << 31, "render: expected sides under 2^31");
  require(same_shape(render, target), "target: expected the shape of render");
  require(same_shape(render, gradient), "gradient: expected the shape of render");
  require(!weight || (weight->shape(0) == render.shape(0) && weight->shape(1) == render.shape(1)),
          "weight: expected [H, W] of render [H, W, C]");
  pt::PhotometricArguments<T> a{};
  a.render = render.data();
  if constexpr (std::is_same_v<Target, uint8_t>)
    a.target8 = target.data();
  else
    a.target = target.data();
  a.weight = weight ? weight->data() : nullptr;
  a.gradient = gradient.data();
  a.height = static_cast<int>(render.shape(0));
  a.width = static_cast<int>(render.shape(1));
  a.channels = static_cast<int>(render.shape(2));
  a.beta = beta;
  pt::PhotometricResult result;
  {
    nb::gil_scoped_release release;
    result = pt::photometric(a, {threads, parse_level(level)});
  }
  return nb::make_tuple(result.loss, result.l1, result.ssim);
}

auto assign(In<int32_t, 1> labels, Out<int32_t, 1> slots) {
  require_aligned("labels", labels, "slots", slots);
  require(same_shape(labels, slots), "slots: expected the shape of labels");
  pt::Assignment out;
  {
    nb::gil_scoped_release release;
    out = pt::assign(labels.data(), static_cast<int64_t>(labels.size()), slots.data());
  }
  return nb::make_tuple(out.ids, out.counts, out.first);
}

void check_slots(const int32_t *slots, size_t pixels, size_t labels) {
  for (size_t p = 0; p < pixels; ++p)
    require(slots[p] < static_cast<int64_t>(labels), "slots: an index lies outside the labels");
}

template <class T>
pt::LabelledFeatures<T> labelled(const In<T, 2> &features, const In<int32_t, 1> &slots) {
  return {features.data(), slots.data(), static_cast<int64_t>(features.shape(0)),
          static_cast<int64_t>(features.shape(1))};
}

template <class T>
void prototypes(In<T, 2> features, In<int32_t, 1> slots, In<int64_t, 1> counts, In<int64_t, 1> first,
                Out<double, 2> means, Out<double, 1> scatter, int threads, const std::string &level) {
  const size_t labels = counts.shape(0);
  require_aligned("features", features, "slots", slots, "counts", counts, "first", first, "means", means, "scatter",
                  scatter);
  require(features.shape(0) == slots.shape(0), "slots: expected [P] of features [P, D]");
  require(first.shape(0) == labels && scatter.shape(0) == labels && means.shape(0) == labels &&
              means.shape(1) == features.shape(1),
          "first, means, scatter: expected [L], [L, D], [L] of counts [L] and features [P, D]");
  nb::gil_scoped_release release;
  check_slots(slots.data(), slots.shape(0), labels);
  for (size_t i = 0; i < labels; ++i)
    require(first.data()[i] >= 0 && first.data()[i] < static_cast<int64_t>(features.shape(0)) && counts.data()[i] > 0,
            "first, counts: every label needs a pixel");
  pt::prototypes(labelled(features, slots),
                 {static_cast<int64_t>(labels), counts.data(), first.data(), means.data(), scatter.data()},
                 {threads, parse_level(level)});
}

template <class T>
void spread(In<T, 2> features, In<int32_t, 1> slots, In<double, 2> means, In<double, 1> pull, In<double, 2> push,
            Out<T, 2> out, int threads, const std::string &level) {
  require_aligned("features", features, "slots", slots, "means", means, "pull", pull, "push", push, "out", out);
  require(features.shape(0) == slots.shape(0), "slots: expected [P] of features [P, D]");
  require(same_shape(features, out), "out: expected the shape of features");
  require(same_shape(means, push) && means.shape(0) == pull.shape(0) && means.shape(1) == features.shape(1),
          "pull, push: expected [L] and [L, D] of means [L, D], with D of features [P, D]");
  nb::gil_scoped_release release;
  check_slots(slots.data(), slots.shape(0), means.shape(0));
  pt::spread(labelled(features, slots), means.data(), pull.data(), push.data(), out.data(),
             {threads, parse_level(level)});
}

double separation(In<double, 2> points, double margin, Out<double, 2> gradient) {
  require_aligned("points", points, "gradient", gradient);
  require(same_shape(points, gradient), "gradient: expected the shape of points");
  nb::gil_scoped_release release;
  return pt::separation(points.data(), points.shape(0), points.shape(1), margin, gradient.data());
}

void add_statistics(In<float, 2> mean2d, In<uint8_t, 1> visible, Out<float, 1> gradient, Out<float, 1> seen,
                    double scale, int threads) {
  require_aligned("mean2d", mean2d, "gradient", gradient, "seen", seen);
  require(mean2d.shape(0) == visible.shape(0) && mean2d.shape(1) == 2 && same_shape(visible, gradient) &&
              same_shape(visible, seen),
          "mean2d, gradient, seen: expected [N, 2] and [N] of visible [N]");
  nb::gil_scoped_release release;
  pt::add_statistics({mean2d.data(), visible.data(), gradient.data(), seen.data(), static_cast<int64_t>(seen.size()),
                      static_cast<float>(scale)},
                     threads);
}

template <class T>
double sum(In<T, 1> values, bool squared, int threads, const std::string &level) {
  require_aligned("values", values);
  nb::gil_scoped_release release;
  return pt::sum(values.data(), static_cast<int64_t>(values.size()), squared, {threads, parse_level(level)});
}

template <class T>
void scale(In<T, 1> values, double factor, Out<T, 1> out, int threads) {
  require_aligned("values", values, "out", out);
  require(same_shape(values, out), "out: expected the shape of values");
  nb::gil_scoped_release release;
  pt::scale(values.data(), static_cast<int64_t>(values.size()), factor, out.data(), {threads, Level::baseline});
}

template <class T>
void activate(In<T, 1> values, bool logistic, Out<T, 1> out, int threads, const std::string &level) {
  require_aligned("values", values, "out", out);
  require(same_shape(values, out), "out: expected the shape of values");
  nb::gil_scoped_release release;
  pt::activate(values.data(), static_cast<int64_t>(values.size()), logistic, out.data(), {threads, parse_level(level)});
}

template <class T>
int64_t adam(Out<T, 2> param, In<T, 2> grad, Out<T, 2> first, Out<T, 2> second, std::optional<In<uint8_t, 1>> visible,
          In<double, 1> rate, int64_t step, double beta1, double beta2, double eps, int threads,
          const std::string &level) {
  require_aligned("param", param, "grad", grad, "first", first, "second", second, "rate", rate);
  require(same_shape(param, grad) && same_shape(param, first) && same_shape(param, second),
          "grad, first, second: expected the shape of param");
  require(!visible || visible->shape(0) == param.shape(0), "visible: expected [N] of param [N, K]");
  require(rate.shape(0) == param.shape(1) && step >= 1, "rate, step: expected [K] of param [N, K], and 1 or more");
  nb::gil_scoped_release release;
  return pt::adam(
      pt::AdamArguments<T>{param.data(), first.data(), second.data(), grad.data(),
                           visible ? visible->data() : nullptr, rate.data(), static_cast<int64_t>(param.shape(0)),
                           static_cast<int64_t>(param.shape(1)), step, beta1, beta2, eps},
      {threads, parse_level(level)});
}

template <class T>
void bind_precision(nb::module_ &m) {
  const auto arg = [](const char *name) { return nb::arg(name).noconvert(); };
  m.def("photometric", &photometric<T, T>, arg("render"), arg("target"), arg("weight").none(), arg("gradient"),
        "beta"_a, "threads"_a = 0, "level"_a = "auto");
  m.def("photometric", &photometric<T, uint8_t>, arg("render"), arg("target"), arg("weight").none(), arg("gradient"),
        "beta"_a, "threads"_a = 0, "level"_a = "auto",
        "(loss, l1, ssim) of images [H, W, C] and d loss / d render into gradient.");
  m.def("prototypes", &prototypes<T>, arg("features"), arg("slots"), arg("counts"), arg("first"), arg("means"),
        arg("scatter"), "threads"_a = 0, "level"_a = "auto",
        "Mean feature per slot [M, D] and sum of squared distances to it [M].");
  m.def("spread", &spread<T>, arg("features"), arg("slots"), arg("means"), arg("pull"), arg("push"), arg("out"),
        "threads"_a = 0, "level"_a = "auto", "out = pull[slot] (F - means[slot]) + push[slot].");
  m.def("sum", &sum<T>, arg("values"), "squared"_a, "threads"_a = 0, "level"_a = "auto");
  m.def("scale", &scale<T>, arg("values"), "factor"_a, arg("out"), "threads"_a = 0, "out = factor * values.");
  m.def("activate", &activate<T>, arg("values"), "logistic"_a, arg("out"), "threads"_a = 0, "level"_a = "auto",
        "out = exp(values), or 1 / (1 + exp(-values)), where values beyond +-80 count as those.");
  m.def("adam", &adam<T>, arg("param"), arg("grad"), arg("first"), arg("second"), arg("visible").none(), arg("rate"),
        "step"_a, "beta1"_a, "beta2"_a, "eps"_a, "threads"_a = 0, "level"_a = "auto",
        "One Adam step in place on the visible rows; the number of rows skipped for a non-finite gradient.");
}

}  // namespace

void bind_training(nb::module_ &parent) {
  nb::module_ m = parent.def_submodule("training", "Fused losses and the optimiser; float32 and float64.");
  m.def("set_threads", &perception::set_default_threads, "threads"_a,
        "Threads of calls that name none; 0 means all processors. Results do not depend on it.");
  m.def("assign", &assign, nb::arg("labels").noconvert(), nb::arg("slots").noconvert(),
        "(ids, counts, first pixel) of the labels in use; slots gets each pixel's index into ids, or -1.");
  m.def("separation", &separation, nb::arg("points").noconvert(), "margin"_a, nb::arg("gradient").noconvert(),
        "Mean relu(margin - squared distance) over the pairs of points [M, D], and its gradient.");
  m.def("add_statistics", &add_statistics, nb::arg("mean2d").noconvert(), nb::arg("visible").noconvert(),
        nb::arg("gradient").noconvert(), nb::arg("seen").noconvert(), "scale"_a, "threads"_a = 0,
        "Adds one view, where visible: scale |mean2d| to gradient, 1 to seen.");
  bind_precision<float>(m);
  bind_precision<double>(m);
}
