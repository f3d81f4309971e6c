// Python bindings of the rasterizer: checks shapes, releases the GIL, calls. Arrays come from Python, outputs too.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>

#include "../common/arguments.h"
#include "frames.h"
#include "rasterizer.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using perception::Level;

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Optional = std::optional<Array<T>>;

std::string shape_text(const std::vector<int64_t> &shape) {
  std::string s = "[";
  for (std::size_t i = 0; i < shape.size(); ++i) s += (i ? ", " : "") + std::to_string(shape[i]);
  return s + "]";
}

template <class A>
auto *checked(const char *name, A &array, const std::vector<int64_t> &expected) {
  std::vector<int64_t> found;
  for (std::size_t i = 0; i < array.ndim(); ++i) found.push_back(static_cast<int64_t>(array.shape(i)));
  if (found != expected)
    throw std::invalid_argument(std::string(name) + ": shape " + shape_text(found) + ", expected " +
                                shape_text(expected));
  perception::require_aligned(name, array);
  return array.data();
}

template <class A>
auto checked(const char *name, std::optional<A> &array, const std::vector<int64_t> &expected)
    -> decltype(array->data()) {
  return array ? checked(name, *array, expected) : nullptr;
}

nb::dict stage_seconds(const perception::Stats &stats) {
  const char *names[perception::kStages] = {"project", "sort", "bin", "blend", "blend_backward", "reduce"};
  nb::dict seconds;
  for (int i = 0; i < perception::kStages; ++i) seconds[names[i]] = stats.seconds[i];
  return seconds;
}

template <class T>
struct Handle {
  perception::FramesPtr<T> frames;
};

template <class T>
struct Arguments {
  Array<const T> means, quats, scales, opacities, colors;
  Optional<const T> features;
  Array<const T> viewmats, Ks;
  Optional<const T> background;
  int width, height, sh_degree;
  double near_plane, eps2d;
  int threads;
  bool depth, variance;
  int64_t max_records;

  perception::Inputs<T> inputs() {
    perception::Inputs<T> in{};
    if (means.ndim() != 2) throw std::invalid_argument("means: expected 2 dimensions [N, 3]");
    if (viewmats.ndim() != 3) throw std::invalid_argument("viewmats: expected 3 dimensions [C, 4, 4]");
    const int64_t n = in.n = static_cast<int64_t>(means.shape(0)),
                  c = in.cameras = static_cast<int64_t>(viewmats.shape(0));
    if (n >= INT32_MAX) throw std::invalid_argument("means: too many Gaussians");
    if (width < 1 || height < 1 || width > 1 << 20 || height > 1 << 20)
      throw std::invalid_argument("width, height: expected 1 to 1048576 pixels");
    in.near_plane = static_cast<T>(near_plane), in.eps2d = static_cast<T>(eps2d);
    if (!(in.eps2d >= T(0.01) && in.eps2d <= T(1e4))) throw std::invalid_argument("eps2d: expected 0.01 to 10000 px²");
    if (sh_degree > 3) throw std::invalid_argument("sh_degree: expected at most 3");
    in.means = checked("means", means, {n, 3}), in.quats = checked("quats", quats, {n, 4});
    in.scales = checked("scales", scales, {n, 3}), in.opacities = checked("opacities", opacities, {n});
    in.sh_degree = sh_degree;
    if (sh_degree < 0) {
      in.colors = checked("colors", colors, {n, 3});
    } else {
      in.sh_stride = colors.ndim() == 3 ? static_cast<int>(colors.shape(1)) : 0;
      if (in.sh_stride < (sh_degree + 1) * (sh_degree + 1))
        throw std::invalid_argument("colors: expected [N, K, 3] with K >= (sh_degree + 1)^2");
      in.colors = checked("colors", colors, {n, in.sh_stride, 3});
    }
    if (features) {
      if (features->ndim() != 2 || features->shape(1) > 1 << 16)
        throw std::invalid_argument("features: expected [N, D]");
      in.dims = static_cast<int>(features->shape(1));
      in.features = checked("features", features, {n, in.dims});
    }
    in.viewmats = checked("viewmats", viewmats, {c, 4, 4}), in.Ks = checked("Ks", Ks, {c, 3, 3});
    for (int64_t i = 0; i < c; ++i)
      if (!(in.Ks[9 * i] != 0 && in.Ks[9 * i + 4] != 0))
        throw std::invalid_argument("Ks[" + std::to_string(i) + "]: a focal length is 0");
    in.background = checked("background", background, {c, 3});
    in.width = width, in.height = height;
    return in;
  }
  perception::Options options(const perception::Inputs<T> &in) const {
    if (threads < 1 || threads > 1024) throw std::invalid_argument("threads: expected 1 to 1024");
    if (max_records < 0) throw std::invalid_argument("max_records: expected 0 or more");
    return {threads, depth, variance && in.dims > 0, max_records};
  }
};

template <class T>
struct Images {
  Array<T> colors, alphas;
  Optional<T> depths, features, variance;

  perception::Outputs<T> outputs(const perception::Inputs<T> &in, const perception::Options &opt) {
    const int64_t c = in.cameras, h = in.height, w = in.width;
    perception::Outputs<T> out{};
    out.colors = checked("out colors", colors, {c, h, w, 3}), out.alphas = checked("out alphas", alphas, {c, h, w});
    out.depths = checked("out depths", depths, {c, h, w});
    out.features = checked("out features", features, {c, h, w, in.dims});
    out.variance = checked("out feature_variance", variance, {c, h, w, in.dims});
    if (opt.variance && !(out.features && out.variance))
      throw std::invalid_argument("features and feature_variance need outputs");
    return out;
  }
};

template <class T>
struct Cotangents {
  Optional<const T> colors, alphas, depths, features, variance;

  perception::Cotangents<T> checked_for(const perception::Inputs<T> &in) {
    const int64_t c = in.cameras, h = in.height, w = in.width, d = in.dims;
    return {checked("colors' gradient", colors, {c, h, w, 3}), checked("alphas' gradient", alphas, {c, h, w}),
            checked("depths' gradient", depths, {c, h, w}), checked("features' gradient", features, {c, h, w, d}),
            checked("feature_variance's gradient", variance, {c, h, w, d})};
  }
};

template <class T>
struct Gradients {
  Optional<T> means, quats, scales, opacities, colors, features, viewmats, mean2d, absgrad;

  perception::Gradients<T> checked_for(const perception::Inputs<T> &in, bool stored) {
    const int64_t n = in.n, c = in.cameras;
    const std::vector<int64_t> color_shape =
        in.sh_degree < 0 ? std::vector<int64_t>{n, 3} : std::vector<int64_t>{n, in.sh_stride, 3};
    return {checked("out means", means, {n, 3}),
            checked("out quats", quats, {n, 4}),
            checked("out scales", scales, {n, 3}),
            checked("out opacities", opacities, {n}),
            checked("out colors", colors, color_shape),
            checked("out features", features, {n, in.dims}),
            checked("out viewmats", viewmats, {c, 4, 4}),
            checked("out mean2d", mean2d, {c, n, 2}),
            checked("out absgrad", absgrad, {c, n, 2}),
            stored};
  }
};

void throw_if(const perception::NonFinite &bad) {
  if (bad.argument)
    throw std::invalid_argument(std::string(bad.argument) + "[" + std::to_string(bad.index) + "] is not finite");
}

template <class T>
std::unique_ptr<Handle<T>> forward(Arguments<T> &a, Images<T> &images, Array<uint8_t> visible, Optional<T> radii,
                                   const std::string &simd) {
  const perception::Inputs<T> in = a.inputs();
  const perception::Options opt = a.options(in);
  const Level level = perception::parse_level(simd);
  perception::Outputs<T> out = images.outputs(in, opt);
  if (in.dims && !out.features) throw std::invalid_argument("features need an output");
  out.visible = checked("out visible", visible, {in.cameras, in.n});
  out.radii = checked("out radii", radii, {in.cameras, in.n});
  perception::NonFinite bad;
  auto handle = std::make_unique<Handle<T>>();
  {
    nb::gil_scoped_release release;
    handle->frames = perception::rasterize_forward(in, opt, level, out, bad);
  }
  throw_if(bad);
  return handle;
}

template <class T>
void label(Arguments<T> &a, Array<const int32_t> labels, double least, Array<int32_t> images, Array<uint8_t> visible,
           const std::string &simd) {
  const perception::Inputs<T> in = a.inputs();
  const perception::Options opt = a.options(in);
  const Level level = perception::parse_level(simd);
  if (in.cameras != 1) throw std::invalid_argument("viewmats: expected one camera");
  if (labels.ndim() != 2 || labels.shape(0) > perception::kMaxLabellings)
    throw std::invalid_argument("labels: expected [L, N] with at most 8 labellings");
  const int64_t count = static_cast<int64_t>(labels.shape(0));
  perception::Labels found{};
  found.count = static_cast<int>(count), found.least = least;
  found.of = checked("labels", labels, {count, in.n});
  found.images = checked("out images", images, {count, in.height, in.width});
  uint8_t *seen = checked("out visible", visible, {in.n});
  int32_t largest = -1;
  for (int64_t i = 0; i < count * in.n; ++i) largest = std::max(largest, found.of[i]);
  if (largest >= 1 << 24) throw std::invalid_argument("labels: expected less than 16777216");
  found.most = largest + 1;
  perception::NonFinite bad;
  {
    nb::gil_scoped_release release;
    bad = perception::rasterize_labels(in, opt, level, found, seen);
  }
  throw_if(bad);
}

template <class T>
void backward(Arguments<T> &a, Handle<T> &handle, Images<T> &images, Cotangents<T> &cotangents,
              Gradients<T> &gradients, bool stored) {
  const perception::Inputs<T> in = a.inputs();
  const perception::Options opt = a.options(in);
  const perception::Frames<T> *frames = handle.frames.get();
  if (!frames || static_cast<int64_t>(frames->cameras.size()) != in.cameras || frames->n != in.n ||
      frames->width != in.width || frames->height != in.height)
    throw std::invalid_argument("frames: not of inputs with as many Gaussians, cameras and pixels");
  if (stored && in.cameras != 1) throw std::invalid_argument("stored: expected one camera");
  const perception::Outputs<T> out = images.outputs(in, opt);
  const perception::Cotangents<T> grad = cotangents.checked_for(in);
  if (opt.depth && grad.depths && !out.depths) throw std::invalid_argument("depths: missing, their gradient is given");
  const perception::Gradients<T> result = gradients.checked_for(in, stored);
  if (in.dims && !out.features && !(result.features_alone() && !opt.variance))
    throw std::invalid_argument("features: missing, gradients need them");
  nb::gil_scoped_release release;
  perception::rasterize_backward(in, opt, *handle.frames, out, grad, result);
}

template <class T>
void bind(nb::module_ &m, const char *suffix) {
  auto name = [suffix](const char *base) { return std::string(base) + suffix; };
  auto arg = [](const char *of) { return nb::arg(of).noconvert(); };
  nb::class_<Handle<T>>(m, name("RasterizerFrames").c_str(), "What a backward call needs of its forward call.")
      .def_prop_ro("evaluated", [](const Handle<T> &h) { return h.frames->stats.evaluated; })
      .def_prop_ro("contributing", [](const Handle<T> &h) { return h.frames->stats.contributing; })
      .def_prop_ro("seconds", [](const Handle<T> &h) { return stage_seconds(h.frames->stats); });
  nb::class_<Arguments<T>>(m, name("RasterizerInputs").c_str())
      .def(nb::init<Array<const T>, Array<const T>, Array<const T>, Array<const T>, Array<const T>, Optional<const T>,
                    Array<const T>, Array<const T>, Optional<const T>, int, int, int, double, double, int, bool, bool,
                    int64_t>(),
           arg("means"), arg("quats"), arg("scales"), arg("opacities"), arg("colors"), arg("features").none(),
           arg("viewmats"), arg("Ks"), arg("background").none(), "width"_a, "height"_a, "sh_degree"_a, "near_plane"_a,
           "eps2d"_a, "threads"_a, "depth"_a, "variance"_a, "max_records"_a);
  nb::class_<Images<T>>(m, name("RasterizerImages").c_str())
      .def(nb::init<Array<T>, Array<T>, Optional<T>, Optional<T>, Optional<T>>(), arg("colors"), arg("alphas"),
           arg("depths").none(), arg("features").none(), arg("feature_variance").none());
  nb::class_<Cotangents<T>>(m, name("RasterizerCotangents").c_str())
      .def(nb::init<Optional<const T>, Optional<const T>, Optional<const T>, Optional<const T>, Optional<const T>>(),
           arg("colors").none(), arg("alphas").none(), arg("depths").none(), arg("features").none(),
           arg("feature_variance").none());
  nb::class_<Gradients<T>>(m, name("RasterizerGradients").c_str())
      .def(nb::init<Optional<T>, Optional<T>, Optional<T>, Optional<T>, Optional<T>, Optional<T>, Optional<T>,
                    Optional<T>, Optional<T>>(),
           arg("means").none(), arg("quats").none(), arg("scales").none(), arg("opacities").none(),
           arg("colors").none(), arg("features").none(), arg("viewmats").none(), arg("mean2d").none(),
           arg("absgrad").none());
  m.def(name("rasterize_forward").c_str(), &forward<T>, "inputs"_a, "images"_a, arg("visible"), arg("radii").none(),
        "simd"_a);
  m.def(name("rasterize_labels").c_str(), &label<T>, "inputs"_a, "labels"_a.noconvert(), "least"_a,
        "images"_a.noconvert(), "visible"_a.noconvert(), "simd"_a);
  m.def(name("rasterize_backward").c_str(), &backward<T>, "inputs"_a, "frames"_a, "images"_a, "cotangents"_a,
        "gradients"_a, "stored"_a);
}

}  // namespace

void bind_rasterizer(nb::module_ &m) {
  nb::set_leak_warnings(false);  // a graph still alive at exit legitimately holds its frames
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
  m.def("rasterizer_release_memory", &perception::release_memory, "Frees the buffers kept between calls.");
}
